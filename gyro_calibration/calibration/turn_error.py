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
The heading error of a full turn of 360 degrees (Ojeda et al., section 4).

An error of the rate, rad/s, integrates to an error of the heading in each turn, rad, in proportion
to the duration of the turn. Two errors are compared: with the bias of a rest before the mission
only, and with a model and then the bias that remains at rest.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwells import Dwells, Numbers, select_dwells
from gyro_calibration.calibration.rate_table import Calibration, fit_effects
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.calibration.self_calibration import refuse_scale
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Mask
from gyro_calibration.model.compensation import compensate
import numpy as np

#: rad/s; the error of slower turns is mostly bias, not scale; as published.
MIN_TURN_RATE = 5.0 * DEGREE
#: A dwell that turns slower than this is a rest.
MAX_REST_RATE = 0.1 * DEGREE


@dataclass(frozen=True)
class TurnErrors:
    """
    Errors of full turns, counter-clockwise positive as the heading is, each array of shape (n,).

    Attributes
    ----------
    rate : true rate of the turn, rad/s
    temperature : degC; None where the log holds none
    static : with the static bias only, rad per turn
    modelled : with the model, and the static bias after it, rad per turn
    sweep : that the turn was measured in
    location : of each turn in its file
    remarks : on the source of the static bias, and on turns without an error, one sentence each

    """

    rate: Array
    temperature: Array | None
    static: Array
    modelled: Array
    sweep: Numbers
    location: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rate)


def compute_turn_errors(dwells: Dwells, rate: Array,
                        min_rate: float = MIN_TURN_RATE) -> TurnErrors:
    """
    Return the errors of full turns at the rates and temperatures of some dwells.

    Parameters
    ----------
    dwells : without those that are outlying
    rate : of each dwell by the model (eq. 13), rad/s, shape (n,); nan where there is none, as from
        `predict_left_out_rates`
    min_rate : of a turn, rad/s

    Raises
    ------
    DataRefused : no dwell of that rate has a rate by the model, none determines the static bias,
        or the gyro is upside down

    """
    known = np.isfinite(rate)
    lost = int(np.count_nonzero(~known & (np.abs(dwells.rate) >= min_rate)))
    dwells, rate = select_dwells(dwells, known), rate[known]
    wanted = np.abs(dwells.rate) >= min_rate
    if not wanted.any():
        raise DataRefused(f'none of {len(known)} dwells turns at {min_rate / DEGREE:g} deg/s or '
                          'faster and has a rate by the model; '
                          'record faster turns, or several sweeps')
    turns = select_dwells(dwells, wanted)
    scale = float(turns.rate @ turns.output) / float(turns.rate @ turns.rate)
    refuse_scale(scale - 1.0, 'reference', 'give --invert, or turn the gyro over')
    rests, remark = _find_rests(dwells)
    nearest = [_find_nearest_rest(dwells, place, rests)
               for place in np.flatnonzero(wanted).tolist()]
    # eq. 1 and 2, and eq. 13, 15 and 16
    static, modelled = (_error_per_turn(dwells, error, wanted, nearest)
                        for error in (dwells.output - dwells.rate, rate - dwells.rate))
    remarks = [remark]
    if lost:
        remarks.append(f'{lost} turns are left out: the other sweeps do not determine the model')
    return TurnErrors(turns.rate, turns.temperature, static, modelled, turns.sweep, turns.location,
                      tuple(remarks))


def _error_per_turn(dwells: Dwells, error: Array, is_turn: Mask,
                    nearest: list[_SweepRest]) -> Array:
    """Return the integral over a turn of errors of a rate, less those at rest, rad (eq. 14)."""
    bias = np.array([rest.weights @ error[rest.dwells] for rest in nearest])
    return (error[is_turn] - bias) * 2.0 * math.pi / np.abs(dwells.rate[is_turn])


# static bias

@dataclass(frozen=True)
class _SweepRest:
    """The dwells of a sweep that determine the static bias, and their weights, shape (k,)."""

    sweep: int
    temperature: float
    dwells: Numbers
    weights: Array


