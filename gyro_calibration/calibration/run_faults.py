# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Faults of a run: another unit, another motion, a deviating stretch, an output that stands."""

from dataclasses import dataclass, replace
from itertools import permutations
import math

from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log
from gyro_calibration.logs.quality import (
    bridge_gaps, encoder_step, find_runs, largest_divisor, white_noise_deviation)
from gyro_calibration.model.motion import Motion
import numpy as np
from scipy.linalg import orth

#: Shortest pieces in which motions are compared, and step of the tried offsets, s.
_TRIAL_STEP = 0.1
#: A motion explains a run if it leaves at most this fraction of its sum of squares.
MAX_UNEXPLAINED_SHARE = 0.1

#: Units that are confused, in rad/s.
_UNITS = {'deg/s': DEGREE, 'rad/s': 1.0, 'mdeg/s': 1e-3 * DEGREE, 'mrad/s': 1e-3,
          'revolutions/s': 2.0 * math.pi, 'revolutions/min': math.pi / 30.0,
          'deg/h': DEGREE / 3600.0}
#: Largest ratio of the scale factor of a gyro to 1 in the right unit, or to that of another unit.
UNIT_TOLERANCE = 1.1


def refuse_unit_error(scale: float, reference: str) -> None:
    """Refuse a scale, reported over true rate, that a confused unit or range explains."""
    size = max(abs(scale), 1e-300)
    if 1.0 / UNIT_TOLERANCE < size < UNIT_TOLERANCE:
        return
    causes = [(taken / given, f'the gyro is in {unit} and read as {other}',
               f'the {reference} in {other} and read as {unit}')
              for (unit, given), (other, taken) in permutations(_UNITS.items(), 2)]
    causes += [(factor, f'the gyro is read with {factor:g} times its sensitivity',
                f'the {reference} was driven at {factor:g} times its rate')
               for ratio in (2.0, 4.0, 8.0, 10.0, 100.0) for factor in (ratio, 1.0 / ratio)]
    found = [each for each in causes if 1.0 / UNIT_TOLERANCE < size / each[0] < UNIT_TOLERANCE]
    if not found:
        return
    # units that are usual in columns first, then the nearest factor
    _, gyro, other = min(found, key=lambda each: (
        'revolutions' in each[1] or 'deg/h' in each[1] or 'sensitivity' in each[1],
        abs(math.log(size / each[0]))))
    sign_note = ', and turns the other way' if scale < 0.0 else ''
    cause = f'either {gyro}, or {other}' if reference else gyro
    if reference == 'reference' and size > 1.0:
        cause += ', or the reference was smoothed and shows less of a fast motion'
    raise DataRefused(f'the gyro reports {size:.4g} times what was turned{sign_note}: '
                      f'{cause}; correct the unit')


def fit_scale(reported: Array, reference: Array) -> tuple[float, float]:
    """Return the unexplained part of the squares about the mean, and the scale."""
    known, turned = reference - reference.mean(), reported - reported.mean()
    power = float(known @ known)
    scale = float(known @ turned) / power if power > 0.0 else 0.0
    return 1.0 - scale * float(known @ turned) / max(float(turned @ turned), 1e-300), scale


@dataclass(frozen=True)
class RunPieces:
    """A run in short pieces: their edges, s, and how far the gyro turned in each, rad."""

    edges: Array
    gyro_angle: Array

    def reference_angle(self, motion: Motion, offset: float = 0.0) -> Array:
        """Return the turn in each piece, rad, by a motion that is late by `offset`, s."""
        return np.diff(motion.heading_at(self.edges - offset))

    def fit_scale(self, reference: Array) -> tuple[float, float]:
        """Return the unexplained part of the squares, and the scale; 1 and 0 without pieces."""
        return fit_scale(self.gyro_angle, reference) if len(self.gyro_angle) else (1.0, 0.0)


