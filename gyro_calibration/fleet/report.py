# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A fleet as one page that needs nothing else, and as tables in CSV and Parquet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import csv
import io
from typing import Any

from gyro_calibration.diagnosis.charts import Chart, draw_chart, element, join_markup, Line, Markup
from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.report import render_page
from gyro_calibration.diagnosis.words import (
    as_sentence,
    display_unit,
    format_amount,
    format_quantity,
    readable_name,
)
from gyro_calibration.fleet.pooling import Component, DRIVES, Interval, POWER_ONS, UNITS
from gyro_calibration.fleet.summary import (
    describe_type,
    format_interval,
    TypeSummary,
    ValueSummary,
)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
import numpy as np

_COMPONENT_LABELS = ((UNITS, 'between units'), (POWER_ONS, 'between power-ons'),
                     (DRIVES, 'common to a drive'))
_SLOPE_UNITS = {'age': 'year', 'temperature': 'K'}
#: Tables with more rows are scrolled inside the page and have a search field.
_MAX_UNSCROLLED_ROWS = 12
_COLUMNS = ('log', 'type', 'unit', 'drive', 'date', 'temperature', 'status', 'reason', 'method',
            'samples', 'duration_s', 'sha256', 'page')
#: Sorts a table by the clicked column, and shows the rows that contain a text.
_SCRIPT = Markup("""<script>
'use strict';
for (const table of document.querySelectorAll('table.sortable')) {
  const body = table.tBodies[0], rows = [...body.rows], search = document.createElement('input');
  search.type = 'search';
  search.placeholder = 'Search';
  search.setAttribute('aria-label', 'Search in the table below');
  if (table.parentNode.classList.contains('tall')) table.parentNode.before(search);
  search.addEventListener('input', () => {
    const text = search.value.toLowerCase();
    for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(text);
  });
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = document.createElement('button');
    for (const row of rows) row.cells[column].dataset.head = head.textContent;
    button.textContent = head.textContent;
    head.replaceChildren(button);
    let sign = -1;
    button.addEventListener('click', () => {
      sign = -sign;
      const key = row => row.cells[column].dataset.key;
      rows.sort((a, b) => sign * (key(a) - key(b) || key(a).localeCompare(key(b))));
      body.append(...rows);
    });
  });
}
</script>""")
_STYLE = Markup("""<style>
th button { all: unset; cursor: pointer; } th button:focus-visible { outline: 2px solid; }
input[type=search] { font: inherit; padding: .2rem .6rem; margin: .4rem 0; max-width: 20rem; }
.scroll.fold { max-width: none; max-height: none; } .scroll.tall { max-height: 40rem; }
.sortable th, .sortable td { overflow-wrap: normal; word-break: normal; }
.sortable td:nth-child(n + 2):not(:empty) { min-width: 4.5rem; }
@container (max-width: 29.99rem) {
  .fold .sortable td:first-child { font-weight: 600; } .fold .sortable td:empty { display: none; }
}
</style>""")


def render_report(types: Sequence[TypeSummary], records: Sequence[Mapping[str, Any]]) -> str:
    """
    Return the page, HTML in UTF-8.

    Parameters
    ----------
    types : as `summary.summarize_types` returns them
    records : of all logs, including excluded ones

    """
    used = sum(len(found.records) for found in types)
    title = (f'{used} logs of {sum(len(found.units) for found in types)} units of '
             f'{len(types)} {"type" if len(types) == 1 else "types"}')
    about = f'{len(records) - used} more logs are excluded.' if used < len(records) else None
    body = join_markup(
        element('header', element('p', 'Fleet', class_='about'), element('h1', title),
                element('p', about, class_='gained') if about else None),
        element('main', *(part for place, found in enumerate(types)
                          for part in _type_sections(found, place)), _log_section(records)),
        _STYLE, _SCRIPT)
    return render_page(f'Fleet: {title}', body)