def _find_rests(dwells: Dwells) -> tuple[list[_SweepRest], str]:
    """Return the rests of the sweeps, or where there is none the slowest turns both ways."""
    numbers = np.unique(dwells.sweep)
    for find, words in ((_find_standstill, 'the static bias is from the rest of each sweep'),
                        (_find_slowest_turns, 'no rest; the static bias is the error between the '
                         'slowest turns both ways of each sweep')):
        found = [rest for number in numbers if (rest := find(dwells, int(number))) is not None]
        if found:
            others = len(numbers) - len(found)
            more = (f'; {others} of {len(numbers)} sweeps have none and take that of the nearest '
                    'temperature' if others else '')
            return found, words + more
    raise DataRefused(f'{len(dwells)} dwells hold no rest and turn one way only, so that nothing '
                      'shows the static bias; record a rest before each sweep')


def _find_standstill(dwells: Dwells, number: int) -> _SweepRest | None:
    """Return the rests of a sweep (eq. 1)."""
    rows = np.flatnonzero((dwells.sweep == number) & (np.abs(dwells.rate) <= MAX_REST_RATE))
    return _make_sweep_rest(dwells, number, rows, np.full(len(rows), 1.0)) if len(rows) else None


def _find_slowest_turns(dwells: Dwells, number: int) -> _SweepRest | None:
    """Return the slowest turn each way of a sweep; the bias is interpolated between them."""
    ways = [np.flatnonzero((dwells.sweep == number) & (way * dwells.rate > 0.0))
            for way in (1.0, -1.0)]
    if not all(map(len, ways)):
        return None
    rows = np.array([rows[np.argmin(np.abs(dwells.rate[rows]))] for rows in ways])
    return _make_sweep_rest(dwells, number, rows, np.abs(dwells.rate[rows[::-1]]))


def _make_sweep_rest(dwells: Dwells, number: int, rows: Numbers, weights: Array) -> _SweepRest:
    temperature = 0.0 if dwells.temperature is None else float(dwells.temperature[rows].mean())
    return _SweepRest(number, temperature, rows, weights / weights.sum())


def _find_nearest_rest(dwells: Dwells, index: int, rests: list[_SweepRest]) -> _SweepRest:
    """Return the rest of a dwell's sweep, or else the nearest in temperature, then in order."""
    sweep = int(dwells.sweep[index])
    temperature = 0.0 if dwells.temperature is None else float(dwells.temperature[index])
    return min(rests, key=lambda rest: (rest.sweep != sweep, abs(rest.temperature - temperature),
                                        abs(rest.sweep - sweep)))


# rates by a model

def predict_left_out_rates(calibration: Calibration) -> Array:
    """
    Return the rate of each dwell by a model not fitted to its sweep, rad/s, shape (n,).

    The effects are those of the calibration, their values are fitted anew to the other sweeps. In
    a single sweep, only the dwell itself is left out. The rate is nan where the other sweeps do
    not determine the model.

    """
    dwells, rates = calibration.dwells, np.full(len(calibration.dwells), np.nan)
    groups = dwells.sweep if len(np.unique(dwells.sweep)) > 1 else np.arange(len(dwells))
    for number in np.unique(groups):
        is_left_out = groups == number
        scatter = replace(calibration.scatter, inliers=calibration.scatter.inliers[~is_left_out])
        try:
            model = (fit_effects(select_dwells(dwells, ~is_left_out), calibration.effects,
                                 scatter).model)
        except DataRefused:
            continue
        left_out = select_dwells(dwells, is_left_out)
        rates[is_left_out] = compensate(model, left_out.output, left_out.temperature).rate
    return rates


@dataclass(frozen=True)
class ErrorSummary:
    """Root mean square and largest absolute value of errors, rad per turn, and their count."""

    rms: float
    largest: float
    count: int


def summarize_errors(errors: Array) -> ErrorSummary:
    """Return how large some errors are, shape (n,) with n above 0."""
    return ErrorSummary(rms(errors), float(np.abs(errors).max()), len(errors))