def split_run(time: Array, rate: Array, motion: Motion | None = None) -> RunPieces:
    """Return a run in pieces, longer where the noise of a measured heading hides their turns."""
    length = max(_TRIAL_STEP, 2.0 * float(np.median(np.diff(time))),
                 float(time[-1] - time[0]) / 650)  # the time is proportional to the cube of this
    noise = white_noise_deviation(motion.heading) if motion and motion.is_measured else 0.0
    heading = integrate(time, rate)
    while True:
        edges = np.arange(time[0], time[-1], length)
        turned = np.diff(np.interp(edges, time, heading))
        # so that the noise leaves at most half of what a motion may leave
        if len(turned) < 40 or 2.0 * noise ** 2 < 0.5 * MAX_UNEXPLAINED_SHARE * np.var(turned):
            return RunPieces(edges, turned)
        length *= 2.0


@dataclass(frozen=True)
class DeviatingStretch:
    """The stretch of a run that improves a fit most by a turn of its own."""

    # edges that it begins and ends at
    first: int
    last: int
    excess_rate: float  # its excess rate, rad/s
    # sum of squares that it explains, and that remains
    explained_squares: float
    remaining_squares: float
    # what each stretch explains, and its column beside those of the fit, squares, shape (m,)
    all_explained_squares: Array
    column_squares: Array


def find_deviating_stretch(columns: Array, steps: Array, observed: Array) -> DeviatingStretch:
    """
    Return the stretch that improves a fit most.

    Given are white columns of the fit, (n, k), the addition of a turn of 1 rad/s from each edge
    on, (n, m), of which the last is the end, and what is fitted, (n,).
    """
    basis = orth(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), 1e-7)
    step_residuals = steps - basis @ (basis.T @ steps)
    sums, products, whole = (step_residuals.T @ observed, step_residuals.T @ step_residuals,
                             steps.T @ steps)
    differences = sums[:, None] - sums
    norms, wholes = (np.add.outer(np.diag(matrix), np.diag(matrix)) - 2.0 * matrix
                     for matrix in (products, whole))
    # no empty stretches, nor those of which the fit explains 80 %: noise gives them large turns
    distinct = np.triu(norms > 0.2 * wholes, 1)
    gains = np.where(distinct, differences ** 2 / np.where(distinct, norms, 1.0), 0.0)
    first, last = np.unravel_index(int(gains.argmax()), gains.shape)
    gain = float(gains[first, last])
    return DeviatingStretch(
        int(first), int(last), float(differences[first, last] / max(norms[first, last], 1e-300)),
        gain, float(observed @ observed - np.sum((basis.T @ observed) ** 2)) - gain,
        gains[distinct], norms[distinct])


def refuse_other_motion(run: RunPieces, motion: Motion, largest_offset: float) -> None:
    """Refuse a run that the motion does not explain at any offset that is allowed, s."""
    unexplained, scale, offset = fit_profile(run, motion, largest_offset)
    late, _, begin = fit_profile(run, motion, 0.6 * motion.duration)
    # a run that ended early may look like one that began in the middle of the motion
    ended = min(run.fit_scale(run.reference_angle(motion, late_by) * (
        run.edges[1:] - late_by < end))[0] for late_by in _trial_offsets(largest_offset)
        for end in np.linspace(0.0, motion.duration, 50, endpoint=False).tolist())
    if late <= MAX_UNEXPLAINED_SHARE < min(unexplained, ended):
        raise DataRefused(f'the gyro is {abs(begin):.1f} s '
                          f'{"behind" if begin > 0.0 else "ahead of"} the {motion.name}: begin '
                          f'with it, or correct the time of the {motion.name}')
    off = run.gyro_angle - run.gyro_angle.mean() - scale * (
        reference := run.reference_angle(motion, offset)) + scale * reference.mean()
    worst = float(run.edges[int(np.abs(off).argmax())])
    who = 'robot' if motion.name == 'profile' else 'gyro'
    raise DataRefused(f'the {who} does not follow the {motion.name}, which explains '
                      f'{100.0 * max(1.0 - unexplained, 0.0):.0f} % of the run, least at about '
                      f'{worst:.1f} s: check that both belong to one run, that it was driven at '
                      'its speed, from its beginning to its end, and that the robot reaches its '
                      'rates')


