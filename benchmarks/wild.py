# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Diagnosis on real drives: the model of one part of a recording, judged by another part.

    python benchmarks/wild.py [--drives wid_02,rc_car_h_unit2] [--json FILE]

The recordings are `wheeled_drives` of GYRO_CALIBRATION_DATA (see README.md there). Each half of a
drive is diagnosed, and its model corrects the other half. The error is that of the heading over
60 s against the course, at the lag that is best for each model. It is given over the better one of
doing nothing and of a robust least squares of bias, scale and lag, which saw the same part.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import json
import math
import os
from pathlib import Path
import time

from gyro_calibration.diagnosis.findings import Diagnosis, Finding
from gyro_calibration.diagnosis.pipeline import diagnose
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, read_log, select_rows
import numpy as np
from scipy.optimize import least_squares

WINDOW = 60.0
LAGS = np.arange(-1.5, 1.501, 0.05)


def halves(log: Log) -> tuple[Log, Log]:
    """Return a log in two halves of the same duration."""
    middle = int(np.searchsorted(log.time, 0.5 * (log.time[0] + log.time[-1])))
    return select_rows(log, slice(0, middle)), select_rows(log, slice(middle, None))


def fixes(log: Log) -> Array:
    """Return the rows with a course, thinned to at most ten in a second."""
    known = np.flatnonzero(np.isfinite(log.reference_heading))
    number = np.floor(10.0 * log.time[known] + 1e-6)
    return known[np.diff(number, prepend=-1.0) > 0.0]


def robust_least_squares(log: Log) -> tuple[float, float]:
    """Return (1 + s) and b of heading = (1 + s) integral + b t + c at the best lag."""
    at, turned = fixes(log), integrate(log.time, log.output)
    known, best = log.reference_heading[at], (math.inf, 1.0, 0.0)
    for lag in LAGS:
        gyro = np.interp(log.time[at] - lag, log.time, turned)
        columns = np.column_stack([gyro - gyro[0], log.time[at] - log.time[at[0]],
                                   np.ones(len(at))])
        start = np.linalg.lstsq(columns, known, rcond=None)[0]
        found = least_squares(lambda x, columns=columns: columns @ x - known, start,
                              loss='soft_l1', f_scale=DEGREE)
        best = min(best, (found.cost, found.x[0], found.x[1]))
    return best[1], best[2]


def error(log: Log, rate: Array) -> float:
    """
    Return the root mean square of the error of the heading over 60 s, rad, at the best lag.

    Where the course is known over less than 80 s, it is that over three quarters of these.

    """
    at, turned = fixes(log), integrate(log.time, rate)
    stamps = log.time[at]
    window = min(WINDOW, 0.75 * (stamps[-1] - stamps[0]))
    later = np.searchsorted(stamps, stamps + window)
    both = np.flatnonzero(later < len(at))
    both = both[stamps[later[both]] - stamps[both] < window + 1.0]
    squares = []
    for lag in LAGS:
        off = log.reference_heading[at] - np.interp(stamps - lag, log.time, turned)
        squares.append(np.mean((off[later[both]] - off[both]) ** 2))
    return math.sqrt(min(squares))


def sets(found: Diagnosis) -> list[tuple[Finding, set[str]]]:
    """Return the established causes with their sets; those of the reference or record, too."""
    return [(each, {each.effect, *each.ambiguous_with}) for each in found.findings
            if getattr(each, 'status', 'established') == 'established']


def agree(one: Finding, other: Finding) -> bool:
    """Tell whether two values of a cause are within their intervals of 95 % of each other."""
    a, b = one.parameters[one.effect], other.parameters[one.effect]
    half = math.hypot(*(0.5 * (each.interval[1] - each.interval[0]) for each in (a, b)))
    return abs(a.estimate - b.estimate) <= half + 1e-9 * abs(a.estimate)


def answer(log: Log, name: str) -> tuple[Diagnosis | None, float]:
    begin = time.monotonic()
    try:
        found = diagnose([log], np.random.default_rng(0))
    except DataRefused as refusal:
        print(f'{name}: refused: {refusal}', flush=True)
        found = None
    return found, time.monotonic() - begin


def judged(name: str, parts: Sequence[Log]) -> Iterator[dict[str, object]]:
    """Judge the models of two parts, each by the other part."""
    found = [answer(part, f'{name} {place}') for place, part in enumerate(parts, 1)]
    for place in (0, 1):
        mine, seconds = found[place]
        other, peer = parts[1 - place], found[1 - place][0]
        scale, bias = robust_least_squares(parts[place])
        plain = {'nothing': error(other, other.output),
                 'squares': error(other, scale * other.output + bias)}
        row: dict[str, object] = {
            'drive': name, 'part': place + 1, 'answered': mine is not None,
            'seconds': round(seconds, 1),
            **{key: round(value / DEGREE, 3) for key, value in plain.items()}}
        if mine is not None and (rate := compensate_log(mine.model, other)) is not None:
            ours = error(other, rate)
            row |= {'model': round(ours / DEGREE, 3),
                    'ratio': round(ours / min(plain.values()), 3),
                    'verdict': mine.verdict, 'causes': [each.effect for each, _ in sets(mine)]}
            if peer is not None:
                twins = [next((b for b, more in sets(peer) if more & names), None)
                         for _, names in sets(mine)]
                same = [(each, twin) for (each, _), twin in zip(sets(mine), twins)
                        if twin is not None and twin.effect == each.effect
                        and each.effect in each.parameters]
                row |= {'again': sum(twin is not None for twin in twins), 'values': len(same),
                        'agree': sum(agree(*both) for both in same)}
        yield row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--drives', help='names, with commas between; default: all')
    parser.add_argument('--json', help='file for the rows')
    given = parser.parse_args()
    folder = Path(os.environ['GYRO_CALIBRATION_DATA']) / 'wheeled_drives'
    names = sorted(path.name.removesuffix('.csv.gz') for path in folder.glob('*.csv.gz'))
    chosen = (given.drives.split(',') if given.drives
              else [name for name in names if not name.endswith('_as_recorded')])
    table = []
    for name in chosen:
        for row in judged(name, halves(read_log(folder / f'{name}.csv.gz'))):
            table.append(row)
            print(row, flush=True)
    ratios = np.array([row.get('ratio', np.inf) for row in table], dtype=float)
    causes, again, values, same = (
        sum(len(x) if isinstance(x := row.get(key, 0), list) else int(x) for row in table)
        for key in ('causes', 'again', 'values', 'agree'))
    print(f'{len(table)} parts, {sum(bool(row["answered"]) for row in table)} answered; ratio: '
          f'median {np.median(ratios):.2f}, '
          f'nine in ten {np.quantile(ratios, 0.9, method="higher"):.2f}, '
          f'worst {ratios.max():.2f}; {again} of {causes} causes in the other part too; '
          f'{same} of {values} values agree; '
          f'longest {max(float(row["seconds"]) for row in table):.0f} s')
    if given.json:
        Path(given.json).write_text(json.dumps(table, indent=1))


if __name__ == '__main__':
    main()
