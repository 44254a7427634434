# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Tables of a fleet for other programs: CSV always, and Parquet where pyarrow is installed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import csv
import io
from typing import Any

from gyro_calibration.fleet.summary import TypeFound

Row = dict[str, Any]
_LOG = ('log', 'type', 'unit', 'drive', 'date', 'temperature', 'status', 'reason', 'method',
        'samples', 'duration_s', 'sha256', 'page')


def tables(types: Sequence[TypeFound], records: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """
    Return the content of files by name: values of logs, and of units, one row each, in SI.

    Parameters
    ----------
    types : as `summary.summarized` returns them
    records : of all logs

    """
    found = {}
    for name, rows in (('logs', list(map(_of_log, records))), ('units', list(_of_units(types)))):
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


def _of_log(record: Mapping[str, Any]) -> Row:
    row = {key: record.get(key) for key in _LOG}
    for kind in ('values', 'slow'):
        for name, value in record.get(kind, {}).items():
            row[name], row[f'{name}_deviation'] = value['value'], value['deviation']
    return row


def _of_units(types: Sequence[TypeFound]) -> Iterable[Row]:
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


def _parquet(columns: Sequence[str], rows: Sequence[Row]) -> bytes | None:
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
