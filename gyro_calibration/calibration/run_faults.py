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
faster or slower, begun late, or ended early.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import math

from gyro_calibration.calibration.likelihood import find_deviating_stretch
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.motion import Motion
import numpy as np

#: Minimum length of the pieces in which motions are compared, and step of the tried starts, ends
#: and offsets, s; largest number of pieces: the time of the search is proportional to its cube.
_MIN_PIECE_DURATION, _TRIAL_STEP, _MAX_PIECES = 0.1, 0.1, 650
#: Speeds that are tried, as parts of the profile's.
_TRIAL_SPEEDS = 2.0 ** (np.arange(-32, 33) / 16.0)
#: A motion explains a run if it leaves at most this fraction of its sum of squares.
MAX_UNEXPLAINED_SHARE = 0.1
#: Factor by which a motion with a deviating stretch must leave less than one without.
_SLIP_PENALTY = 1.5

#: Reported over true rate -> the confused unit of the gyro, or of the profile, that causes it.
_UNIT_CONFUSIONS = {
    180.0 / math.pi: ('the gyro is in deg/s and read as rad/s',
                      'the profile in rad and read as deg'),
    math.pi / 180.0: ('the gyro is in rad/s and read as deg/s',
                      'the profile in deg and read as rad'),
    1e3: ('the gyro is in thousandths (mdeg/s, mrad/s) and read as whole units',
          'the profile in thousands'),
    1e-3: ('the gyro is in thousands',
           'the profile in thousandths (mdeg, mrad) and read as whole units'),
    180e3 / math.pi: ('the gyro is in mdeg/s and read as rad/s',
                      'the profile in rad and read as mdeg'),
    math.pi / 180e3: ('the gyro is in rad/s and read as mdeg/s',
                      'the profile in mdeg and read as rad'),
    1e3 * math.pi / 180.0: ('the gyro is in mrad/s and read as deg/s',
                            'the profile in deg and read as mrad'),
    180e-3 / math.pi: ('the gyro is in deg/s and read as mrad/s',
                       'the profile in mrad and read as deg'),
    0.5 / math.pi: ('the gyro is in revolutions/s and read as rad/s '
                    '(or in revolutions/min and read as deg/s)',
                    'the profile in rad and read as revolutions'),
    2.0 * math.pi: ('the gyro is in rad/s and read as revolutions/s',
                    'the profile in revolutions and read as rad'),
    1.0 / 360.0: ('the gyro is in revolutions/s and read as deg/s',
                  'the profile in deg and read as revolutions'),
    360.0: ('the gyro is in deg/s and read as revolutions/s',
            'the profile in revolutions and read as deg'),
    30.0 / math.pi: ('the gyro is in revolutions/min and read as rad/s',
                     'the profile is 9.5 times too slow'),
    3600.0: ('the gyro is in deg/h and read as deg/s', 'the profile is 3600 times too slow'),
    648e3 / math.pi: ('the gyro is in deg/h and read as rad/s',
                      'the profile is 206265 times too slow'),
    1.0 / 3600.0: ('the gyro is in deg/s and read as deg/h', 'the profile is 3600 times too fast'),
    2.0: ('the gyro is read with twice its sensitivity',
          'the profile was driven at twice its rate'),
    0.5: ('the gyro is read with half its sensitivity', 'the profile was driven at half its rate'),
    **{factor: (f'the gyro is read with {factor:g} times its sensitivity',
                f'the profile was driven at {factor:g} times its rate')
       for factor in (4.0, 8.0, 10.0, 100.0, 0.25, 0.125, 0.1, 0.01)},
}
#: Largest scale factor error in addition to a confused unit, as a logarithm.
_UNIT_LOG_TOLERANCE = math.log(1.1)


