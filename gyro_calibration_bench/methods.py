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
Methods of the bench: gyro_calibration, and greedy selection by BIC.

A method takes the paths of the logs of a case and the known model, or None, and returns the causes
that it names and whether there is unexplained structure.

The baseline uses the formulas of the generator, on means over half a second, and assumes white
noise. It has no columns for faults of samples, noise figures, saturation, quantization, slips,
tones, and a wrong unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from gyro_calibration_bench.hidden import FORMS, Session
from gyro_calibration_bench.hidden.effects import Shapes, WITHOUT_COLUMN
from gyro_calibration_bench.hidden.motion import Motion
from gyro_calibration_bench.scores import NamedCause
import numpy as np
from scipy.ndimage import uniform_filter1d

#: Bias, scale_factor_error, angle_random_walk, bias_instability and rate_random_walk, in SI.
KnownModel = Mapping[str, float]
Answer = tuple[list[NamedCause], bool]

#: Single events, which one log cannot establish.
SINGLE_EVENTS = ('bias_step', 'reference_slip')

#: Length of the means, s.
BLOCK_DURATION = 0.5
#: Small sizes at which nonlinear effects are proportional to their size.
LINEAR_SIZES = {'time_offset': 0.02, 'bandwidth': 0.02, 'clock_rate': 1e-4}
#: Columns with a larger correlation are ambiguous.
AMBIGUOUS_CORRELATION = 0.99
WITHOUT_CANDIDATES = {*WITHOUT_COLUMN, 'saturation', 'interference_tone', 'reference_slip'}


# gyro_calibration

def answer_of_finding(finding: Any) -> NamedCause:
    """Return a finding of gyro_calibration as an answer of the bench."""
    size = finding.parameters.get(finding.effect)
    return NamedCause(finding.effect, tuple(finding.ambiguous_with), size and size.estimate,
                      size and tuple(size.interval))


def reported_findings(findings: Sequence[Any]) -> list[Any]:
    """Return the established findings, and suspected single events."""
    return [each for each in findings if each.status == 'established'
            or each.effect in SINGLE_EVENTS and each.p_value < 0.01]


def known_model(known: KnownModel) -> Any:
    """Return what is known of a gyro as a model."""
    from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
    from gyro_calibration.model.gyro_model import GyroModel, Term
    from gyro_calibration.model.noise import Noise
    terms = Term(BIAS, (known['bias'],)), Term(SCALE_FACTOR_ERROR, (known['scale_factor_error'],))
    return GyroModel(terms, noise=Noise(known['angle_random_walk'], known['bias_instability'],
                                        known['rate_random_walk']))


def gyro_calibration(logs: Sequence[Path], known: KnownModel | None) -> Answer:
    from gyro_calibration import read_log
    from gyro_calibration.diagnosis.log_diagnosis import diagnose
    found = diagnose([read_log(path) for path in logs], np.random.default_rng(0),
                     None if known is None else known_model(known))
    return ([answer_of_finding(each) for each in reported_findings(found.findings)],
            bool(found.unexplained))


# the baseline

@dataclass(frozen=True)
class Problem:
    """A least squares problem, without biases of the logs and scale unless a model has them."""

    error: np.ndarray  # output less reference, shape (n,), rad/s
    columns: np.ndarray  # shape (n, m)
    # for each column the effect and the size that its coefficient 1 has, nan if none
    owners: tuple[tuple[str, float], ...]
    nuisances: int  # number of values that were taken out


def read_session(path: Path) -> tuple[Session, np.ndarray, np.ndarray]:
    """Return the conditions of a log at even times, means of the error, and which are valid."""
    columns: Any = np.genfromtxt(path, delimiter=',', names=True)
    stamps = columns['time_s']
    interval = float(np.median(np.diff(stamps)))
    time = np.arange(stamps[0], stamps[-1], interval)

    def evenly(name: str) -> np.ndarray:
        known = np.isfinite(columns[name])
        return np.interp(time, stamps[known], columns[name][known])
    if 'reference_rate_rad_s' in columns.dtype.names:
        rate = evenly('reference_rate_rad_s')
        heading = np.cumsum(rate) * interval
        missing = np.zeros(len(time), dtype=bool)
    else:
        heading = evenly('reference_heading_rad')
        rate = uniform_filter1d(np.gradient(heading, interval), round(BLOCK_DURATION / interval))
        missing = np.interp(time, stamps, columns['reference_heading_rad']) != heading
    force = evenly('acceleration_mps2')
    slow = uniform_filter1d(force, round(1.0 / interval))
    motion = Motion(lambda at: np.interp(at, time, rate), lambda at: np.interp(at, time, heading))
    moving = np.abs(rate) > 1e-9
    each = Session(motion, time - time[0], rate, heading, evenly('temperature_degc'),
                   evenly('supply_v'), slow, force - slow, moving)
    error = block_means(evenly('gyro_rad_s') - rate, interval)
    return each, error, block_means(missing.astype(float), interval) == 0.0


