# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What a diagnosis finds, as records, and the same as data for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

from gyro_calibration.logs.log import Array
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise

SCHEMA = 'gyro_calibration/diagnosis/2'
#: Smaller probabilities are not stated: the assumptions on the noise do not carry them.
LEAST_PROBABILITY = 1e-4
#: A lasting cause is suspected where it shows more than chance does at so many times the level.
SUSPECTED = 5.0
#: A cause that explains the data less well than the best by more than this, in logarithms of the
#: likelihood (2.5 sigma), is ruled out.
RULED_OUT = 3.2


@dataclass(frozen=True)
class Estimate:
    """A value with its interval of 95 %, in SI."""

    estimate: float
    interval: tuple[float, float]
    unit: str

    @classmethod
    def about(cls, value: float, half: float, unit: str) -> Estimate:
        """Return a value with an interval of half a length on each side."""
        return cls(value, (value - half, value + half), unit)

    @property
    def deviation(self) -> float:
        """Return the standard deviation of which the interval has 1.96 each way."""
        return (self.interval[1] - self.interval[0]) / (2.0 * 1.96)

    @property
    def holds_zero(self) -> bool:
        """Return whether the interval holds zero."""
        return self.interval[0] <= 0.0 <= self.interval[1]

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        return {'estimate': self.estimate, 'ci95': list(self.interval), 'unit': self.unit}


def probabilities(lacks: Mapping[str, float]) -> dict[str, float]:
    """Return how probable causes are by what each lacks in log-likelihood, likeliest first."""
    weights = {name: math.exp(-min(max(lack, 0.0), 700.0)) for name, lack in lacks.items()}
    return {name: max(weight / sum(weights.values()), LEAST_PROBABILITY)
            for name, weight in sorted(weights.items(), key=lambda each: -each[1])}


@dataclass(frozen=True)
class Gate:
    """
    What was checked before anything is named.

    Attributes
    ----------
    name : wrapped_heading, motion, tilt, sense, unit, time_unit or model
    passed : None where the log does not show it
    said : what was seen, in numbers
    remedy : what to do where it failed
    factor : of the output over the reference and its interval of 95 %, where it failed by that

    """

    name: str
    passed: bool | None
    said: str
    remedy: str = ''
    factor: tuple[float, tuple[float, float]] | None = None

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        return {'name': self.name, 'passed': self.passed, 'said': self.said, 'remedy': self.remedy}


@dataclass(frozen=True)
class Finding:
    """
    One cause.

    Attributes
    ----------
    effect : its name in the catalogue
    cause : one sentence for people
    parameters : name -> estimate; of what a model has too, what comes on top of its value, but for
        figures of the noise
    p_value : the chance that a log without it shows as much
    minimum_detectable : the smallest detectable value of its first parameter, in its unit; None
        where that has no meaning
    ambiguous_with : the names of those that the data at hand cannot rule out instead
    separate_by : the experiment that would part them; '' where there is nothing to part
    evidence : what in the data shows it, one sentence with numbers in units of people
    along : the variable along which it shows, a key of `Diagnosis.curves`; '' where there is none
    status : 'established', or 'suspected' where it is not confirmed on stretches that took no part
        in choice and fit
    probability : of it and of those that may be in its place, by name; empty where not computed
    share_of_heading_error : part of the mean square of the heading error over 60 s that it
        explains; None where not computed
    where : from and to, s, of an effect in part of the log; None of the whole log
    remedy : what to do about it

    """

    effect: str
    cause: str
    parameters: Mapping[str, Estimate]
    p_value: float
    minimum_detectable: float | None = None
    ambiguous_with: tuple[str, ...] = ()
    separate_by: str = ''
    evidence: str = ''
    along: str = ''
    status: str = 'established'
    probability: Mapping[str, float] = field(default_factory=dict)
    share_of_heading_error: float | None = None
    where: tuple[float, float] | None = None
    remedy: str = ''

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        return {'effect': self.effect, 'cause': self.cause,
                'parameters': {name: value.figures() for name, value in self.parameters.items()},
                'p_value': max(self.p_value, LEAST_PROBABILITY),
                'minimum_detectable': self.minimum_detectable,
                'ambiguous_with': list(self.ambiguous_with), 'separate_by': self.separate_by,
                'evidence': self.evidence, 'status': self.status,
                'probability': dict(self.probability),
                'share_of_heading_error': self.share_of_heading_error,
                'where': None if self.where is None else list(self.where), 'remedy': self.remedy}


@dataclass(frozen=True)
class Unexplained:
    """Structure without a name: its variable, its share of the residual's variance, its chance."""

    along: str
    share_of_variance: float
    p_value: float

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        return {'along': self.along, 'share_of_variance': self.share_of_variance,
                'p_value': max(self.p_value, LEAST_PROBABILITY)}


@dataclass(frozen=True)
class Change:
    """
    A root mean square error before and after the extension.

    Attributes
    ----------
    before, after : the errors
    interval : of 95 % of what is won, before less after; None where a single part was held out

    """

    before: float
    after: float
    interval: tuple[float, float] | None

    @property
    def worse(self) -> bool:
        """Tell whether the error grew beyond chance."""
        return self.interval is not None and self.interval[1] < 0.0

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        return {'before': self.before, 'after': self.after,
                'ci95': None if self.interval is None else list(self.interval)}


