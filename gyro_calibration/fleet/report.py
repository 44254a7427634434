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

from gyro_calibration.diagnosis.charts import Chart, draw, element, joined, Line, Markup
from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.report import page
from gyro_calibration.diagnosis.words import amount, for_people, quantity, sentence, spoken
from gyro_calibration.fleet.pooling import Component, DRIVES, Interval, POWER_ONS, UNITS
from gyro_calibration.fleet.summary import Found, in_words, sentences, TypeFound
from gyro_calibration.logs.log import Array, NORMAL_95
import numpy as np

_SPREADS = ((UNITS, 'between units'), (POWER_ONS, 'between power-ons'),
            (DRIVES, 'common to a drive'))
_PER = {'age': 'year', 'temperature': 'K'}
#: Tables with more rows are scrolled inside the page and have a search field.
_LONG = 12
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


def report(types: Sequence[TypeFound], records: Sequence[Mapping[str, Any]]) -> str:
    """
    Return the page, HTML in UTF-8.

    Parameters
    ----------
    types : as `summary.summarized` returns them
    records : of all logs, including excluded ones

    """
    used = sum(len(found.records) for found in types)
    title = (f'{used} logs of {sum(len(found.units) for found in types)} units of '
             f'{len(types)} {"type" if len(types) == 1 else "types"}')
    about = f'{len(records) - used} more logs are excluded.' if used < len(records) else None
    body = joined(
        element('header', element('p', 'Fleet', class_='about'), element('h1', title),
                element('p', about, class_='gained') if about else None),
        element('main', *(part for place, found in enumerate(types)
                          for part in _type(found, place)), _logs(records)),
        _STYLE, _SCRIPT)
    return page(f'Fleet: {title}', body)


def _type(found: TypeFound, place: int) -> Iterator[Markup]:
    name = found.name or 'Type not stated'
    items = [element('li', sentence(text)) for text in sentences(found)]
    yield element('section', element('h2', name), element('ul', *items), _variances(found))
    values = [each for each in found.values.values() if not each.slow]
    yield element(
        'section', element('h2', f'{name}: units'),
        element('p', 'Bars: 95 % intervals of the mean of a unit over its power-ons.',
                class_='quiet'),
        element('div', *(draw(_chart(each, f't{place}-{each.name}-units', 'unit', found.units,
                                     each.units, 'after')) for each in values), class_='pairs'),
        _units(found, values))
    shared = [each for each in found.values.values() if DRIVES in each.components]
    if shared:
        yield element(
            'section', element('h2', f'{name}: drives'),
            element('p', 'An error that all units of a drive have in common is assigned to its '
                    'reference or to the vehicle.', class_='quiet'),
            element('div', *(draw(_chart(each, f't{place}-{each.name}-drives', 'drive',
                                         found.drives, each.drives, 'before'))
                             for each in shared), class_='pairs'))
    if len(found.dates) > 1:
        yield element('section', element('h2', f'{name}: over time'), element('div', *(
            draw(_dates_chart(found, each, f't{place}-{each.name}-dates')) for each in values),
            class_='pairs'))


def _variances(found: TypeFound) -> Markup:
    drifts = any(each.slopes for each in found.values.values())
    heads = ['value', 'mean of the type', 'one more unit', *(text for _, text in _SPREADS),
             *(['drift'] if drifts else [])]
    rows = [[_cell(spoken(each.name)), _estimate(each, each.mean, 0),
             _estimate(each, each.new_unit, 0),
             *(_spread(each, each.components.get(name)) for name, _ in _SPREADS),
             *([_cell('; '.join(
                 in_words(slope, 0, f'{each.unit}/{_PER[name]}', each.name)
                 for name, slope in each.slopes.items()))] if drifts else [])]
            for each in found.values.values()]
    return _table(heads, rows)


def _units(found: TypeFound, values: Sequence[Found]) -> Markup:
    odd = {found.units[outlier.number] for each in found.values.values()
           for outlier in each.outlying_units}
    changed = {found.units[change.unit] for each in found.values.values()
               for change in each.changed}
    heads = ['unit', 'logs', *(spoken(each.name) for each in values), 'remark']
    rows = []
    for place, name in enumerate(found.units):
        logs = sum(each['unit'] == name for each in found.records)
        remark = ', '.join([*(['stands out'] if name in odd else []),
                            *(['changed'] if name in changed else [])])
        rows.append([_cell(name), _cell(str(logs), logs),
                     *(_estimate(each, each.units, place) for each in values), _cell(remark)])
    return _table(heads, rows)


def _logs(records: Sequence[Mapping[str, Any]]) -> Markup:
    names = list(dict.fromkeys(name for each in records for name in each.get('values', ())))
    heads = ['log', 'type', 'unit', 'drive', 'date', *map(spoken, names), 'diagnosis', 'remark']
    rows = []
    for each in records:
        file = each['log'].rpartition('/')[2]
        link = element('a', file, href=each['page']) if each.get('page') else file
        values = each.get('values', {})
        shown = [_of_log(values[name], name) if name in values else _cell('')
                 for name in names]
        rows.append([element('td', link, data_key=file),
                     *(_cell(each[key]) for key in ('type', 'unit', 'drive', 'date')), *shown,
                     _cell((each.get('diagnosis') or {}).get('verdict', '')),
                     _cell(each['reason'])])
    return element('section', element('h2', 'Logs'), _table(heads, rows))


