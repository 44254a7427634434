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
Faults of a run that deviates from its profile: a name, a test and a remedy for each.

The fault is the motion that explains the run best: the profile with one deviating stretch, driven
faster or slower, at limited rates, begun late, or ended early.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
import math

from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.columns import RATE_UNITS
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.logs.quality import mark_extremes, Saturated, white_noise_deviation
from gyro_calibration.model.motion import Motion
import numpy as np
from scipy.linalg import orth

#: Shortest pieces in which motions are compared, and step of the tried offsets, s.
_TRIAL_STEP = 0.1
#: A motion explains a run if it leaves at most this fraction of its sum of squares.
MAX_UNEXPLAINED_SHARE = 0.1
#: Factor by which a motion with a deviating stretch must leave less than one without.
_SLIP_PENALTY = 1.5

#: Units that are confused, in rad/s: the usual ones, and all, the usual ones last.
_USUAL_UNITS = {'mdeg/s': 1e-3 * DEGREE,
                **{unit: RATE_UNITS[unit] for unit in ('mrad/s', 'deg/s', 'rad/s')}}
_ALL_UNITS = {'revolutions/min': math.pi / 30.0, 'revolutions/s': 2.0 * math.pi,
              'deg/h': RATE_UNITS['deg/h'], **_USUAL_UNITS}


def _name_confusions(units: dict[str, float]) -> dict[float, tuple[str, str]]:
    """Return the causes by reported over true rate; of equal ones, that of the later units."""
    return {float(f'{taken / size:.6g}'): (
        f'the gyro is in {unit} and read as {other}',
        f'the profile in {other} and read as {unit}' if '/s' not in unit or '/s' not in other
        else f'the profile in {other[:-2]} and read as {unit[:-2]}')
        for (unit, size), (other, taken) in permutations(units.items(), 2)}


#: Reported over true rate -> the cause in the gyro, and the one in the profile.
_UNIT_CONFUSIONS = {
    **{factor: (f'the gyro is read with {factor:g} times its sensitivity',
                f'the profile was driven at {factor:g} times its rate')
       for base in (2.0, 4.0, 8.0, 10.0, 100.0) for factor in (base, 1.0 / base)},
    **_name_confusions(_ALL_UNITS),
    1e3: ('the gyro is in thousandths (mdeg/s, mrad/s) and read as whole units',
          'the profile in thousands'),
    1e-3: ('the gyro is in thousands',
           'the profile in thousandths (mdeg, mrad) and read as whole units'),
}
#: Largest ratio of the scale factor of a gyro to 1 in the right unit, or to that of another unit.
UNIT_TOLERANCE = 1.1


def refuse_unit_error(scale: float, reference: str) -> None:
    """Refuse a scale, reported over true rate, that a confused unit explains."""
    size = max(abs(scale), 1e-300)
    found = [factor for factor in _UNIT_CONFUSIONS
             if 1.0 / UNIT_TOLERANCE < size / factor < UNIT_TOLERANCE]
    if not found or 1.0 / UNIT_TOLERANCE < size < UNIT_TOLERANCE:
        return
    usual = _name_confusions(_USUAL_UNITS)
    gyro, profile = _UNIT_CONFUSIONS[min(
        found, key=lambda factor: (factor not in usual, abs(math.log(size / factor))))]
    sign_note = ', and turns the other way' if scale < 0.0 else ''
    cause = f'either {gyro}, or {profile.replace("profile", reference)}' if reference else gyro
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

    def reference_angle(self, motion: Motion, offset: float = 0.0, speed: float = 1.0,
                        end: float = math.inf) -> Array:
        """Return the turn in each piece, rad, by a motion late by `offset` and cut at `end`, s."""
        return np.diff(motion.heading_at(np.minimum(speed * (self.edges - offset), end)))

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


def refuse_other_motion(run: RunPieces, motion: Motion, largest_offset: float,
                        slip: str = '') -> None:
    """Refuse a run that another motion explains far better; `slip` is a message on a slip."""
    trials = [(unexplained, unexplained, message) for unexplained, message
              in _try_motions(run, motion, largest_offset)]
    # a stretch of another turn
    edges = np.arange(0, len(run.gyro_angle) + 1, 5)
    interval = float(np.median(np.diff(run.edges)))
    steps = np.where(np.arange(len(run.gyro_angle))[:, None] >= edges, interval, 0.0)
    whole = max(float(np.sum((run.gyro_angle - run.gyro_angle.mean()) ** 2)), 1e-300)
    for offset in _trial_offsets(largest_offset):
        reference = run.reference_angle(motion, offset)
        found = find_deviating_stretch(
            np.column_stack([reference, np.full(len(reference), interval)]), steps, run.gyro_angle)
        unexplained = run.fit_scale(reference)[0] - found.explained_squares / whole
        turned = found.excess_rate * float(edges[found.last] - edges[found.first]) * interval
        trials.append((_SLIP_PENALTY * unexplained, unexplained, slip or format_slip(
            motion, abs(turned), float(run.edges[edges[found.first]]))))
    _, unexplained, message = min(trials)
    if _SLIP_PENALTY * unexplained > fit_profile(
            run, motion, largest_offset)[0] <= MAX_UNEXPLAINED_SHARE:
        return
    if unexplained > MAX_UNEXPLAINED_SHARE:
        who, remedy = (('robot', 'was another profile driven?') if motion.name == 'profile' else
                       ('gyro', 'check that both belong to one run'))
        raise DataRefused(f'the {who} does not follow the {motion.name} (the closest motion '
                          f'explains {100 * max(1 - unexplained, 0.0):.0f} % of the run): '
                          f'{remedy}')
    raise DataRefused(message)