def fit_profile(run: RunPieces, motion: Motion,
                largest_offset: float, step: float = _TRIAL_STEP) -> tuple[float, float, float]:
    """Return the unexplained fraction of the squares at the best delay, the scale, and that, s."""
    return min((*run.fit_scale(run.reference_angle(motion, offset)), offset)
               for offset in _trial_offsets(largest_offset, step))


def _trial_offsets(largest: float, step: float = _TRIAL_STEP) -> list[float]:
    count = round(largest / step)
    return list((step * np.arange(-count, count + 1)).tolist())


def reference_angle(log: Log) -> Array:
    """Return the heading of the reference at each sample, gaps interpolated, rad."""
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    assert log.time is not None and values is not None
    if not np.isfinite(values).any():
        return np.zeros(len(values))
    return (bridge_gaps(values) if log.reference_rate is None
            else integrate(log.time, bridge_gaps(values)))


def drop_dead_output(log: Log) -> tuple[Log, list[str]]:
    """
    Return a log without outputs that stay the same while the gyro turns, and a remark on them.

    The log has one reference. The outputs last for four pieces of half a second and more, in which
    the reference changes by more than two steps of output and reference. A limit, a dead zone or a
    coarse step gives the same output at these rates at other times too; there a dead gyro has
    mostly shown others.
    """
    reference = log.reference_rate if log.reference_heading is None else log.reference_heading
    if log.time is None or log.output is None or reference is None:
        return log, []
    length = 0.5
    rows = np.flatnonzero(np.isfinite(log.output))
    known = np.isfinite(reference)
    edges = np.arange(log.time[0], log.time[-1], length)
    if len(rows) < 2 or known.sum() < 2 or len(edges) < 2:
        return log, []
    step = 0.0 if log.reference_heading is None else encoder_step(reference)
    rate = np.diff(np.interp(edges, log.time, reference_angle(log))) / length
    least = 2.0 * (largest_divisor(np.diff(np.unique(log.output[rows]))) + step / length)
    ends = [rows[[run.start, run.stop]] for run in find_runs(np.diff(log.output[rows]) == 0.0)]
    runs = [each for each in ends if np.ptp(log.time[each]) >= 4.0 * length]
    within = [(edges[:-1] >= log.time[first]) & (edges[1:] <= log.time[last])
              for first, last in runs]
    constant = np.any(within, axis=0)
    output, places = log.output.copy(), list[str]()
    for (first, last), inside in zip(runs, within):
        low, high = np.quantile(rate[inside], [0.05, 0.95])
        alike = ~inside & (rate >= low) & (rate <= high)
        if high - low > least and np.sum(alike & ~constant) > max(np.sum(alike & constant), 1):
            output[first:last + 1] = math.nan
            places.append(f'from {log.time[first]:.1f} s to {log.time[last]:.1f} s, at '
                          f'{log.output[first] / DEGREE:.4g} deg/s')
    if not places:
        return log, []
    return replace(log, output=output), [
        'the output stays the same while the gyro turns, as of a gyro that is dead or whose line '
        f'is cut, {"; ".join(places[:5])}; it is left out there']


def format_slip(motion: Motion, angle: float, time: float, sigmas: float) -> str:
    """Say that a stretch of the run deviates, by how much and when."""
    return (f'a stretch of the run differs by {angle / DEGREE:.1f} deg from the {motion.name} '
            f'({sigmas:.0f} standard deviations), at about {time:.1f} s: a slip or a bump, an end '
            'or a limit of the motion, or an error of the reference; run again on free ground')
