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
Table of the bias at rest over temperature: kept between runs, aged, and used with its variance.

The bias here is the rate at rest *after the model and before the self-calibration*
(`CompensatedSamples.model_rate`), which is also the bias of a `SelfCalibration`. So it does not
depend on the self-calibration in use. The change of the bias with temperature from the table is
added to the bias of the last calibration; the bias from the table is not, which would compensate
it twice.

Biases differ by temperature, whose local coefficient is a smooth random process over temperature;
by runs, as a gyro has another bias after each power-on; by jumps; and by time, through flicker,
random walk and ageing. Each entry is an estimate of the present bias with an error, and the errors
have a known covariance: the present bias is their generalized least squares mean. The sizes of
temperature coefficient and turn-on scatter are estimated by restricted likelihood over a few
values.

A tracker uses a copy of the table, and has an error of the temperature coefficient in its own
state, in units of the uncertainty of the table. New entries are used when the tracker is
restarted, at a rest more than 5 K away; both at once would compensate the bias twice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
import hashlib
import json
import math
from pathlib import Path
from typing import Any

from gyro_calibration.files import describe_error, keep_aside, to_printable, write_atomically
from gyro_calibration.logs.log import Array, DEGREE, Number
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.settings_file import format_settings, read_settings
import numpy as np

#: Largest number of entries.
MAX_ENTRIES = 80
#: Averaging time of a rest, s.
REST_DURATION = 10.0
#: Standard deviations from which on an estimate is an outlier.
OUTLIER_SIGMAS = 4.5
#: Consecutive outliers that agree with each other and are taken for a jump.
_JUMP_ESTIMATES = 3
#: Shortest time between two writes, s.
MIN_WRITE_INTERVAL = 600.0
YEAR = 365.25 * 86400.0
#: Largest time between a calibration and an entry of the same run, and step of the clock after
#: which the age of a calibration is computed again, s.
AGE_TOLERANCE = 3600.0
#: Least variance of a bias, (rad/s)².
_MIN_VARIANCE = 1e-18
#: Sizes of coefficient and turn-on scatter, in units of `Prior`, with their probabilities.
#: With two pairs of sizes the errors in `benchmarks/bias_table.py` are larger.
_COEFFICIENT_SIZES = {0.1: 0.4, 1.0: 0.6}
_TURN_ON_SIZES = {0.3: 0.3, 1.0: 0.5, 4.0: 0.2}
#: Distance up to which the change of the bias with temperature is computed, K; constant beyond.
_MAX_DISTANCE = 100.0
_SIZES = np.array([(coefficient, turn_on)
                   for coefficient in _COEFFICIENT_SIZES for turn_on in _TURN_ON_SIZES])
