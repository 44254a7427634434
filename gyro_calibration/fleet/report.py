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

from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.report import (
    Chart,
    draw_chart,
    element,
    join_markup,
    Line,
    Markup,
    render_page,
)
from gyro_calibration.diagnosis.words import (
    as_sentence,
    display_unit,
    format_quantity,
    readable_name,
)
from gyro_calibration.fleet.pooling import Interval
from gyro_calibration.fleet.summary import (
    COMPONENT_LABELS,
    describe_type,
    TypeSummary,
    ValueSummary,
)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
import numpy as np

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
    """Return the page, HTML in UTF-8; the records are of all logs, including excluded ones."""
    used = sum(len(found.records) for found in types)
    title = (f'{used} logs of {sum(len(found.units) for found in types)} units of '
             f'{len(types)} {"type" if len(types) == 1 else "types"}')
    about = f'{len(records) - used} more logs are excluded.' if used < len(records) else None
    body = join_markup(
        element('header', element('p', 'Fleet', class_='about'), element('h1', title),
                element('p', about, class_='gained') if about else None),
        element('main', *(part for place, found in enumerate(types)
                          for part in _type_sections(found, f't{place}')), _log_section(records)),
        _STYLE, _SCRIPT)
    return render_page(f'Fleet: {title}', body)


def _type_sections(summary: TypeSummary, key: str) -> Iterator[Markup]:
    """Give the sections of a type: its values, units, drives and dates."""
    name = summary.name or 'Type not stated'
    items = [element('li', as_sentence(text)) for text in describe_type(summary)]
    yield element('section', element('h2', name), element('ul', *items), _variance_table(summary))
    values = [each for each in summary.values.values() if not each.is_slow]
    units = [_interval_chart(each, key, 'unit', each.units, 'after') for each in values]
    drives = [_interval_chart(each, key, 'drive', each.drives, 'before')
              for each in summary.values.values() if each.drives]
    dates = [_dates_chart(summary, each, key) for each in values if len(summary.dates) > 1]
    for heading, charts, text, more in (
            ('units', units, 'Bars: 95 % intervals of the mean of a unit over its power-ons.',
             _unit_table(summary, values)),
            ('drives', drives, 'An error that all units of a drive have in common is assigned to '
             'its reference or to the vehicle.', None),
            ('over time', dates, '', None)):
        if charts or more:
            yield element('section', element('h2', f'{name}: {heading}'),
                          element('p', text, class_='quiet') if text else None,
                          element('div', *map(draw_chart, charts), class_='pairs'), more)


def _variance_table(summary: TypeSummary) -> Markup:
    per = {'age': '/year', 'temperature': '/K'}
    drifts = any(each.slopes for each in summary.values.values())
    heads = ['value', 'mean of the type', 'one more unit', *COMPONENT_LABELS.values(),
             *(['drift'] if drifts else [])]
    rows = []
    for each in summary.values.values():
        drift = '; '.join(each.format_interval(slope, per[name])
                          for name, slope in each.slopes.items())
        rows.append([
            _cell(readable_name(each.name)), _interval_cell(each, each.mean),
            _interval_cell(each, each.new_unit),
            *(_cell(each.format_component(name), each.components[name].estimate
                    if name in each.components else -1.0) for name in COMPONENT_LABELS),
            *([_cell(drift)] if drifts else [])])
    return _table(heads, rows)


def _unit_table(summary: TypeSummary, values: Sequence[ValueSummary]) -> Markup:
    alarms = {'stands out': {alarm.name for each in summary.values.values()
                             for alarm in each.outlying_units},
              'changed': {alarm.name for each in summary.values.values()
                          for alarm in each.changes}}
    heads = ['unit', 'logs', *(readable_name(each.name) for each in values), 'remark']
    rows = []
    for name in summary.units:
        logs = sum(each['unit'] == name for each in summary.records)
        rows.append([_cell(name), _cell(str(logs), logs),
                     *(_interval_cell(each, each.units.get(name)) for each in values),
                     _cell(', '.join(text for text, names in alarms.items() if name in names))])
    return _table(heads, rows)


def _log_section(records: Sequence[Mapping[str, Any]]) -> Markup:
    names = list(dict.fromkeys(name for each in records for name in each.get('values', ())))
    heads = ['log', 'type', 'unit', 'drive', 'date', *map(readable_name, names), 'diagnosis',
             'remark']
    rows = []
    for each in records:
        file = each['log'].rpartition('/')[2]
        link = element('a', file, href=each['page']) if each.get('page') else file
        cells = []
        for name in names:
            value = each.get('values', {}).get(name)
            cells.append(_cell('') if value is None else _cell(str(format_quantity(
                Estimate.from_half_width(value['value'], NORMAL_QUANTILE_975 * value['deviation'],
                                         value['unit']), name)), value['value']))
        rows.append([element('td', link, data_key=file),
                     *(_cell(each[key]) for key in ('type', 'unit', 'drive', 'date')), *cells,
                     _cell((each.get('diagnosis') or {}).get('verdict', '')),
                     _cell(each['reason'])])
    return element('section', element('h2', 'Logs'), _table(heads, rows))