def block_means(values: np.ndarray, interval: float) -> np.ndarray:
    size = round(BLOCK_DURATION / interval)
    return values[:len(values) // size * size].reshape(-1, size).mean(axis=1)


def propose_candidates(each: Session) -> list[tuple[str, float, Shapes, float]]:
    """Return candidates: effect, size, shapes, and the size of coefficient 1, nan if none."""
    duration, top = float(each.time[-1]), float(np.abs(each.rate).max())
    found: list[tuple[str, float, Shapes, float]] = []
    grids: dict[str, list[Shapes]] = {
        'heading_sensitivity': [{'phase': 0.0}, {'phase': 0.5 * math.pi}],
        'reference_once_per_rev': [{'phase': 0.0}, {'phase': 0.5 * math.pi}],
        'thermal_lag': [{'time_constant': part * duration} for part in (0.03, 0.1, 0.3)],
        'warm_up': [{'time_constant': part * duration} for part in (0.03, 0.06, 0.12, 0.25)],
        'bias_step': [{'run': 0, 'step_time': part * duration}
                      for part in np.linspace(0.15, 0.85, 29)]}
    for name in FORMS:
        if name in WITHOUT_CANDIDATES:
            continue
        if name == 'dead_zone':
            found += [(name, part * top, {}, math.nan) for part in (0.003, 0.01, 0.03, 0.1, 0.3)]
        elif name == 'sine_response':
            found.append((name, 1.0 / top, {}, math.nan))
        else:
            size = LINEAR_SIZES.get(name, 1.0)
            # a wave has two columns, and shapes are not on the grid: no size is estimated
            found += [(name, size, shapes, math.nan if shapes else size)
                      for shapes in grids.get(name, [{}])]
    return found


def build_problem(logs: Sequence[Path], known: KnownModel | None) -> Problem:
    """Read the logs of a case; with a model, its bias and scale are candidates like others."""
    read = [read_session(path) for path in logs]
    wanted = propose_candidates(read[0][0])
    tables, errors = [], []
    for number, (each, error, kept) in enumerate(read):
        # single events are in the first log
        columns = [FORMS[name].error(each, each.rate, size, shapes)
                   * (number == 0 or not FORMS[name].is_single_event)
                   for name, size, shapes, _ in wanted]
        plain = [block_means(each.rate, each.interval), np.ones(len(error))]
        own = [plain[0]] + [plain[1] * (place == number) for place in range(len(read))]
        if known is not None:
            error = error - known['bias'] - known['scale_factor_error'] * plain[0]
        table = np.column_stack(
            [*own, *(block_means(column, each.interval) for column in columns)])
        tables.append(table[kept])
        errors.append(error[kept])
    table, error = np.concatenate(tables), np.concatenate(errors)
    count, lengths = 1 + len(read), np.linalg.norm(table, axis=0)
    owners = [(name, unit) for name, _, _, unit in wanted]
    if known is None:
        base = np.linalg.qr(table[:, :count])[0]
        table, error = (each - base @ (base.T @ each) for each in (table[:, count:], error))
        lengths = lengths[count:]
    else:
        owners = [('scale_factor_error', 1.0), *[('bias', 1.0)] * len(read), *owners]
        count = 0
    # without columns that are zero or proportional to the nuisances
    seen = np.linalg.norm(table, axis=0) > 1e-6 * lengths
    return Problem(error, table[:, seen],
                   tuple(owner for owner, each in zip(owners, seen) if each), count)


def select_greedily(logs: Sequence[Path], known: KnownModel | None) -> Answer:
    """Add the column that lowers the Bayesian information criterion most, until none does."""
    problem = build_problem(logs, known)
    count = len(problem.error)
    chosen: list[int] = []
    best = count * math.log(float(problem.error @ problem.error) / count)
    while True:
        scores = []
        for place in set(range(problem.columns.shape[1])) - set(chosen):
            columns = problem.columns[:, [*chosen, place]]
            weights = np.linalg.lstsq(columns, problem.error, rcond=None)[0]
            left = problem.error - columns @ weights
            scores.append((count * math.log(float(left @ left) / count)
                           + (len(chosen) + 1) * math.log(count), place))
        if not scores or min(scores)[0] >= best:
            return answers_of_columns(problem, chosen), False
        best, place = min(scores)
        chosen.append(place)


def answers_of_columns(problem: Problem, chosen: Sequence[int]) -> list[NamedCause]:
    """Name each chosen effect once, with size and interval by least squares of all chosen."""
    if not chosen:
        return []
    columns = problem.columns[:, chosen]
    inverse = np.linalg.pinv(columns.T @ columns)
    weights = inverse @ columns.T @ problem.error
    left = problem.error - columns @ weights
    variance = float(left @ left) / max(1, len(left) - len(chosen) - problem.nuisances)
    deviations = np.sqrt(variance * np.diag(inverse))
    unit_columns = problem.columns / np.linalg.norm(problem.columns, axis=0)
    effects: dict[str, list[int]] = {}
    for place in np.argsort(-np.abs(weights) / deviations):
        effects.setdefault(problem.owners[chosen[place]][0], []).append(int(place))
    answer = []
    for name, places in effects.items():
        first = places[0]
        is_alike = np.abs(unit_columns.T @ unit_columns[:, chosen[first]]) > AMBIGUOUS_CORRELATION
        others = {owner for (owner, _), each in zip(problem.owners, is_alike) if each}
        size = problem.owners[chosen[first]][1] * weights[first]
        half = 1.96 * abs(problem.owners[chosen[first]][1]) * deviations[first]
        sized = (size, (size - half, size + half)) if math.isfinite(size) else (None, None)
        answer.append(NamedCause(name, tuple(sorted(others - set(effects))), *sized))
    return answer


METHODS = {
    'gyro_calibration': gyro_calibration,
    'greedy': select_greedily}