def _of_log(value: Mapping[str, Any], name: str) -> Markup:
    size = NORMAL_95 * value['deviation']
    return _cell(str(quantity(Estimate(value['value'], (
        value['value'] - size, value['value'] + size), value['unit']), name)), value['value'])


def _table(heads: Sequence[str], rows: Sequence[Sequence[Markup]]) -> Markup:
    head = element('tr', *(element('th', each, scope='col') for each in heads))
    table = element('table', element('thead', head),
                    element('tbody', *(element('tr', *row) for row in rows)), class_='sortable')
    return element('div', table, class_=f'scroll fold{" tall" * (len(rows) > _LONG)}',
                   tabindex='0')


def _cell(text: str, key: float | None = None) -> Markup:
    """Return a cell with its sort key."""
    return element('td', text, data_key=text if key is None else f'{key:.9g}')


def _estimate(each: Found, of: Interval, place: int) -> Markup:
    return _cell(in_words(of, place, each.unit, each.name), float(of.value[place]))


def _spread(each: Found, of: Component | None) -> Markup:
    if of is None:
        return _cell('not shown', -1.0)
    low, high = (amount(end, each.unit, each.name) for end in (of.low, of.high))
    text = (f'{amount(of.estimate, each.unit, each.name)} ({low} to {high})' if of.low > 0.0
            else f'less than {high}')
    return _cell(text, of.estimate)


def _chart(each: Found, name: str, kind: str, names: Sequence[str], of: Interval,
           style: str) -> Chart:
    unit, factor = for_people(each.unit, each.name)
    middle, half = 0.5 * (of.high + of.low), 0.5 * (of.high - of.low) / NORMAL_95
    return Chart(name, f'{spoken(each.name)} by {kind}',
                 f'{kind.capitalize()}s whose bars do not overlap differ; the sign of a bar '
                 f'across zero is not determined. {kind.capitalize()}s: {", ".join(names)}.',
                 kind, '',
                 np.arange(1.0, len(names) + 1.0), spoken(each.name), unit,
                 [Line(kind, style, factor * middle, factor * half, dots=True)], names=names)


def _dates_chart(found: TypeFound, each: Found, name: str) -> Chart:
    """Return the values of logs, less those of their units, over their dates."""
    unit, factor = for_people(each.unit, each.name)
    dated = [record for record in each.records if record['date']]
    place = np.array([found.dates.index(record['date']) + 1.0 for record in dated])
    value: Array = np.array([
        record['slow' if each.slow else 'values'][each.name]['value']
        - float(each.units.value[found.units.index(record['unit'])]) for record in dated])
    return Chart(name, f'{spoken(each.name)} less that of the unit',
                 f'dates: {", ".join(found.dates)}', 'date', '', place, spoken(each.name), unit,
                 [Line('log', 'measured', factor * value, dots=True)], names=found.dates)


def tables(types: Sequence[TypeFound], records: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """
    Return the content of files by name: values of logs, and of units, one row each, in SI.

    Parameters
    ----------
    types : as `summary.summarized` returns them
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
        packed = _parquet(columns, rows)
        if packed is not None:
            found[f'{name}.parquet'] = packed
    return found


def _log_row(record: Mapping[str, Any]) -> dict[str, Any]:
    row = {key: record.get(key) for key in _COLUMNS}
    for kind in ('values', 'slow'):
        for name, value in record.get(kind, {}).items():
            row[name], row[f'{name}_deviation'] = value['value'], value['deviation']
    return row


def _unit_rows(types: Sequence[TypeFound]) -> Iterator[dict[str, Any]]:
    for found in types:
        for place, unit in enumerate(found.units):
            for name, each in found.values.items():
                outlying = {one.number for one in each.outlying_units}
                yield {'type': found.name, 'unit': unit, 'value': name, 'si_unit': each.unit,
                       'estimate': float(each.units.value[place]),
                       'standard_deviation': float(each.units.deviation[place]),
                       'low': float(each.units.low[place]), 'high': float(each.units.high[place]),
                       'from_type': float(each.from_type.value[place]),
                       'next_low': float(each.next_log.low[place]),
                       'next_high': float(each.next_log.high[place]),
                       'stands_out': place in outlying,
                       **{f'{over}_slope{end}': float(value[place])
                          for over, slope in each.unit_slopes.items() for end, value in (
                              ('', slope.value), ('_low', slope.low), ('_high', slope.high))}}


def _parquet(columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> bytes | None:
    """Return a table in Parquet; None where pyarrow is not installed."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return None
    stream = io.BytesIO()
    parquet.write_table(pyarrow.table({
        name: [row.get(name) for row in rows] for name in columns}), stream)
    return stream.getvalue()
