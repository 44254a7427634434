# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Similarity of a hidden effect to other effects of the catalogue in some recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math

from gyro_calibration_bench.hidden.effects import (
    effect_errors,
    FORMS,
    Shapes,
    top_rate,
    WITHOUT_COLUMN,
)
from gyro_calibration_bench.hidden.motion import Session
from gyro_calibration_bench.hidden.noise import NoiseFigures
from gyro_calibration_bench.hidden.size import block_averages, Columns, InformationMetric
import numpy as np

#: Effects with any time or frequency, several of which would explain any column.
UNIVERSAL_EFFECTS = {'reference_slip', 'interference_tone'}
#: Number of samples that are averaged to one.
THINNING_FACTOR = 10


class Likeness:
    """
    The columns of all effects of the catalogue in some recordings, over a grid of their shapes.

    Parameters
    ----------
    sessions : the recordings
    figures : the noise, in whose covariance the share of a column is counted

    """

    def __init__(self, sessions: list[Session], figures: NoiseFigures):
        self._metric = InformationMetric(sessions, figures, thin=THINNING_FACTOR)
        self._groups: list[tuple[str, list[int]]] = []
        columns = list(self._metric.nuisances.values())
        for name in FORMS:
            for group in () if name in WITHOUT_COLUMN | UNIVERSAL_EFFECTS else _candidate_columns(
                    name, sessions):
                self._groups.append((name, list(range(len(columns), len(columns) + len(group)))))
                columns += [block_averages(each, THINNING_FACTOR) for each in group]
        joined = np.column_stack([np.concatenate(each) for each in columns])
        self._whitened = np.column_stack([np.concatenate(self._metric.solve(each))
                                          for each in columns])
        gram = joined.T @ self._whitened
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        self._whitened, self._gram = self._whitened / scale, gram / np.outer(scale, scale)
        self._nuisance_indices = list(range(len(self._metric.nuisances)))

    def explained_shares(self, hidden: Columns, excluded: str = '') -> dict[str, float]:
        """Return the share of a column that each effect explains in addition to bias and scale."""
        total, along = self._measure(hidden)
        start = self._explained_energy(along, self._nuisance_indices)
        best: dict[str, float] = {}
        for name, group in self._groups:
            share = (self._explained_energy(along, self._nuisance_indices + group) - start) / max(
                total - start, 1e-300)
            best[name] = max(best.get(name, 0.0), min(1.0, share))
        best.pop(excluded, None)
        return best

    def joint_explained_share(self, hidden: Columns, count: int = 3) -> float:
        """Return the share that some effects explain together, chosen greedily one by one."""
        total, along = self._measure(hidden)
        start, chosen = (self._explained_energy(along,
                                                self._nuisance_indices), self._nuisance_indices)
        for _ in range(count):
            chosen = max((chosen + group for _, group in self._groups),
                         key=lambda places: self._explained_energy(along, places))
        return (self._explained_energy(along, chosen) - start) / max(total - start, 1e-300)

    def _measure(self, hidden: Columns) -> tuple[float, np.ndarray]:
        signal = block_averages(hidden, THINNING_FACTOR)
        total = sum(float(x @ y) for x, y in zip(signal, self._metric.solve(signal)))
        return total, self._whitened.T @ np.concatenate(signal)

    def _explained_energy(self, along: np.ndarray, places: list[int]) -> float:
        inverse = np.linalg.pinv(self._gram[np.ix_(places, places)], rcond=1e-10, hermitian=True)
        return float(along[places] @ inverse @ along[places])


def _candidate_columns(name: str, sessions: list[Session]) -> Iterator[list[Columns]]:
    """Give the columns that an effect may have, in groups."""
    for shapes in _candidate_shapes(name, sessions):
        for size in _candidate_sizes(name, sessions):
            phases = ([{'phase': 0.0}, {'phase': 0.5 * math.pi}]
                      if name in ('heading_sensitivity', 'reference_once_per_rev') else [{}])
            yield [
                effect_errors(FORMS[name], size, {
                    **shapes,
                    **phase
                }, sessions) for phase in phases
            ]


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
