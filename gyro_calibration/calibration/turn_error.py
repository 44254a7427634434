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
from typing import NamedTuple

from gyro_calibration.calibration.dwell_search import Numbers
from gyro_calibration.calibration.dwells import Dwells, select_dwells
from gyro_calibration.calibration.rate_table import Calibration, fit_effects
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.calibration.self_calibration import refuse_scale
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
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
    refuse_scale(scale - 1.0, 'reference', 'give or omit --invert, or turn the gyro over')
    rests, remark = _find_rests(dwells)
    nearest = _find_nearest(dwells, turns, rests)
    static, modelled = (
        # eq. 1 and 2, eq. 13 to 16: the integral over a turn of errors of a rate, less the bias
        (error[wanted] - [weights @ error[rows] for rows, weights in nearest])
        * 2.0 * math.pi / np.abs(turns.rate)
        for error in (dwells.output - dwells.rate, rate - dwells.rate))
    remarks = [remark]
    if lost:
        remarks.append(f'{lost} turns are left out: the other sweeps do not determine the model')
    return TurnErrors(turns.rate, turns.temperature, static, modelled, turns.sweep, turns.location,
                      tuple(remarks))


#: Number of a sweep -> the dwells that determine its static bias, and their weights.
Rests = dict[int, tuple[Numbers, Array]]


def _find_rests(dwells: Dwells) -> tuple[Rests, str]:
    """Return the rests of the sweeps (eq. 1), or if there is none the slowest turns both ways."""
    speed, at_rest, between = np.abs(dwells.rate), Rests(), Rests()
    sweeps = np.unique(dwells.sweep).tolist()
    for number in sweeps:
        rows = np.flatnonzero(dwells.sweep == number)
        rests = rows[speed[rows] <= MAX_REST_RATE]
        if len(rests):
            at_rest[number] = rests, np.full(len(rests), 1.0 / len(rests))
        ways = [rows[way * dwells.rate[rows] > 0.0] for way in (1.0, -1.0)]
        if all(map(len, ways)):
            slowest = np.array([each[np.argmin(speed[each])] for each in ways])
            between[number] = slowest, speed[slowest[::-1]] / speed[slowest].sum()
    if not at_rest and not between:
        raise DataRefused(f'{len(dwells)} dwells hold no rest and turn one way only, so that '
                          'nothing shows the static bias; record a rest before each sweep')
    found, remark = at_rest or between, (
        'the static bias is from the rest of each sweep' if at_rest else
        'no rest; the static bias is the error between the slowest turns both ways of each sweep')
    if others := len(sweeps) - len(found):
        remark += (f'; {others} of {len(sweeps)} sweeps have none and take that of the nearest '
                   'temperature')
    return found, remark


def _find_nearest(dwells: Dwells, turns: Dwells,
                  rests: Rests) -> list[tuple[Numbers, Array]]:
    """Return the rest of each turn's sweep, or else the nearest in temperature, then in order."""
    degc, at = ((np.zeros(len(each)) if each.temperature is None else each.temperature)
                for each in (dwells, turns))
    of_rest = {number: float(degc[rows].mean()) for number, (rows, _) in rests.items()}
    return [rests[min(rests, key=lambda number: (
        number != sweep, abs(of_rest[number] - temperature), abs(number - sweep)))]
        for sweep, temperature in zip(turns.sweep.tolist(), at.tolist())]


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


class ErrorSummary(NamedTuple):
    """Root mean square and largest absolute value of errors, rad per turn."""

    rms: float
    largest: float


def summarize_errors(errors: Array) -> ErrorSummary:
    """Return how large some errors are, shape (n,) with n above 0."""
    return ErrorSummary(rms(errors), float(np.abs(errors).max()))
