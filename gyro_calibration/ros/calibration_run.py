"""A calibration on a robot while it goes on: samples, and what the motion is compared with; in the end a calibration or a refusal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gyro_calibration.log import DEGREE, Array, DataRefused
from gyro_calibration.model import SelfCalibration
from gyro_calibration.motion import Motion, from_headings, from_rates
from gyro_calibration.noise import Noise
from gyro_calibration.self_calibration import (
    SETTLED,
    Limits,
    Reference,
    calibrate_bias,
    check_rest,
    record,
    rest_after,
    self_calibrate,
)
from gyro_calibration.whole_turns import calibrate_turns

#: After the button for whole turns was pressed, the robot rests so long, s; a run that waits for the button is given up after so long.
MARKED, LONGEST = 2.5, 600.0
#: A heading that changes by less than this over a run is none, rad: then its rates are taken.
_TURNED = 1.0 * DEGREE
PROFILE, ODOMETRY, TURNS, REST = 'profile', 'odometry', 'turns', 'rest'


@dataclass
class Run:
    """
    A calibration that goes on.

    Attributes
    ----------
    kind : PROFILE, ODOMETRY, TURNS or REST
    duration : of the motion that is compared, s; infinite until somebody says that it is over
    after : how long samples are wanted after it, s
    heard : when the last sample, or else the request, came by the node's clock, s
    answer : takes '' when the samples are complete, or the reason to give up; returns whether it was the first that was given
    motion : the profile
    times, outputs, rates : stamps, s, output and rate after the model, rad/s
    odometry : stamp, s, heading, rad, and rate, rad/s, of each message

    """

    kind: str
    duration: float
    after: float
    heard: float
    answer: Callable[[str], bool]
    motion: Motion | None = None
    times: list[float] = field(default_factory=list)
    outputs: list[float] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    temperatures: list[float] = field(default_factory=list)
    odometry: list[tuple[float, float, float]] = field(default_factory=list)

    @property
    def elapsed(self) -> float:
        """Return the time from the first sample to the last, s."""
        return self.times[-1] - self.times[0] if self.times else 0.0

    @property
    def progress(self) -> float:
        """Return which part is done."""
        return min(self.elapsed / (LONGEST if math.isinf(self.duration) else self.duration + self.after), 1.0)

    def add(self, time: float, output: float, rate: float, temperature: float | None, heard: float) -> None:
        """Take a sample, after the model."""
        self.times.append(time)
        self.outputs.append(output)
        self.rates.append(rate)
        if temperature is not None:
            self.temperatures.append(temperature)
        self.heard = heard
        if self.elapsed >= self.duration + self.after:
            self.answer('')
        elif math.isinf(self.duration) and self.elapsed > LONGEST:
            self.answer(f'nobody called finish_calibration within {LONGEST:g} s: call it when the robot stands on the mark again')

    @property
    def has_button(self) -> bool:
        """Tell whether somebody may say that the motion is over."""
        return self.kind in (ODOMETRY, TURNS)

    def finish(self) -> str:
        """Let the motion be over now, if it is not already, and return what is awaited."""
        self.duration = min(self.duration, self.elapsed)
        return f'leave the robot at rest for {self.duration + self.after - self.elapsed:.1f} s more'

    def says(self) -> str:
        """Return how it goes, in words."""
        if math.isinf(self.duration):
            return f'{self.elapsed:.0f} s; rest, turn, rest on the mark and call finish_calibration'
        return f'{self.elapsed:.0f} of {self.duration + self.after:.0f} s'

    @property
    def temperature(self) -> float | None:
        """Return the mean temperature, degC, where it came."""
        return float(np.mean(self.temperatures)) if self.temperatures else None


@dataclass(frozen=True)
class Rules:
    """
    What a run is judged by.

    Attributes
    ----------
    limits, odometry : of any run, and how good the odometry is
    turns : whole turns; 0 lets the gyro count
    check : whether a rest after the run decides

    """

    limits: Limits
    odometry: Reference
    turns: int
    check: bool


def wanted_after(kind: str, rules: Rules) -> float:
    """Return how long samples are wanted after the motion, s."""
    if kind in (TURNS, REST):
        return MARKED if kind == TURNS else 0.0
    return rules.limits.time_offset + (SETTLED + rules.limits.rest if rules.check else 0.0)


def calibrated(run: Run, rules: Rules, noise: Noise, when: str) -> tuple[SelfCalibration, str]:
    """
    Return the calibration that a complete run gives, and what more there is to say of it.

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    time, rate, output = (np.array(values) for values in (run.times, run.rates, run.outputs))
    if run.kind == REST:
        bias, deviation = calibrate_bias(time - time[0], rate, rules.limits, noise, output)
        return SelfCalibration(0.0, bias, ((0.0, 0.0), (0.0, deviation ** 2)), when, run.temperature, 'rest'), ''
    if run.kind == TURNS:
        found = calibrate_turns(time - time[0], rate, rules.turns or None, rules.limits, noise, output=output)
        return record(found.fit, 'turns', when, run.temperature), f'{abs(found.turns)} whole turns in {found.duration:.1f} s'
    begin, motion = (time[0], run.motion) if run.motion is not None else _driven(run)
    return _followed(run, time - begin, rate, output, motion, rules, noise, when)


def _driven(run: Run) -> tuple[float, Motion]:
    """Return when the odometry begins, s, and the motion that it tells of."""
    told = np.array([each for each in run.odometry if each[0] <= run.times[0] + run.duration])
    steady = len(told) > 1 and bool((np.diff(told[:, 0]) > 0.0).all())
    if len(told) < 10 or not steady or told[-1, 0] - told[0, 0] < 0.8 * run.duration:
        raise DataRefused(f'{len(told)} messages came on odom in {run.duration:.0f} s, and at least ten over most of the run, with stamps '
                          'that increase, are needed: look at the odometry')
    time, heading, rate = told.T
    heading = np.unwrap(heading)
    motion = from_headings(time, heading) if np.ptp(heading) > _TURNED else from_rates(time - time[0], rate)
    return float(time[0]), motion


def _followed(run: Run, time: Array, rate: Array, output: Array, motion: Motion, rules: Rules, noise: Noise,
              when: str) -> tuple[SelfCalibration, str]:
    """Fit a run to its motion, and check it by the rest after it."""
    limits, odometry = rules.limits, run.kind == ODOMETRY
    inside = (time >= -limits.time_offset) & (time <= motion.duration + limits.time_offset)
    fit = self_calibrate(time[inside], rate[inside], motion, limits=limits, noise=noise, reference=rules.odometry if odometry else None,
                         output=output[inside])
    said = [f'the gyro lags by {fit.time_offset:.3f} +- {fit.time_offset_deviation:.3f} s', *([str(fit.goodness)] if fit.goodness else [])]
    if rules.check:
        # Who drives on after a run by odometry has no rest to be checked by; a profile ends at rest.
        after = rest_after(time, rate, fit, motion, limits) if odometry else time > motion.duration + max(fit.time_offset, 0.0) + SETTLED
        if after is not None:
            checked = check_rest(time[after], rate[after], fit, noise, limits)
            said.append(f'at rest after it the rate was {checked.rate / DEGREE:.4f} deg/s, up to {checked.limit / DEGREE:.4f} is explained')
    return record(fit, 'odometry' if odometry else 'likelihood', when, run.temperature), '; '.join(said)