def refuse_unit_error(scale: float, reference: str = 'profile') -> None:
    """
    Raise `DataRefused` for a scale that a confused unit explains.

    Parameters
    ----------
    scale : reported over true rate
    reference : its name, if its unit may be the wrong one; else ''

    """
    size = abs(math.log(max(abs(scale), 1e-300)))
    nearest = min(_UNIT_CONFUSIONS,
                  key=lambda factor: abs(math.log(max(abs(scale), 1e-300) / factor)))
    if (size < _UNIT_LOG_TOLERANCE
            or abs(math.log(max(abs(scale), 1e-300) / nearest)) > _UNIT_LOG_TOLERANCE):
        return
    sign_note = ', and turns the other way' if scale < 0.0 else ''
    gyro, profile = _UNIT_CONFUSIONS[nearest]
    cause = f'either {gyro}, or {profile.replace("profile", reference)}' if reference else gyro
    raise DataRefused(f'the gyro reports {abs(scale):.4g} times what was turned{sign_note}: '
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


def split_run(time: Array, rate: Array) -> RunPieces:
    """Return a run in pieces."""
    length = max(_MIN_PIECE_DURATION, 2.0 * float(np.median(np.diff(time))),
                 float(time[-1] - time[0]) / _MAX_PIECES)
    edges = np.arange(time[0], time[-1], length)
    return RunPieces(edges, np.diff(np.interp(edges, time, integrate(time, rate))))


def refuse_other_motion(run: RunPieces, motion: Motion, largest_offset: float,
                        slip: str = '') -> None:
    """
    Refuse a run that another motion explains far better than the profile, with the cause.

    Parameters
    ----------
    slip : message on a slip, where more is known of it than its pieces show

    Raises
    ------
    DataRefused : with the cause that explains it best

    """
    trials = {name: _best_trial(make_trials(run, motion, largest_offset))
              for name, make_trials in _FAULT_TRIALS.items()}
    name = min(trials,
               key=lambda each: trials[each][0] * (_SLIP_PENALTY if each == 'slip' else 1.0))
    unexplained, value = trials[name]
    if _SLIP_PENALTY * unexplained > fit_profile(
            run, motion, largest_offset)[0] <= MAX_UNEXPLAINED_SHARE:
        return
    if unexplained > MAX_UNEXPLAINED_SHARE:
        raise DataRefused('the robot turned otherwise than the profile (the best that can be made '
                          f'of it explains {100 * max(1 - unexplained, 0.0):.0f} % of the run): '
                          'was another profile driven?')
    raise DataRefused(slip if slip and name == 'slip' else _FAULT_MESSAGES[name](value, motion))


def fit_profile(run: RunPieces, motion: Motion, largest_offset: float) -> tuple[float, float]:
    """Return the unexplained fraction of the squares at the best delay, and the scale there."""
    return min(run.fit_scale(run.reference_angle(motion, offset))
               for offset in _trial_offsets(largest_offset))


#: Unexplained part of a run, and the value of what was tried: a speed, s, or a turn in rad with
#: its time, s.
Trials = Iterable[tuple[float, tuple[float, ...]]]


def _best_trial(trials: Trials) -> tuple[float, tuple[float, ...]]:
    """Return the trial with the least unexplained fraction; infinity without trials."""
    return min(trials, key=lambda each: each[0], default=(math.inf, ()))


def _trial_offsets(largest_offset: float) -> Array:
    return (np.arange(-round(largest_offset / _TRIAL_STEP),
                      round(largest_offset / _TRIAL_STEP) + 1) * _TRIAL_STEP)


def _try_early_ends(run: RunPieces, motion: Motion, largest_offset: float) -> Trials:
    """Try ends of the motion, each at the delay that fits the part before it best."""
    for end in np.arange(0.05, 0.97, 0.0125) * motion.duration:
        yield _best_trial((run.fit_scale(run.reference_angle(motion, offset, end=end))[0],
                           (float(end),)) for offset in _trial_offsets(largest_offset)[::2])


def _try_speeds(run: RunPieces, motion: Motion, largest_offset: float) -> Trials:
    for speed in _TRIAL_SPEEDS[np.abs(np.log(_TRIAL_SPEEDS)) > _UNIT_LOG_TOLERANCE]:
        for offset in _trial_offsets(largest_offset)[::2]:
            angle = run.reference_angle(motion, offset, float(speed))
            yield run.fit_scale(angle)[0], (float(speed),)


def _try_late_starts(run: RunPieces, motion: Motion, largest_offset: float) -> Trials:
    for offset in _trial_offsets(0.6 * motion.duration):
        if abs(offset) > largest_offset:
            yield run.fit_scale(run.reference_angle(motion, offset))[0], (float(offset),)


def _try_slips(run: RunPieces, motion: Motion, largest_offset: float) -> Trials:
    """Try a stretch with a different turn, at the delay that fits best with it."""
    edges = np.arange(0, len(run.gyro_angle) + 1, 5)
    interval = float(np.median(np.diff(run.edges)))
    steps = np.where(np.arange(len(run.gyro_angle))[:, None] >= edges, interval, 0.0)
    whole = np.sum((run.gyro_angle - run.gyro_angle.mean()) ** 2)
    for offset in _trial_offsets(largest_offset):
        reference = run.reference_angle(motion, offset)
        found = find_deviating_stretch(
            np.column_stack([reference, np.full(len(reference), interval)]), steps, run.gyro_angle)
        left = run.fit_scale(reference)[0] - found.explained_squares / max(float(whole), 1e-300)
        yield left, (found.excess_rate * float(edges[found.last] - edges[found.first]) * interval,
                     float(run.edges[edges[found.first]]))


_FAULT_TRIALS: dict[str, Callable[[RunPieces, Motion, float], Trials]] = {
    'early': _try_early_ends, 'speed': _try_speeds, 'late': _try_late_starts, 'slip': _try_slips}
_FAULT_MESSAGES: dict[str, Callable[[tuple[float, ...], Motion], str]] = {
    'early': lambda value, motion: (
        f"the robot stopped at about {value[0]:.1f} s of the profile's {motion.duration:.1f} s: "
        'drive the whole profile'), 'speed': lambda value, motion: (
            f'the robot drove the profile {value[0]:.2f} times as fast as given, in '
            f'{motion.duration / value[0]:.1f} s instead of {motion.duration:.1f} s: '
            'drive it at its own speed, or give the profile that was driven'),
    'late': lambda value, _: (
        f'the robot began {abs(value[0]):.1f} s {"after" if value[0] > 0 else "before"} '
        'the profile: begin with it, or allow a larger time offset'),
    'slip': lambda value, _: format_slip(abs(value[0]), value[1])}


def format_slip(angle: float, time: float, sigmas: float = math.nan) -> str:
    """Say that the robot slipped or was bumped."""
    significance = '' if math.isnan(sigmas) else f' ({sigmas:.0f} standard deviations)'
    return (f'a stretch of the run turned {angle / DEGREE:.1f} deg otherwise than the '
            f'profile{significance}, at about {time:.1f} s: a slip or a bump; run again on free '
            'ground')