def _table(heads: Sequence[str], rows: Sequence[Sequence[Markup]]) -> Markup:
    """Return a table to sort; one of many rows is scrolled and has a search field."""
    head = element('tr', *(element('th', each, scope='col') for each in heads))
    table = element('table', element('thead', head),
                    element('tbody', *(element('tr', *row) for row in rows)), class_='sortable')
    return element('div', table, class_=f'scroll fold{" tall" * (len(rows) > 12)}', tabindex='0')


def _cell(text: str, key: float | None = None) -> Markup:
    """Return a cell with its sort key."""
    return element('td', text, data_key=text if key is None else f'{key:.9g}')


def _interval_cell(value: ValueSummary, interval: Interval | None) -> Markup:
    return (_cell('') if interval is None
            else _cell(value.format_interval(interval), interval.value))


def _interval_chart(value: ValueSummary, key: str, kind: str, intervals: Mapping[str, Interval],
                    style: str) -> Chart:
    """Return the intervals of units or drives."""
    unit, factor = display_unit(value.unit, value.name)
    low, high = (np.array([getattr(each, end) for each in intervals.values()])
                 for end in ('low', 'high'))
    lines = [Line(kind, style, 0.5 * factor * (high + low),
                  0.5 * factor * (high - low) / NORMAL_QUANTILE_975, draw_dots=True)]
    return Chart(f'{key}-{value.name}-{kind}s', f'{readable_name(value.name)} by {kind}',
                 f'{kind.capitalize()}s whose bars do not overlap differ; the sign of a bar '
                 f'across zero is not determined. {kind.capitalize()}s: {", ".join(intervals)}.',
                 kind, '', np.arange(1.0, len(intervals) + 1.0), readable_name(value.name), unit,
                 lines, x_names=list(intervals))


def _dates_chart(summary: TypeSummary, value: ValueSummary, key: str) -> Chart:
    """Return the values of logs, less those of their units, over their dates."""
    unit, factor = display_unit(value.unit, value.name)
    dated = [each for each in value.records if each['date']]
    place = np.array([summary.dates.index(each['date']) + 1.0 for each in dated])
    difference: Array = np.array([
        each['values'][value.name]['value'] - value.units[each['unit']].value for each in dated])
    return Chart(f'{key}-{value.name}-dates', f'{readable_name(value.name)} less that of the unit',
                 f'dates: {", ".join(summary.dates)}', 'date', '', place,
                 readable_name(value.name), unit,
                 [Line('log', 'measured', factor * difference, draw_dots=True)],
                 x_names=summary.dates)


def table_files(types: Sequence[TypeSummary],
                records: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """
    Return the content of files by name: values of logs, and of units, one row each, in SI.

    They are CSV, and Parquet where pyarrow is installed.

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
        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError:
            continue
        stream = io.BytesIO()
        parquet.write_table(
            pyarrow.table({column: [row.get(column) for row in rows] for column in columns}),
            stream)
        found[f'{name}.parquet'] = stream.getvalue()
    return found


def _log_row(record: Mapping[str, Any]) -> dict[str, Any]:
    row = {key: record.get(key) for key in _COLUMNS}
    for kind in ('values', 'slow'):
        for name, value in record.get(kind, {}).items():
            row[name], row[f'{name}_deviation'] = value['value'], value['deviation']
    return row


def _unit_rows(types: Sequence[TypeSummary]) -> Iterator[dict[str, Any]]:
    for found in types:
        for unit in found.units:
            for name, each in found.values.items():
                if unit not in each.units:
                    continue
                estimate, following = each.units[unit], each.next_power_on[unit]
                row = {'type': found.name, 'unit': unit, 'value': name, 'si_unit': each.unit,
                       'estimate': estimate.value, 'standard_deviation': estimate.deviation,
                       'low': estimate.low, 'high': estimate.high,
                       'from_type': each.type_deviation[unit].value,
                       'next_low': following.low, 'next_high': following.high,
                       'stands_out': unit in {alarm.name for alarm in each.outlying_units}}
                for over, slopes in each.unit_slopes.items():
                    row |= {f'{over}_slope': slopes[unit].value,
                            f'{over}_slope_low': slopes[unit].low,
                            f'{over}_slope_high': slopes[unit].high}
                yield row