_SIZE_PROBABILITIES = np.array(
    [often * also for often in _COEFFICIENT_SIZES.values() for also in _TURN_ON_SIZES.values()])


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a gyro: standard deviations of the bias, and distances."""

    coefficient: float = 0.03 * DEGREE  # with temperature, rad/s/K (data sheet of the L3G4200D)
    correlation_length: float = 15.0  # of the coefficient, K
    compensated_share: float = 0.1  # of the coefficient within the range of a compensating model
    turn_on: float = 0.05 * DEGREE  # from one run to the next, rad/s
    ageing: float = 0.02 * DEGREE  # at one temperature in a year, beyond the noise, rad/s
    unknown_distance: float = 15.0  # assumed of an unknown temperature, K


@dataclass(frozen=True)
class Entry:
    """Mean bias at rest in one run and one temperature bin."""

    temperature: float  # degC
    bias: float  # rad/s, after the model and before the self-calibration
    variance: float  # of the bias as a mean around `time`, (rad/s)²
    time: float  # of the last of these rests, s since 1970
    run: float  # number of the run; between whole numbers for a calibration between runs


@dataclass(frozen=True)
class Jump:
    """A step of the bias at all temperatures, where a run begins: (rad/s)² and s since 1970."""

    run: int
    variance: float
    time: float


class BiasTable:
    """Biases at rest over temperature, of one gyro behind one model with a digest."""

    def __init__(self, model: GyroModel, prior: Prior | None = None,
                 entries: Sequence[Entry] = (), jumps: Sequence[Jump] = ()):
        """Begin a new run after older entries, if there are any."""
        self.digest = model_digest(model)
        self.entries, self.jumps = list(entries), list(jumps)
        self.run = 1 + max([-1, *(math.floor(each.run) for each in entries),
                            *(each.run for each in jumps)])
        self._first_run = self.run
        self.held_back_count = 0  # of estimates not used so far
        self._model, self._prior = model, prior or Prior()
        self._held_entries: list[Entry] = []
        self._written_entries, self._write_time = tuple(self.entries), -math.inf

    def begin_run(self) -> None:
        """Expect another turn-on bias, as after the gyro was without power."""
        self._held_entries.clear()
        self.run += any(each.run == self.run for each in self.entries)

    def shift_clock(self, step: float) -> None:
        """Correct the dates since this table began for a clock that was set by a step, s."""
        for name in ('entries', 'jumps', '_held_entries'):
            setattr(self, name, [
                replace(each, time=max(each.time + step, 0.0)) if each.run >= self._first_run
                else each for each in getattr(self, name)])

    def add(self, temperature: float, bias: float, variance: float, time: float) -> str:
        """
        Add the bias of a rest; return a sentence why it is not used, or that it jumped, or ''.

        It is the mean of the rate after the model and before the self-calibration, rad/s, with its
        variance by white noise, (rad/s)²; the wander of the bias is added here. The temperature is
        in degC, the time in s since 1970.
        """
        given = Entry(float(temperature), float(bias), float(variance), float(time), self.run)
        if not _is_possible(given):
            return (f'a bias of {bias:g} rad/s at {temperature:g} degC with a variance of '
                    f'{variance:g} at {time:g} s is not used: it is not plausible for a gyro')
        before, known = self.predict(temperature, time)
        if abs(bias - before) <= OUTLIER_SIGMAS * math.sqrt(known + variance):
            self._held_entries.clear()
            self._add_entry(given)
            return ''
        # of those held back, the ones that agree with this one
        self._held_entries = [each for each in self._held_entries if abs(
            bias - each.bias) <= OUTLIER_SIGMAS * math.sqrt(
                each.variance + variance + self._wander_variance(time - each.time)
                + self._prior.coefficient ** 2 * _mean_square_change(
                    temperature - each.temperature, self._prior.correlation_length))] + [given]
        off = (f'{(bias - before) / DEGREE:.4f} deg/s off what is known at '
               f'{temperature:.1f} degC ({math.sqrt(known) / DEGREE:.4f} deg/s)')
        if len(self._held_entries) < _JUMP_ESTIMATES:
            self.held_back_count += 1
            return f'a bias that is {off} is not used: check whether the robot turned slowly'
        self.held_back_count -= _JUMP_ESTIMATES - 1
        self.run += 1
        self.jumps.append(Jump(self.run, (bias - before) ** 2, self._held_entries[0].time))
        if len(self.jumps) > MAX_ENTRIES:
            first, second, *others = self.jumps
            self.jumps = [replace(second, variance=first.variance + second.variance), *others]
        for each in self._held_entries:
            self._add_entry(replace(each, run=self.run))
        self._held_entries.clear()
        return (f'the bias jumped: {_JUMP_ESTIMATES} rests in a row are {off}; earlier entries '
                'are shifted')

    def _add_entry(self, given: Entry) -> None:
        for place, entry in enumerate(self.entries):
            if entry.run == given.run and _bin_number(entry) == _bin_number(given):
                # with the older aged until the newer
                older = entry.variance + self._wander_variance(given.time - entry.time)
                weight = float(older / (older + given.variance))
                self.entries[place] = replace(
                    given, bias=entry.bias + weight * (given.bias - entry.bias),
                    variance=max(weight * given.variance, 2.0 * _MIN_VARIANCE),
                    temperature=(entry.temperature
                                 + weight * (given.temperature - entry.temperature)))
                return
        self.entries.append(given)
        if len(self.entries) > MAX_ENTRIES:
            # the oldest of the fullest bin, and the jumps that no entry precedes
            (fullest, _), = Counter(map(_bin_number, self.entries)).most_common(1)
            self.entries.remove(min(
                (each for each in self.entries if _bin_number(each) == fullest),
                key=lambda each: (each.run, each.time)))
            first = min(each.run for each in self.entries)
            self.jumps = [each for each in self.jumps if each.run > first]

    def predict(self, temperature: float, time: float) -> tuple[float, float]:
        """Return the bias in this run, rad/s, and its variance, (rad/s)²; 0 and inf if unknown."""
        return self._predict_with_weight(self.entries, temperature, time)[:2]

    def _predict_with_weight(self, entries: Sequence[Entry], temperature: float,
                             time: float) -> tuple[float, float, float]:
        """Return the bias, its variance, and the weight of the last entry in it."""
        if not entries:
            return 0.0, math.inf, 0.0
        temperature, time = _clip_to_range(temperature, time)
        seen = self._posterior_at(entries, temperature, time)
        bias, variance = _mixture_moments(seen.probability, seen.mean, 1.0 / seen.information)
        return (float(bias) + entries[0].bias, float(variance),
                float(seen.probability @ (seen.inverse_times_ones[:, -1] / seen.information)))

    def bias_difference(self, from_temperature: float, to_temperature: Number,
                        time: float) -> tuple[Array, Array]:
        """Return the change of bias between temperatures, rad/s, and its variance, (rad/s)²."""
        shape, to_temperatures = np.shape(to_temperature), np.atleast_1d(to_temperature)
        from_temperature, time = _clip_to_range(from_temperature, time)
        own = self._temperature_variance(from_temperature, to_temperatures)
        if not self.entries:
            return np.zeros(shape), np.reshape(_SIZE_PROBABILITIES @ own, shape)
        seen = self._posterior_at(self.entries, from_temperature, time)
        temperatures = np.array([each.temperature for each in self.entries])
        shared = 0.5 * (self._temperature_variance(from_temperature, temperatures)[:, None]
                        + own[:, :, None]
                        - self._temperature_variance(to_temperatures[:, None], temperatures))
        change, of_shared = ((shared @ values[:, :, None])[..., 0]
                             for values in (seen.inverse_times_residual, seen.inverse_times_ones))
        explained = (shared @ seen.inverse * shared).sum(axis=2)
        change, variance = _mixture_moments(
            seen.probability, change,
            np.maximum(own - explained + of_shared ** 2 / seen.information[:, None], 0.0))
        return np.reshape(change, shape), np.reshape(variance, shape)

    def propagate_calibration(self, calibration: SelfCalibration, age: float, time: float,
                              temperature: float | None = None,
                              this_run: bool = False) -> tuple[SelfCalibration, str]:
        """
        Return a stored calibration propagated to the present.

        It is combined with the table as one more estimate of the bias, at its own temperature and
        time. It is for the start of a run, or the restart of a tracker; within a run a
        `TemperatureCorrection` continues from there. The result includes the age: it is to be used
        as a calibration made at present, and not to be stored. A sentence for diagnostics, '' if
        neither age nor temperature matters, is returned too.

        The age is in s, the present time in s since 1970, and the present temperature in degC,
        None where it is not known; `this_run` tells that the calibration was made in this run.
        """
        assert calibration.covariance is not None
        (of_scale, shared), (_, own) = calibration.covariance
        here, made = calibration.temperature, time - age
        if here is None:
            here = self._model.reference_temperature if temperature is None else temperature
        run: float = self.run
        if not this_run or any(each.time > made for each in self.jumps):
            # that of an entry of about this time, else a number between the jumps around it
            after = max([-1, *(each.run for each in self.jumps if each.time <= made)])
            until = min([run, *(each.run for each in self.jumps if each.time > made)])
            near = {abs(each.time - made): each.run for each in self.entries
                    if after <= each.run < until and abs(each.time - made) < AGE_TOLERANCE}
            run = near[min(near)] if near else after + 0.5
        why = ('at a temperature that is not known'
               if calibration.temperature is None or temperature is None
               else f'at {here:.1f} degC, and now it is {temperature:.1f} degC')
        entry = Entry(
            here, calibration.bias,
            own + (self._unknown_variance() if calibration.temperature is None else 0.0), made,
            run)
        bias, variance, weight = self._predict_with_weight(
            [*self.entries, entry], here if temperature is None else temperature, time)
        if temperature is None:
            variance += self._unknown_variance()
        message = '' if variance < 2.0 * own else (
            f'the calibration was made {timedelta(seconds=round(age))} ago {why}: the standard '
            f'deviation of its bias is now {math.sqrt(variance) / DEGREE:.4f} deg/s, then it was '
            f'{math.sqrt(own) / DEGREE:.4f} deg/s; let the robot rest, or calibrate again')
        covariance = (of_scale, weight * shared), (weight * shared, variance)
        return replace(calibration, bias=bias, covariance=covariance), message

    def _unknown_variance(self) -> float:
        """Return the variance of the bias, (rad/s)², where the model has no temperature."""
        return (float(_SIZE_PROBABILITIES @ _SIZES[:, 0] ** 2)
                * (self._prior.coefficient * self._prior.unknown_distance) ** 2)

    def _temperature_variance(self, here: Array | float, there: Array) -> Array:
        """Return the variance of the bias between temperatures, (rad/s)², shape (sizes, ...)."""
        inside, outside, coefficient = self._prior.coefficient, 0.0, self._prior.coefficient
        if self._model.uses_channel('temperature'):
            inside = coefficient * self._prior.compensated_share
            low, high = self._model.temperature_range
            below = np.minimum(there - low, 0.0) - np.minimum(here - low, 0.0)
            above = np.maximum(there - high, 0.0) - np.maximum(here - high, 0.0)
            outside = coefficient ** 2 * (below ** 2 + above ** 2)
        change = inside ** 2 * _mean_square_change(there - here, self._prior.correlation_length)
        return np.asarray(np.multiply.outer(_SIZES[:, 0] ** 2, change) + outside)

    def _wander_variance(self, age: Array | float) -> Any:
        """Return the variance of the wander of the bias by the noise of the gyro, (rad/s)²."""
        return self._model.noise.mean_change_variance(np.abs(age) + REST_DURATION, REST_DURATION)

    def _posterior_at(self, entries: Sequence[Entry], temperature: float,
                      time: float) -> _Posterior:
        """Return the estimates of the bias in this run, now, at a temperature."""
        temperatures, variances, times, runs, biases = (
            np.array([getattr(each, name) for each in entries])
            for name in ('temperature', 'variance', 'time', 'run', 'bias'))
        # covariance of the errors of the entries now, (rad/s)², shape (sizes, n, n)
        age, runs_apart = np.abs(time - times), _pairwise_differences(runs) != 0.0
        by_temperature = _covariance_of_differences(
            self._temperature_variance(temperature, temperatures),
            self._temperature_variance(temperatures[:, None], temperatures))
        wander = self._wander_variance(_pairwise_differences(times)) * (1.0 - np.eye(len(times)))
        alike = np.exp(
            -np.abs(_pairwise_differences(temperatures)) / self._prior.correlation_length)
        ageing = self._prior.ageing ** 2 / YEAR * alike * np.minimum(age[:, None], age)
        fixed = (_covariance_of_differences(self._wander_variance(age), wander)
                 + np.diag(variances) + ageing)
        for jump in self.jumps:  # shared by all entries before it
            fixed += jump.variance * np.outer(runs < jump.run, runs < jump.run)
        by_run = (self._prior.turn_on ** 2
                  * _covariance_of_differences(2.0 * (runs != self.run), 2.0 * runs_apart))
        covariance = fixed + by_temperature + np.multiply.outer(_SIZES[:, 1] ** 2, by_run)

        # generalized least squares, and the restricted likelihood of each of the sizes
        rests, inverse = biases - biases[0], np.linalg.inv(covariance)
        of_ones, of_rests = inverse.sum(axis=2), inverse @ rests
        information = of_ones.sum(axis=1)
        mean = of_rests.sum(axis=1) / information
        misfit = of_rests @ rests - mean ** 2 * information
        logarithms = -0.5 * (np.linalg.slogdet(covariance)[1] + np.log(information) + misfit)
        likely = _SIZE_PROBABILITIES * np.exp(logarithms - logarithms.max())
        return _Posterior(likely / likely.sum(), mean, information, of_ones,
                          of_rests - mean[:, None] * of_ones, inverse)

    def is_write_due(self, now: float, ending: bool = False) -> bool:
        """Tell whether to write now, s since 1970: if changed, not too often, and at the end."""
        return (self._written_entries != tuple(self.entries)
                and (ending or abs(now - self._write_time) >= MIN_WRITE_INTERVAL))

    def mark_write(self, now: float, is_written: bool = True) -> None:
        """Record a write; one that failed is tried again later, and at the end."""
        self._write_time = now
        if is_written:
            self._written_entries = tuple(self.entries)


@dataclass(frozen=True)
class _Posterior:
    """Estimates of the bias at one temperature, for each of the sizes."""

    probability: Array  # of each size, shape (sizes,)
    mean: Array  # of the biases less that of the first entry, rad/s, shape (sizes,)
    information: Array  # 1 over the variance of the mean, shape (sizes,)
    #: The inverse covariance times ones, and times the deviations of the entries from the mean,
    #: shape (sizes, n); and itself, shape (sizes, n, n).
    inverse_times_ones: Array
    inverse_times_residual: Array
    inverse: Array


def _mixture_moments(probability: Array, means: Array, variances: Array) -> tuple[Any, Any]:
    """Return mean and variance of a mixture over the first axis."""
    mean = probability @ means
    return mean, probability @ (variances + (means - mean) ** 2)


class TemperatureCorrection:
    """Change of the bias from one temperature to others, by a bias table as it is now."""

    def __init__(self, table: BiasTable, begin: float, now: float, coefficient: float):
        """Begin at a temperature, degC, now, s since 1970, with a coefficient above 0, rad/s/K."""
        self.start_temperature = begin
        self._steps = begin + np.arange(-_MAX_DISTANCE, _MAX_DISTANCE + 0.5, 0.5)
        self._changes, variances = table.bias_difference(begin, self._steps, now)
        self._distances = np.copysign(np.sqrt(variances), self._steps - begin) / coefficient

    def change_at(self, temperature: Number) -> tuple[Any, Any]:
        """Return the change of the bias, rad/s, and the signed distance, K of the coefficient."""
        return (np.interp(temperature, self._steps, self._changes),
                np.interp(temperature, self._steps, self._distances))


def _mean_square_change(distance: Array | float, length: float) -> Any:
    """Return the mean square, K², of the integral of a process of variance 1 over a distance."""
    # Its covariance is (1 + |d|/length) exp(-|d|/length). Its paths have a slope, unlike those of
    # a Gauss-Markov process: the bias over temperature is as smooth.
    lengths = np.abs(distance) / length
    return 2.0 * length ** 2 * (2.0 * lengths - 3.0 + (3.0 + lengths) * np.exp(-lengths))


def _pairwise_differences(values: Array) -> Array:
    return values[:, None] - values


def _covariance_of_differences(from_origin: Array, pairwise: Array) -> Array:
    """Return the covariance of members, from the mean squares off a point and between them."""
    return np.asarray(0.5 * (from_origin[..., :, None] + from_origin[..., None, :] - pairwise))


def _bin_number(entry: Entry) -> int:
    """Return the temperature bin of an entry; a run has one entry in each."""
    # the coefficient is the same within a tenth of its correlation length
    return round(entry.temperature / (0.1 * Prior.correlation_length))


def _is_possible(entry: Entry) -> bool:
    """Tell whether this may be a bias of a gyro; nan never is."""
    temperature, time = _clip_to_range(entry.temperature, entry.time)
    return (entry.temperature == temperature and entry.time == time and abs(entry.bias) <= 1e4
            and _MIN_VARIANCE <= entry.variance <= 1e8 and 0 <= entry.run <= 1e9)


def _clip_to_range(temperature: float, time: float) -> tuple[float, float]:
    """Return temperature, degC, and time, s since 1970, limited to their possible ranges."""
    return min(max(temperature, -273.15), 1e4), min(max(time, 0.0), 1e11)


_FORMAT = 'gyro_calibration/bias_table'
_VERSION = 1
_HEADER = ('# Biases of a gyro at rest, rad/s, behind the model with this digest and before '
           'any self-calibration; times are UTC.\n'
           '# Written by the compensation node. If it is deleted, estimation begins again.\n')


def model_digest(model: GyroModel) -> str:
    """Return a digest of effects and serial number: models with the same share biases."""
    content = ([[term.effect.name, list(term.values)] for term in model.terms],
               model.gyro.get('serial_number', ''))
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def read_bias_table(path: str | Path, model: GyroModel,
                    prior: Prior | None = None) -> tuple[BiasTable, str]:
    """
    Read the table of earlier runs at the begin of a run.

    A sentence says why it is empty although there is a file, which is kept under another name when
    a new one is written; else it is ''.
    """
    try:
        digest, entries, jumps = _read_file(Path(path))
    except FileNotFoundError:
        return BiasTable(model, prior), ''
    except (OSError, ValueError, TypeError, KeyError, OverflowError) as error:
        message = (f'{path} cannot be read as a bias table ({describe_error(error)}): estimation '
                   'begins again, and the file is kept')
        return BiasTable(model, prior), to_printable(message)
    if digest != model_digest(model):
        return BiasTable(model, prior), to_printable(
            f'the bias table in {path} belongs to another model: estimation begins again, and the '
            'file is kept')
    return BiasTable(model, prior, entries, jumps), ''


def write_bias_table(path: str | Path, table: BiasTable,
                     now: float) -> tuple[str, tuple[int, int]]:
    """
    Write a table completely or not at all, as `files.write_atomically`; return its version.

    A file in its place that is unreadable or not of this model is kept under another name, in a
    sentence that is returned first, else ''. Raise `OSError` where the folder is not writable.
    """
    path = Path(path)
    try:
        is_ours = not path.exists() or _read_file(path)[0] == table.digest
    except (OSError, ValueError, TypeError, KeyError, OverflowError):
        is_ours = False  # a file of unknown content is not overwritten
    message = '' if is_ours else keep_aside(path)
    entries = [{'temperature': round(each.temperature, 3), 'bias': _round_digits(each.bias),
                **_common_fields(each)} for each in table.entries]
    content = {'format': _FORMAT, 'version': _VERSION, 'model': table.digest, 'entries': entries,
               'jumps': [_common_fields(each) for each in table.jumps]}
    written = write_atomically(path, (_HEADER + format_settings(content)).encode())
    table.mark_write(now)
    return message, written


def _read_file(path: Path) -> tuple[str, list[Entry], list[Jump]]:
    """Return digest, entries and jumps of a file."""
    content = read_settings(path)
    if not isinstance(content, dict) or content.get('format') != _FORMAT:
        raise ValueError(f'it has no line format: {_FORMAT}')
    if content.get('version') != _VERSION:
        raise ValueError(f'its version is {content.get("version")!r:.40}, wanted {_VERSION}')
    entries = [_entry_from_row(row, float(row['temperature']), float(row['bias']))
               for row in _rows(content, 'entries')]
    jumps = [Jump(int(each.run), each.variance, each.time)
             for each in (_entry_from_row(row, 0.0, 0.0) for row in _rows(content, 'jumps'))]
    return str(content['model']), entries, jumps


def _entry_from_row(row: Mapping[str, Any], temperature: float, bias: float) -> Entry:
    # of a text, or of what YAML takes it for
    text = str(row['time']).removesuffix('Z').removesuffix('+00:00')
    entry = Entry(temperature, bias, float(row['standard_deviation']) ** 2,
                  float(np.datetime64(text, 's').astype('int64')), int(row['run']))
    if not _is_possible(entry):
        raise ValueError(f'it has implausible values: {entry}')
    return entry


def _rows(content: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    rows = content[name]
    if (not isinstance(rows, list) or len(rows) > MAX_ENTRIES
            or not all(isinstance(row, dict) for row in rows)):
        raise ValueError(f'{name} is no list of at most {MAX_ENTRIES} rows')
    return rows


def _common_fields(row: Entry | Jump) -> dict[str, Any]:
    time = str(np.datetime64(round(row.time), 's'))
    return {'standard_deviation': _round_digits(math.sqrt(row.variance)), 'time': time,
            'run': int(row.run)}


def _round_digits(value: float) -> float:
    return float(f'{value:.9g}')