def _type_sections(summary: TypeSummary, index: int) -> Iterator[Markup]:
    name = summary.name or 'Type not stated'
    items = [element('li', as_sentence(text)) for text in describe_type(summary)]
    yield element('section', element('h2', name), element('ul', *items), _variance_table(summary))
    values = [each for each in summary.values.values() if not each.is_slow]
    yield element(
        'section', element('h2', f'{name}: units'), element(
            'p', 'Bars: 95 % intervals of the mean of a unit over its power-ons.', class_='quiet'),
        element('div', *(draw_chart(_interval_chart(each, f't{index}-{each.name}-units', 'unit',
                                                    summary.units, each.units, 'after'))
                         for each in values), class_='pairs'), _unit_table(summary, values))
    shared = [each for each in summary.values.values() if DRIVES in each.components]
    if shared:
        yield element('section', element('h2', f'{name}: drives'),
                      element('p', 'An error that all units of a drive have in common is '
                              'assigned to its reference or to the vehicle.', class_='quiet'),
                      element('div', *(draw_chart(_interval_chart(
                          each, f't{index}-{each.name}-drives', 'drive', summary.drives,
                          each.drives, 'before')) for each in shared), class_='pairs'))
    if len(summary.dates) > 1:
        yield element(
            'section', element('h2', f'{name}: over time'),
            element('div', *(draw_chart(_dates_chart(summary, each, f't{index}-{each.name}-dates'))
                             for each in values), class_='pairs'))


def _variance_table(summary: TypeSummary) -> Markup:
    drifts = any(each.slopes for each in summary.values.values())
    heads = ['value', 'mean of the type', 'one more unit',
             *(text for _, text in _COMPONENT_LABELS), *(['drift'] if drifts else [])]
    rows = [[_cell(readable_name(each.name)), _interval_cell(each, each.mean, 0),
             _interval_cell(each, each.new_unit, 0),
             *(_component_cell(each, each.components.get(name)) for name, _ in _COMPONENT_LABELS),
             *([_cell('; '.join(format_interval(slope, 0, f'{each.unit}/{_SLOPE_UNITS[name]}',
                                                each.name)
                                for name, slope in each.slopes.items()))] if drifts else [])]
            for each in summary.values.values()]
    return _table(heads, rows)


def _unit_table(summary: TypeSummary, values: Sequence[ValueSummary]) -> Markup:
    outlying = {summary.units[outlier.group] for each in summary.values.values()
                for outlier in each.outlying_units}
    changed = {summary.units[change.unit] for each in summary.values.values()
               for change in each.changes}
    heads = ['unit', 'logs', *(readable_name(each.name) for each in values), 'remark']
    rows = []
    for place, name in enumerate(summary.units):
        logs = sum(each['unit'] == name for each in summary.records)
        remark = ', '.join([*(['stands out'] if name in outlying else []),
                            *(['changed'] if name in changed else [])])
        rows.append([_cell(name), _cell(str(logs), logs),
                     *(_interval_cell(each, each.units, place) for each in values), _cell(remark)])
    return _table(heads, rows)


def _log_section(records: Sequence[Mapping[str, Any]]) -> Markup:
    names = list(dict.fromkeys(name for each in records for name in each.get('values', ())))
    heads = ['log', 'type', 'unit', 'drive', 'date', *map(readable_name, names), 'diagnosis',
             'remark']
    rows = []
    for each in records:
        file = each['log'].rpartition('/')[2]
        link = element('a', file, href=each['page']) if each.get('page') else file
        values = each.get('values', {})
        shown = [_value_cell(values[name], name) if name in values else _cell('')
                 for name in names]
        rows.append([element('td', link, data_key=file),
                     *(_cell(each[key]) for key in ('type', 'unit', 'drive', 'date')), *shown,
                     _cell((each.get('diagnosis') or {}).get('verdict', '')),
                     _cell(each['reason'])])
    return element('section', element('h2', 'Logs'), _table(heads, rows))


def _value_cell(value: Mapping[str, Any], name: str) -> Markup:
    size = NORMAL_QUANTILE_975 * value['deviation']
    return _cell(str(format_quantity(Estimate(value['value'], (
        value['value'] - size, value['value'] + size), value['unit']), name)), value['value'])


def _table(heads: Sequence[str], rows: Sequence[Sequence[Markup]]) -> Markup:
    head = element('tr', *(element('th', each, scope='col') for each in heads))
    table = element('table', element('thead', head),
                    element('tbody', *(element('tr', *row) for row in rows)), class_='sortable')
    return element('div', table,
                   class_=f'scroll fold{" tall" * (len(rows) > _MAX_UNSCROLLED_ROWS)}',
                   tabindex='0')


def _cell(text: str, key: float | None = None) -> Markup:
    """Return a cell with its sort key."""
    return element('td', text, data_key=text if key is None else f'{key:.9g}')


