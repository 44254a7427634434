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
The results of a diagnosis as records and as data for files, and the rules that they follow.

A cause is selected if noise alone rarely shows as much. It is established if it also predicts
stretches of the data that took no part in its fit; otherwise it is suspected. Alternatives that
explain the data nearly as well form a set with it, each with its probability.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
import math
from typing import Any, ClassVar, TypeAlias

from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import norm

#: Is called with the share of the work done, None if unknown, and the step that begins; returns
#: whether the time limit is near, so that the search ends and no gain is measured.
OnProgress: TypeAlias = Callable[[float | None, str], object]

_SCHEMA = 'gyro_calibration/diagnosis/2'
TIME_LIMIT_REMARK = ('The time limit was reached: there may be more causes, and the gain of the '
                     'model was not measured.')
#: Why a model is not offered.
NOT_OFFERED = ('On the held-out parts, the errors of the extended model are larger than those of '
               'the model before; it is not offered.')
#: Least probability that is stated; the assumptions on the noise do not justify smaller ones.
MIN_PROBABILITY = 1e-4
#: False-alarm rates of the search for causes, and of each value or noise figure.
SEARCH_ALARM_RATE, VALUE_ALARM_RATE = 0.6 * FALSE_ALARM_RATE, 0.05 * FALSE_ALARM_RATE
#: Ratio of the level at which a lasting cause is suspected to that at which it is established.
SUSPECTED_RATE_FACTOR = 5.0
#: Probability that an effect of the minimum detectable size is found.
DETECTION_POWER = 0.95
#: Least deficit in log-likelihood, relative to the best cause, of a cause that is ruled out (2.5
#: sigma).
RULED_OUT_DEFICIT = 3.2
#: A cause is confirmed if its gain in log-likelihood on held-out stretches exceeds so many
#: standard deviations. The gain of one stretch is limited to a likelihood ratio of one over the
#: same level, so that no single stretch confirms a cause.
_LEVEL = 0.05
MIN_PREDICTION_SIGMAS, _MAX_STRETCH_GAIN = float(norm.isf(_LEVEL)), -math.log(_LEVEL)


def detectable_sigmas(level: float) -> float:
    """Return the size, in standard deviations, that is found at a two-sided level."""
    return float(norm.isf(0.5 * level) + norm.ppf(DETECTION_POWER))


def prediction_sigmas(gains: Array) -> float:
    """Return the gain of held-out stretches in log-likelihood over its standard deviation."""
    if not np.sum(gains) > 0.0:
        return 0.0
    clipped = np.clip(gains, -_MAX_STRETCH_GAIN, _MAX_STRETCH_GAIN)
    scatter = float(np.std(clipped, ddof=1)) * len(gains) ** 0.5
    return float(np.sum(clipped)) / max(scatter, 1e-9)


def probabilities(deficits: Mapping[str, float]) -> dict[str, float]:
    """Return the probabilities of causes by their deficits in log-likelihood, largest first."""
    weights = {name: math.exp(-min(max(lack, 0.0), 700.0)) for name, lack in deficits.items()}
    return {name: max(weight / sum(weights.values()), MIN_PROBABILITY)
            for name, weight in sorted(weights.items(), key=lambda each: -each[1])}


class _Record:
    """A dataclass that is data for a file; `KEYS` are its fields with another key, or none."""

    KEYS: ClassVar[Mapping[str, str | None]] = {}

    def to_dict(self) -> dict[str, Any]:
        """Return it as data."""
        names = [each.name for each in fields(self)]  # type: ignore[arg-type]
        found = {key: _to_data(getattr(self, name)) for name in names
                 if (key := self.KEYS.get(name, name))}
        if 'p_value' in found:
            found['p_value'] = max(found['p_value'], MIN_PROBABILITY)
        return found


def _to_data(value: Any) -> Any:
    if isinstance(value, _Record):
        return value.to_dict()
    if isinstance(value, Noise):
        return asdict(value)
    if isinstance(value, Mapping):
        return {name: _to_data(each) for name, each in value.items()}
    return list(map(_to_data, value)) if isinstance(value, (tuple, list)) else value


@dataclass(frozen=True)
class Estimate(_Record):
    """A value with its 95 % interval, in SI."""

    KEYS = {'interval': 'ci95'}

    estimate: float
    interval: tuple[float, float]
    unit: str

    @classmethod
    def from_half_width(cls, value: float, half_width: float, unit: str) -> Estimate:
        """Return a value with an interval of a half-width on each side."""
        return cls(value, (value - half_width, value + half_width), unit)

    @property
    def deviation(self) -> float:
        """Return the standard deviation, from the half-width of the interval."""
        return (self.interval[1] - self.interval[0]) / (2.0 * NORMAL_QUANTILE_975)

    @property
    def contains_zero(self) -> bool:
        """Return whether the interval includes zero."""
        return self.interval[0] <= 0.0 <= self.interval[1]


@dataclass(frozen=True)
class Gate(_Record):
    """A check before causes are named."""

    KEYS = {'evidence': 'said', 'factor': None}

    name: str  # wrapped_heading, motion, sense, unit, time_unit or model
    passed: bool | None  # None if the log does not show it
    evidence: str  # the measured numbers, in words
    remedy: str = ''  # what to do if it failed
    # ratio of the output to the reference and its 95 % interval, if it failed by that
    factor: tuple[float, tuple[float, float]] | None = None