def refuse_limited(run: RunPieces, motion: Motion, largest_offset: float, time: Array,
                   output: Array) -> None:
    """
    Refuse an output that stands at its largest value while the motion turns faster.

    A line through the pieces below it is more than a step beyond it, and explains the run far
    better. The steps may hide the noise of the gyro, by which others are recognized.
    """
    extreme, step = mark_extremes(output)
    piece, duration = np.searchsorted(run.edges, time, side='right'), np.diff(run.edges)
    samples, at_limit = (np.bincount(piece, weights, len(run.edges) + 1)[1:-1]
                         for weights in (None, extreme))
    below = at_limit < np.maximum(samples, 1)
    columns = np.column_stack([
        run.reference_angle(motion, fit_profile(run, motion, largest_offset)[2]), duration])
    if below.all() or not below.any():
        return
    expected, of_all = (columns @ np.linalg.lstsq(columns[rows], run.gyro_angle[rows], rcond=None)[
        0] for rows in (below, slice(None)))
    left = run.gyro_angle - expected
    beyond = -np.sign(run.gyro_angle) * left
    left[~below] = np.minimum(beyond[~below], 0.0)
    if (np.median((beyond / duration)[~below]) > step and np.sum((run.gyro_angle - of_all) ** 2)
            > _SLIP_PENALTY * np.sum(left ** 2)):
        raise Saturated(float(np.abs(output).max()), float(extreme.mean()))


def fit_profile(run: RunPieces, motion: Motion,
                largest_offset: float, step: float = _TRIAL_STEP) -> tuple[float, float, float]:
    """Return the unexplained fraction of the squares at the best delay, the scale, and that, s."""
    return min((*run.fit_scale(run.reference_angle(motion, offset)), offset)
               for offset in _trial_offsets(largest_offset, step).tolist())


def _trial_offsets(largest_offset: float, step: float = _TRIAL_STEP) -> Array:
    count = round(largest_offset / step)
    return np.arange(-count, count + 1) * step


def _try_motions(run: RunPieces, motion: Motion,
                 largest_offset: float) -> Iterator[tuple[float, str]]:
    """Give the unexplained part of a run by ends, speeds and starts, and the cause."""
    duration, is_profile = motion.duration, motion.name == 'profile'
    interval = float(np.median(np.diff(run.edges)))
    for offset in _trial_offsets(largest_offset)[::2]:
        whole = run.reference_angle(motion, offset)
        largest = float(np.abs(whole).max(initial=0.0))
        for limit in np.arange(0.3, 0.97, 0.05) * largest if is_profile else ():
            yield (run.fit_scale(np.clip(whole, -limit, limit))[0],
                   f'the robot reached {limit / interval / DEGREE:.0f} deg/s where the profile '
                   f'turns at {largest / interval / DEGREE:.0f} deg/s: raise its limit, or drive '
                   'a slower profile')
        for end in np.arange(0.05, 0.97, 0.0125) * duration:
            yield (run.fit_scale(run.reference_angle(motion, offset, end=end))[0],
                   f"the robot stopped at about {end:.1f} s of the profile's {duration:.1f} s: "
                   'drive the whole profile' if is_profile else
                   f'the gyro follows the {motion.name} until about {end:.1f} s of '
                   f'{duration:.1f} s only: repair the line that stopped, and record again')
        for speed in (2.0 ** (each / 16.0) for each in range(-32, 33)):
            if max(speed, 1.0 / speed) > UNIT_TOLERANCE:
                yield (run.fit_scale(run.reference_angle(motion, offset, speed))[0],
                       f'the robot drove the profile {speed:.2f} times as fast as given, in '
                       f'{duration / speed:.1f} s instead of {duration:.1f} s: drive it at its '
                       'own speed, or give the profile that was driven' if is_profile else
                       f'the gyro follows the {motion.name} at {speed:.2f} times its speed: '
                       f'correct the time of the {motion.name}')
    for offset in _trial_offsets(0.6 * duration):
        if abs(offset) > largest_offset:
            yield (run.fit_scale(run.reference_angle(motion, offset))[0],
                   f'the robot began {abs(offset):.1f} s {"after" if offset > 0 else "before"} '
                   'the profile: begin with it, or allow a larger time offset' if is_profile else
                   f'the gyro is {abs(offset):.1f} s {"behind" if offset > 0 else "ahead of"} the '
                   f'{motion.name}: correct the time of the {motion.name}')


def format_slip(motion: Motion, angle: float, time: float, sigmas: float = math.nan) -> str:
    """Say that the robot slipped or was bumped, or that a mount or a reference slipped."""
    significance = '' if math.isnan(sigmas) else f' ({sigmas:.0f} standard deviations)'
    cause = ('a slip or a bump; run again on free ground' if motion.name == 'profile' else
             'a slip of the wheels or a jump of odom; run again on free ground'
             if motion.name == 'odometry' else
             'a slip of the mount or an error of the reference; mend it and run again')
    return (f'a stretch of the run differs by {angle / DEGREE:.1f} deg from the '
            f'{motion.name}{significance}, at about {time:.1f} s: {cause}')
