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
The minimum detectable effect, and the size at a multiple of it.

``I = x' S^-1 x - x' S^-1 Z (Z' S^-1 Z)^-1 Z' S^-1 x`` for an effect's column x, with the nuisances
Z, a bias of each recording and one scale; its standard deviation is 1 / sqrt(I), and
`DETECTION_SIGMAS` of them are detected. A nonlinear effect has the size at which its whole finite
error x has the norm `DETECTION_SIGMAS`: sqrt(x' S^-1 x - ...).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import math

from gyro_calibration_bench.hidden.effects import (
    effect_errors, FORMS, Shapes, top_rate, WITHOUT_COLUMN)
from gyro_calibration_bench.hidden.motion import Session
from gyro_calibration_bench.hidden.noise import divergence, NoiseFigures, Whitening
import numpy as np
from scipy.optimize import brentq

#: Standard deviations: the level corrected for some 31 columns, and the power.
DETECTION_SIGMAS = 4.8

Columns = list[np.ndarray]  # of each recording, shape (n,)


class InformationMetric:
    """
    Information of recordings of one gyro on an effect, beside a bias of each and one scale.

    The encoder's step is in rad; `thin` samples are averaged to one first, which keeps what is
    slow. A nuisance known from a model ('bias', 'scale') can be left out.
    """

    def __init__(self, sessions: list[Session], figures: NoiseFigures, encoder_step: float = 0.0,
                 thin: int = 1):
        self._thin = thin
        self._whitenings = [Whitening(figures, len(each.time) // thin, each.interval * thin,
                                      encoder_step) for each in sessions]
        self.nuisances = {f'bias {run}': [np.full(len(each.time), float(run == number))
                                          for number, each in enumerate(sessions)]
                          for run in range(len(sessions))}
        self.nuisances['scale'] = [each.rate for each in sessions]
        self.nuisances = {name: block_averages(columns, thin)
                          for name, columns in self.nuisances.items()}
        self._solved = {name: self.solve(columns) for name, columns in self.nuisances.items()}

    def solve(self, columns: Columns) -> Columns:
        """Return S^-1 times columns that are thinned already."""
        return [whitening.solve(column) for whitening, column in zip(self._whitenings, columns)]

    def gram(self, several: list[Columns], without: Sequence[str] = ()) -> np.ndarray:
        """Return the inner products of several columns, less the nuisances, shape (m, m)."""
        names = [name for name in self.nuisances if name.split()[0] not in without]
        several = [block_averages(columns, self._thin) for columns in several]
        solved = [self.solve(columns) for columns in several]
        full = np.array([[_inner_product(a, b) for b in solved] for a in several])
        if not names:
            return full
        coupling = np.array(
            [[_inner_product(self.nuisances[name], b) for b in solved] for name in names])
        among = np.array([[_inner_product(self.nuisances[a], self._solved[b]) for b in names]
                          for a in names])
        scale = np.sqrt(np.diag(among))
        coupling, among = coupling / scale[:, None], among / np.outer(scale, scale)
        return full - coupling.T @ np.linalg.pinv(among, rcond=1e-12, hermitian=True) @ coupling

    def norm(self, columns: Columns, without: Sequence[str] = ()) -> float:
        """Return the length of what the nuisances do not explain, in standard deviations."""
        return math.sqrt(max(float(self.gram([columns], without)[0, 0]), 0.0))


def block_averages(columns: Columns, factor: int) -> Columns:
    """Return means of so many samples each."""
    return columns if factor == 1 else [column[:len(column) // factor * factor].reshape(
        -1, factor).mean(axis=1) for column in columns]


def _inner_product(a: Columns, b: Columns) -> float:
    return float(sum(x @ y for x, y in zip(a, b)))


def solve_size(norm: Callable[[float], float], wanted: float, guess_size: float,
               max_size: float) -> float:
    """Return the size at which a norm that grows with it has a wanted value, or the largest."""
    guess = min(guess_size, max_size)
    quick = _solve_by_powers(norm, wanted, guess, max_size)
    return quick if quick is not None else _solve_by_brackets(norm, wanted, guess, max_size)


def _solve_by_powers(norm: Callable[[float], float], wanted: float, size: float,
                     most: float) -> float | None:
    """Go along a power of the size, the first for most effects; None if the norm is not smooth."""
    value, power = norm(size), 1.0
    for _ in range(6):
        if abs(value / wanted - 1.0) < 3e-3:
            return size
        if not value:
            return None
        next_size = min(most, size * (wanted / value) ** (1.0 / power))
        if next_size == size:
            return size
        next_value = norm(next_size)
        power = float(np.clip(
            math.log((next_value + 1e-300) / value) / math.log(next_size / size), 0.5, 4.0))
        size, value = next_size, next_value
    return None


def _solve_by_brackets(norm: Callable[[float], float], wanted: float, guess: float,
                       most: float) -> float:
    low = high = guess
    while norm(high) < wanted:
        if high >= most:
            return most
        low, high = high, min(most, 3.0 * high)
    while norm(low) > wanted:
        low, high = 0.3 * low, low
    # a little wider, as an end may by chance be the answer
    low, high = math.log(low) - 1e-3, math.log(high) + 1e-3
    return math.exp(brentq(lambda size: math.log(norm(math.exp(size)) / wanted + 1e-9), low, high,
                           xtol=3e-3, rtol=1e-6))


def solve_noise(changed: Callable[[float], NoiseFigures], expected: NoiseFigures, wanted: float,
                sessions: list[Session], first: float) -> float:
    """Return the change of a noise figure that all recordings together detect at so many sigma."""
    def norm(change: float) -> float:
        each = [divergence(changed(change), expected, len(session.time), session.interval)
                for session in sessions]
        return math.sqrt(sum(value ** 2 for value in each))
    return solve_size(norm, wanted, first, math.inf)


# similarity of a hidden effect to other effects of the catalogue in some recordings

#: Effects with any time or frequency, several of which would explain any column.
UNIVERSAL_EFFECTS = {'reference_slip', 'interference_tone'}
#: Number of samples that are averaged to one.
THINNING_FACTOR = 10


class Likeness:
    """
    The columns of all effects of the catalogue in some recordings, over a grid of their shapes.

    The share of a column is counted in the covariance of the noise.
    """

    def __init__(self, sessions: list[Session], figures: NoiseFigures):
        self._metric = InformationMetric(sessions, figures, thin=THINNING_FACTOR)
        self._groups: list[list[int]] = []
        columns = list(self._metric.nuisances.values())
        for name in FORMS:
            for group in () if name in WITHOUT_COLUMN | UNIVERSAL_EFFECTS else _candidate_columns(
                    name, sessions):
                self._groups.append(list(range(len(columns), len(columns) + len(group))))
                columns += [block_averages(each, THINNING_FACTOR) for each in group]
        joined = np.column_stack([np.concatenate(each) for each in columns])
        self._whitened = np.column_stack([np.concatenate(self._metric.solve(each))
                                          for each in columns])
        gram = joined.T @ self._whitened
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        self._whitened, self._gram = self._whitened / scale, gram / np.outer(scale, scale)
        self._nuisance_indices = list(range(len(self._metric.nuisances)))

    def explained_share(self, hidden: Columns) -> float:
        """Return the share of a column that the best effect explains beside bias and scale."""
        signal = block_averages(hidden, THINNING_FACTOR)
        total = sum(float(x @ y) for x, y in zip(signal, self._metric.solve(signal)))
        along = self._whitened.T @ np.concatenate(signal)
        start = self._explained_energy(along, self._nuisance_indices)
        best = max(self._explained_energy(along, self._nuisance_indices + group)
                   for group in self._groups)
        return min(1.0, (best - start) / max(total - start, 1e-300))

    def _explained_energy(self, along: np.ndarray, places: list[int]) -> float:
        inverse = np.linalg.pinv(self._gram[np.ix_(places, places)], rcond=1e-10, hermitian=True)
        return float(along[places] @ inverse @ along[places])


def _candidate_columns(name: str, sessions: list[Session]) -> Iterator[list[Columns]]:
    """Give the columns that an effect may have, in groups."""
    for shapes in _candidate_shapes(name, sessions):
        for size in _candidate_sizes(name, sessions):
            phases = ([{'phase': 0.0}, {'phase': 0.5 * math.pi}]
                      if name in ('heading_sensitivity', 'reference_once_per_rev') else [{}])
            yield [effect_errors(FORMS[name], size, {**shapes, **phase}, sessions)
                   for phase in phases]


def _candidate_shapes(name: str, sessions: list[Session]) -> Iterator[Shapes]:
    duration = float(sessions[0].time[-1])
    if name in ('thermal_lag', 'warm_up'):
        yield from ({'time_constant': duration * share} for share in np.geomspace(0.01, 2.0, 10))
    elif name == 'bias_step':
        yield from ({'run': run, 'step_time': duration * share} for run in range(len(sessions))
                    for share in np.linspace(0.05, 0.95, 37))
    else:
        yield {}


def _candidate_sizes(name: str, sessions: list[Session]) -> Sequence[float]:
    """Return the sizes at which a column of the effect is taken: one if linear, else several."""
    top = top_rate(sessions)
    return {'sine_response': [0.1 / top, 0.5 / top, 1.0 / top],
            'dead_zone': list(top * np.geomspace(1e-3, 0.2, 8)),
            'saturation': list(top * np.linspace(0.6, 0.98, 8)), 'time_offset': [1e-4],
            'bandwidth': [1e-4, 0.05], 'clock_rate': [1e-6]}.get(name, [1.0])