@dataclass(frozen=True)
class Finding(_Record):
    """One cause."""

    KEYS = {'along': None}

    effect: str  # its name in the catalogue
    cause: str  # one sentence for people
    # name -> estimate; for an effect of the model the change of its value, not for noise figures
    parameters: Mapping[str, Estimate]
    p_value: float  # the probability that a log without it shows as much
    # the smallest detectable value of its first parameter, in its unit; None without a meaning
    minimum_detectable: float | None = None
    ambiguous_with: tuple[str, ...] = ()  # names of causes that these data cannot rule out instead
    separate_by: str = ''  # the experiment that would distinguish them; '' without any
    evidence: str = ''  # one sentence with numbers in units of people
    along: str = ''  # the variable along which it shows, as in `Diagnosis.curves`; '' without one
    status: str = 'established'  # or 'suspected', if it is not confirmed on held-out stretches
    # of the cause and of its alternatives, by name; empty if not computed
    probability: Mapping[str, float] = field(default_factory=dict)
    # in the mean square of the heading error over 60 s; None if not computed
    share_of_heading_error: float | None = None
    where: tuple[float, float] | None = None  # begin and end of an effect in part of the log, s
    remedy: str = ''  # what to do about it


@dataclass(frozen=True)
class Unexplained(_Record):
    """Structure without a name: variable, share of the residual's variance, and p-value."""

    along: str
    share_of_variance: float
    p_value: float


@dataclass(frozen=True)
class Change(_Record):
    """A root mean square error before and after the extension."""

    KEYS = {'interval': 'ci95'}

    before: float
    after: float
    # 95 % interval of before less after; None if a single part was held out
    interval: tuple[float, float] | None

    @property
    def is_worse(self) -> bool:
        """Tell whether the error increased significantly."""
        return self.interval is not None and self.interval[1] < 0.0


@dataclass(frozen=True)
class Gain(_Record):
    """Reduction of errors by the extended model on parts held out of selection and fit."""

    held_out: str  # description of the parts
    rate: Change  # errors of the simulated rate, rad/s
    heading: Change  # errors of the simulated change of heading over windows, rad
    window: float = 60.0  # s
    # name -> root mean square of the heading error of given, plain (bias, scale factor and delay
    # alone) and extended model, rad
    models: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_worse(self) -> bool:
        """Tell whether the extended model has significantly larger errors."""
        return any(change.is_worse for _, change, _ in self.rows())

    def to_dict(self) -> dict[str, Any]:
        """Return it as data."""
        return {'held_out': self.held_out, 'rate_rms': self.rate.to_dict(), 'heading_rms': {
            'window_s': self.window, **self.heading.to_dict()}, **self.models}

    def rows(self) -> list[tuple[str, Change, str]]:
        """Return what was measured before and after, with its unit of SI."""
        return [(f'heading error over {self.window:.3g} s', self.heading, 'rad'),
                ('rate error', self.rate, 'rad/s')]


@dataclass(frozen=True)
class Curve:
    """An error along one variable, for charts: arrays of shape (n,), in SI."""

    along: str  # rate, temperature, heading, time, frequency ...
    unit: str  # of `at`, SI
    at: Array  # the variable; middles of bins
    # before, after: measured less simulated there, by the model that was given and by the
    # extended one
    before: Array
    after: Array
    # standard deviation of means by noise alone, slow noise included; along frequency, where
    # amplitudes replace means, the root mean square amplitude
    deviation: Array | None = None
    # what is simulated with the given model; the measured one is the sum of this and `before`
    simulated: Array | None = None


@dataclass(frozen=True)
class Reference(_Record):
    """The reference of a log."""

    KEYS = {'evidence': 'known'}

    kind: str  # rate_command, encoder, motion_capture, course, odometry, gyro or rest
    evidence: str  # how the kind was found, in words
    # name -> size of the errors of the reference, SI; empty if it is taken as exact
    noise: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Diagnosis(_Record):
    """The results of a diagnosis."""

    KEYS = {'simulated': 'simulated_noise', **dict.fromkeys(
        ('before', 'model', 'curves', 'heading', 'noise_curve', 'trace', 'method'))}

    findings: tuple[Finding, ...]  # named causes, the strongest first
    unexplained: tuple[Unexplained, ...]  # structure without a name
    noise: Noise  # of the residual
    simulated: Noise  # noise of the given model; all 0 without one
    gain: Gain | None  # of the extended model; None if there is nothing to compare
    before: GyroModel  # the tested simulation
    model: GyroModel  # the extended one; the same if none is offered
    cannot_show: Mapping[str, str] = field(default_factory=dict)  # cause -> why
    # of the mean error of the rate along each variable, rad/s, and of the heading over time, rad
    curves: Sequence[Curve] = ()
    heading: Curve | None = None
    # Allan deviations over the averaging time, rad/s: `before` of the residual, `after` of the
    # noise that was found, and simulated; None for a model without noise
    noise_curve: Curve | None = None
    remarks: tuple[str, ...] = ()  # for people, one sentence each
    logs: tuple[str, ...] = ()  # names of the files
    trace: Curve | None = None  # of the output over time, rad/s
    method: str = ''  # how it was computed, for people; empty for the method of logs in time
    gates: tuple[Gate, ...] = ()  # checks before causes were named
    # cause, 'reference' or 'left' -> share in the mean square of the heading error over 60 s
    heading_shares: Mapping[str, float] = field(default_factory=dict)
    reference: Reference | None = None  # None for several logs by an exact one, or a rate table

    @property
    def verdict(self) -> str:
        """Return mismatched, adequate, extended or unexplained."""
        if any(gate.passed is False for gate in self.gates):
            return 'mismatched'
        if self.unexplained:
            return 'unexplained'
        return ('extended' if any(each.status == 'established' for each in self.findings)
                else 'adequate')

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return {'schema': _SCHEMA, 'verdict': self.verdict,
                'false_alarm_rate': FALSE_ALARM_RATE, **super().to_dict()}