@dataclass(frozen=True)
class Gain:
    """
    What the extension wins on parts that took no part in the choice or the fit.

    Attributes
    ----------
    held_out : which parts, in words
    rate : of the simulated against the measured rate, rad/s
    heading : of the simulated against the measured change of heading over windows, rad; None where
        no window is as long
    window : s
    models : name -> root mean square of the heading error of given, plain (bias, scale factor and
        delay alone) and extended model, rad

    """

    held_out: str
    rate: Change
    heading: Change | None
    window: float = 60.0
    models: Mapping[str, float] = field(default_factory=dict)

    @property
    def worse(self) -> bool:
        """Tell whether the extension is worse than nothing, beyond chance."""
        return any(change is not None and change.worse for change in (self.rate, self.heading))

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        heading = (None if self.heading is None
                   else {'window_s': self.window, **self.heading.figures()})
        return {'held_out': self.held_out, 'rate_rms': self.rate.figures(),
                'heading_rms': heading, **self.models}


@dataclass(frozen=True)
class Curve:
    """
    The residual along one variable, in bins, for pictures: arrays of shape (bins,), in SI.

    Attributes
    ----------
    along : rate, temperature, heading, time, frequency ...
    unit : of `at`, SI
    at : middle of each bin
    before, after : mean of the residual there, against the model that was given and against the
        extended one, rad/s
    deviation : standard deviation of these means by the noise alone, slow noise too, rad/s; along
        the frequency, where amplitudes stand in place of means, the usual one
    simulated : mean error, output less true rate, that the simulation with the given model has
        there, rad/s; the measured one is the sum of this and `before`

    """

    along: str
    unit: str
    at: Array
    before: Array
    after: Array
    deviation: Array
    simulated: Array | None = None


@dataclass(frozen=True)
class Trace:
    """
    A stretch where simulation and measurement differ most: arrays of shape (n,), s and rad/s.

    Attributes
    ----------
    time : s, as in the log
    measured : output of the gyro
    simulated, extended : output that the given model and the extended one have for the same
        motion, without noise

    """

    time: Array
    measured: Array
    simulated: Array
    extended: Array


@dataclass(frozen=True)
class HeadingCurve:
    """Heading error over the log, if the simulation is believed: arrays of shape (n,), s, rad."""

    time: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class NoiseCurve:
    """Allan deviations, shape (n,), s and rad/s; simulated is None for a model without noise."""

    averaging_time: Array
    measured: Array
    fitted: Array
    simulated: Array | None


@dataclass(frozen=True)
class Reference:
    """
    What a log is compared with.

    Attributes
    ----------
    kind : rate_command, encoder, motion_capture, course, odometry, gyro or rest
    known : how the kind is known, in words
    noise : name -> size in SI of the reference's own errors; empty where it is taken as exact

    """

    kind: str
    known: str
    noise: Mapping[str, float] = field(default_factory=dict)

    def figures(self) -> dict[str, Any]:
        """Return it as data."""
        return {'kind': self.kind, 'known': self.known, 'noise': dict(self.noise)}


@dataclass(frozen=True)
class Diagnosis:
    """
    All that was found.

    Attributes
    ----------
    findings : named causes, the strongest first
    unexplained : structure without a name
    noise : of the residual
    simulated : noise of the model that was given; all 0 where none was
    gain : None where nothing is offered that could win
    before, model : the simulation that was put to the test, and the extended one (the same where
        nothing is offered)
    cannot_show : cause -> why these logs cannot show it
    curves : the residual along each variable
    heading, noise_curve, trace : for pictures
    remarks : what a person should know, one sentence each (what was filled, held back, chosen)
    false_alarm_rate : of the whole diagnosis, a log
    logs : names of the files
    method : how it was computed, for people; where it is empty, as a log in time is
    gates : what was checked before anything was named
    reference : what the log was compared with; None where several logs or a rate table were given
    heading_shares : cause, 'reference' or 'left' -> part of the mean square of the heading error
        over 60 s; empty where not computed

    """

    findings: tuple[Finding, ...]
    unexplained: tuple[Unexplained, ...]
    noise: Noise
    simulated: Noise
    gain: Gain | None
    before: GyroModel
    model: GyroModel
    cannot_show: Mapping[str, str] = field(default_factory=dict)
    curves: Sequence[Curve] = ()
    heading: HeadingCurve | None = None
    noise_curve: NoiseCurve | None = None
    remarks: tuple[str, ...] = ()
    false_alarm_rate: float = 0.01
    logs: tuple[str, ...] = ()
    trace: Trace | None = None
    method: str = ''
    gates: tuple[Gate, ...] = ()
    reference: Reference | None = None
    heading_shares: Mapping[str, float] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Return mismatched, adequate, extended or unexplained."""
        if any(gate.passed is False for gate in self.gates):
            return 'mismatched'
        if self.unexplained:
            return 'unexplained'
        return ('extended' if any(each.status == 'established' for each in self.findings)
                else 'adequate')

    def figures(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return {'schema': SCHEMA, 'verdict': self.verdict,
                'false_alarm_rate': self.false_alarm_rate,
                'findings': [finding.figures() for finding in self.findings],
                'unexplained': [each.figures() for each in self.unexplained],
                'noise': _noise(self.noise), 'simulated_noise': _noise(self.simulated),
                'gain': None if self.gain is None else self.gain.figures(),
                'cannot_show': dict(self.cannot_show), 'remarks': list(self.remarks),
                'logs': list(self.logs), 'gates': [gate.figures() for gate in self.gates],
                'heading_shares': dict(self.heading_shares),
                'reference': None if self.reference is None else self.reference.figures()}


def _noise(noise: Noise) -> dict[str, float]:
    return {'angle_random_walk': noise.angle_random_walk,
            'bias_instability': noise.bias_instability,
            'rate_random_walk': noise.rate_random_walk}