def _interval_cell(value: ValueSummary, interval: Interval, index: int) -> Markup:
    return _cell(format_interval(interval, index, value.unit, value.name),
                 float(interval.value[index]))


def _component_cell(value: ValueSummary, component: Component | None) -> Markup:
    if component is None:
        return _cell('not shown', -1.0)
    low, high = (format_amount(end, value.unit, value.name)
                 for end in (component.low, component.high))
    text = (f'{format_amount(component.estimate, value.unit, value.name)} ({low} to '
            f'{high})' if component.low > 0.0 else f'less than {high}')
    return _cell(text, component.estimate)


def _interval_chart(value: ValueSummary, name: str, kind: str, names: Sequence[str],
                    interval: Interval, style: str) -> Chart:
    unit, factor = display_unit(value.unit, value.name)
    middle = 0.5 * (interval.high + interval.low)
    half = 0.5 * (interval.high - interval.low) / NORMAL_QUANTILE_975
    return Chart(name, f'{readable_name(value.name)} by {kind}',
                 f'{kind.capitalize()}s whose bars do not overlap differ; the sign of a bar '
                 f'across zero is not determined. {kind.capitalize()}s: {", ".join(names)}.',
                 kind, '', np.arange(1.0, len(names) + 1.0), readable_name(value.name), unit,
                 [Line(kind, style, factor * middle, factor * half, draw_dots=True)],
                 x_names=names)


def _dates_chart(found: TypeSummary, each: ValueSummary, name: str) -> Chart:
    """Return the values of logs, less those of their units, over their dates."""
    unit, factor = display_unit(each.unit, each.name)
    dated = [record for record in each.records if record['date']]
    place = np.array([found.dates.index(record['date']) + 1.0 for record in dated])
    value: Array = np.array(
        [record['slow' if each.is_slow else 'values'][each.name]['value']
         - float(each.units.value[found.units.index(record['unit'])]) for record in dated])
    return Chart(name, f'{readable_name(each.name)} less that of the unit',
                 f'dates: {", ".join(found.dates)}', 'date', '', place, readable_name(each.name),
                 unit, [Line('log', 'measured', factor * value, draw_dots=True)],
                 x_names=found.dates)


def table_files(types: Sequence[TypeSummary],
                records: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """
    Return the content of files by name: values of logs, and of units, one row each, in SI.

    Parameters
    ----------
    types : as `summary.summarize_types` returns them
    records : of all logs

    """
    found = {}
    for name, rows in (('logs', list(map(_log_row, records))), ('units', list(_unit_rows(types)))):
        columns = list(dict.fromkeys(key for row in rows for key in row))
        if not columns:
            continue
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
        found[f'{name}.csv'] = text.getvalue().encode()
        packed = _parquet_content(columns, rows)
        if packed is not None:
            found[f'{name}.parquet'] = packed
    return found


def _log_row(record: Mapping[str, Any]) -> dict[str, Any]:
    row = {key: record.get(key) for key in _COLUMNS}
    for kind in ('values', 'slow'):
        for name, value in record.get(kind, {}).items():
            row[name], row[f'{name}_deviation'] = value['value'], value['deviation']
    return row


def _unit_rows(types: Sequence[TypeSummary]) -> Iterator[dict[str, Any]]:
    for found in types:
        for place, unit in enumerate(found.units):
            for name, each in found.values.items():
                outlying = {one.group for one in each.outlying_units}
                yield {'type': found.name, 'unit': unit, 'value': name, 'si_unit': each.unit,
                       'estimate': float(each.units.value[place]),
                       'standard_deviation': float(each.units.deviation[place]),
                       'low': float(each.units.low[place]), 'high': float(each.units.high[place]),
                       'from_type': float(each.type_deviation.value[place]),
                       'next_low': float(each.next_power_on.low[place]),
                       'next_high': float(each.next_power_on.high[place]),
                       'stands_out': place in outlying,
                       **{f'{over}_slope{end}': float(value[place])
                          for over, slope in each.unit_slopes.items() for end, value in (
                              ('', slope.value), ('_low', slope.low), ('_high', slope.high))}}


def _parquet_content(columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> bytes | None:
    """Return a table in Parquet; None where pyarrow is not installed."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return None
    stream = io.BytesIO()
    parquet.write_table(pyarrow.table({name: [row.get(name) for row in rows] for name in columns}),
                        stream)
    return stream.getvalue()
