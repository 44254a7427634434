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
Logs with hidden effects, and the truth about them.

The chain: the rate as the gyro senses it (time offset, clock, bandwidth); additions to it; noise;
saturation; quantization; faults of samples; a wrong unit. Effects on the reference change the
reference alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
import gzip
import io
import math
from pathlib import Path
from typing import Any

from gyro_calibration_bench.hidden.effects import (
    COUNTED_FAULTS, effect_errors, EffectForm, FORMS, OUTSIDE_CATALOGUE, sensed_rate, Shapes,
    slip_angle, STEP_EFFECTS, top_rate, UNIT_DELAYS, UNIT_FACTORS, WITHOUT_COLUMN)
from gyro_calibration_bench.hidden.motion import Session, session
from gyro_calibration_bench.hidden.noise import draw_figures, generate_noise, NoiseFigures
from gyro_calibration_bench.hidden.size import (
    DETECTION_SIGMAS, InformationMetric, Likeness, solve_noise, solve_size)
import numpy as np

#: Recordings -> name of an effect -> what of it is not to be random.
FixedParts = Callable[[list[Session]], Mapping[str, Shapes]]
ALL: Mapping[str, EffectForm] = {**FORMS, **OUTSIDE_CATALOGUE}
#: Largest share of an outside effect that one in the catalogue may explain, and draws for that.
MAX_LIKENESS = 0.25
MAX_DRAWS = 30
#: Bias of a gyro and its power-on to power-on scatter, rad/s, and the largest scale factor error.
BIAS_DEVIATION, BIAS_SPREAD, MAX_SCALE_FACTOR_ERROR = 3e-3, 3e-4, 0.02


@dataclass(frozen=True)
class Cause:
    """One hidden effect."""

    name: str  # in the catalogue, or outside it
    size: float  # the leading parameter as added, in SI; for a figure of the noise its value
    shapes: Shapes  # the other parameters
    unit: str  # of the size
    # size that is just detected alone; for saturation a limit, for a figure of the noise a change;
    # nan without meaning
    minimum_detectable: float
    multiple: float  # of the minimum detectable effect, that is hidden
    apart: float = math.nan  # the multiple that is independent of the other hidden effects
    # of an effect outside the catalogue, the share that the best effect in it explains
    likeness: float = math.nan

    @property
    def standard_deviation(self) -> float:
        """Least standard deviation of an estimate of the size, if the effect is linear in it."""
        return self.minimum_detectable / DETECTION_SIGMAS


@dataclass(frozen=True)
class Gyro:
    """A hidden gyro, which can be recorded again under other conditions."""

    causes: tuple[Cause, ...]  # what is hidden
    figures: NoiseFigures
    scale_factor_error: float  # 1
    biases: tuple[float, ...]  # of the recordings that the sizes are for, rad/s
    bias_spread: float  # standard deviation of the bias between power-ons, rad/s

    def bias_of(self, run: int, generator: np.random.Generator) -> float:
        """Return the bias of one recording, rad/s; a new one for an unplanned recording."""
        return (self.biases[run] if run < len(self.biases)
                else float(generator.normal(np.mean(self.biases), self.bias_spread)))

    def size_of(self, name: str) -> float:
        """Return the size of a hidden effect, 0 where it is not hidden."""
        return next((cause.size for cause in self.causes if cause.name == name), 0.0)

    def has(self, name: str) -> bool:
        return any(cause.name == name for cause in self.causes)


@dataclass(frozen=True)
class Truth:
    """The truth about one recording, at the rows of its log."""

    gyro: Gyro
    names: tuple[str, ...]  # of the hidden effects
    bias: float  # of this recording, rad/s
    scale_factor_error: float  # 1
    # a model that knows all but what is hidden, in SI: bias, scale_factor_error,
    # angle_random_walk, bias_instability, rate_random_walk
    expected: Mapping[str, float]
    rate: np.ndarray  # true, rad/s
    heading: np.ndarray  # true, rad
    added_rate: np.ndarray  # by all effects, bias and scale included, without noise, rad/s
    reference: np.ndarray  # rate that the reference states, rad/s
    noise: np.ndarray  # that was added, rad/s
    prediction: np.ndarray  # output with all but the noise known, rad/s
    is_good: np.ndarray  # False where the sample is an outlier or repeated

    def __getitem__(self, name: str) -> Cause:
        return next(cause for cause in self.gyro.causes if cause.name == name)


@dataclass(frozen=True)
class HiddenLog:
    """Columns in the log format, by name, the truth, and the conditions."""

    columns: Mapping[str, np.ndarray]
    truth: Truth
    session: Session

    def write(self, path: str | Path) -> Path:
        """Write a CSV file, compressed where the name ends in .gz, and return its path."""
        text = io.StringIO()
        text.write(','.join(self.columns) + '\n')
        rows = zip(*(column.tolist() for column in self.columns.values()))
        text.writelines(','.join(map(repr, row)) + '\n' for row in rows)
        data = text.getvalue().encode()
        Path(path).write_bytes(gzip.compress(data, 1) if str(path).endswith('.gz') else data)
        return Path(path)


def hide(names: Sequence[str], multiple: float | Mapping[str, float],
         generator: np.random.Generator, *, noise: str = 'mixed',
         reference: str = 'rate', duration: float = 900.0, sample_rate: float = 50.0,
         runs: int = 1, encoder_step: float = 0.0,
         figures: NoiseFigures | None = None, conditions: Mapping[str, Any] | None = None,
         fixed_parts: FixedParts | None = None, against_a_model: bool = False) -> list[HiddenLog]:
    """
    Hide effects in recordings of a random gyro under random conditions, and return a log of each.

    Parameters
    ----------
    names : of effects in `FORMS` or `OUTSIDE_CATALOGUE`; without any, bias, scale error and noise
        alone
    multiple : of the minimum detectable effect, one for all or by name
    generator : source of all that is random
    noise : white, walk, flicker, gauss_markov or mixed (random walk, Gauss-Markov process, and
        flicker in every other)
    reference : rate, heading or both
    duration, sample_rate : of each recording, s and Hz
    runs : recordings of the one gyro, each after a power-on of its own
    encoder_step : of a reference heading, rad; 0 is a heading without steps
    figures : the noise instead of a random one
    conditions : words for `session`: motion, temperature, supply, force, top_rate
    fixed_parts : recordings -> name of an effect -> its parts that are not random: its shapes, its
        'sign', or its 'size' in SI, which determines the multiple
    against_a_model : a model with bias and scale is known, so that they hide nothing

    """
    sessions = [session(generator, duration, sample_rate, **(conditions or {}))
                for _ in range(runs)]
    expected = figures or draw_figures(noise, generator)
    gyro = draw_gyro(names, multiple, generator, sessions, expected, encoder_step,
                     fixed_parts(sessions) if fixed_parts else {},
                     ('bias', 'scale') if against_a_model else ())
    return [record(gyro, each, generator, expected=expected, reference=reference,
                   encoder_step=encoder_step, run=run) for run, each in enumerate(sessions)]


def draw_gyro(names: Sequence[str], multiple: float | Mapping[str, float],
              generator: np.random.Generator, sessions: list[Session], expected: NoiseFigures,
              encoder_step: float = 0.0, fixed_parts: Mapping[str, Shapes] | None = None,
              known_nuisances: tuple[str, ...] = ()) -> Gyro:
    """Draw a gyro whose hidden effects have these multiples of the minimum detectable effect."""
    multiples = dict.fromkeys(names, multiple) if not isinstance(multiple, Mapping) else multiple
    figures, causes = expected, []
    for name in names:
        if FORMS.get(name) and FORMS[name].stage == 'noise':
            cause, figures = _draw_noise(name, multiples[name], generator, sessions, figures)
            causes.append(cause)
    biases = generator.normal(generator.normal(0.0, BIAS_DEVIATION), BIAS_SPREAD, len(sessions))
    scale = generator.uniform(-MAX_SCALE_FACTOR_ERROR, MAX_SCALE_FACTOR_ERROR)
    if 'unit_error' in names:  # a scale factor error would be taken for a part of it
        scale, biases = 0.0, 0.0 * biases
    gyro = Gyro((), figures, scale, tuple(biases.tolist()), BIAS_SPREAD)
    metric = InformationMetric(sessions, figures, encoder_step)
    sizing = _Sizing(sessions, gyro, metric, known_nuisances)
    causes += [_draw_cause(name, multiples[name], generator, sizing,
                           (fixed_parts or {}).get(name, {}))
               for name in names if ALL[name].stage != 'noise']
    return replace(gyro, causes=_with_remaining_multiples(causes, sizing))


@dataclass(frozen=True)
class _Sizing:
    """Basis of sizes: recordings, gyro without effects, information, and known nuisances."""

    sessions: list[Session]
    gyro: Gyro
    metric: InformationMetric
    known_nuisances: tuple[str, ...]

    def errors(self, name: str, size: float, shapes: Shapes) -> list[np.ndarray]:
        """Return an effect's addition to each recording, to the output after bias and scale."""
        if ALL[name].stage != 'output':
            return effect_errors(ALL[name], size, shapes, self.sessions)
        outputs = [(1.0 + self.gyro.scale_factor_error) * each.rate + bias
                   for each, bias in zip(self.sessions, self.gyro.biases)]
        return [ALL[name].error(each, output, size, shapes)
                for each, output in zip(self.sessions, outputs)]

    def norm(self, name: str, size: float, shapes: Shapes) -> float:
        """Return how many standard deviations an effect is."""
        of_the_same = {'bias': ('bias',), 'scale_factor_error': ('scale',),
                       'reference_scale': ('scale',)}.get(name, ())
        return self.metric.norm(self.errors(name, size, shapes),
                                (*self.known_nuisances, *of_the_same))


def _draw_cause(name: str, multiple: float, generator: np.random.Generator, sizing: _Sizing,
                fixed_parts: Shapes) -> Cause:
    form, sessions = ALL[name], sizing.sessions
    if name in COUNTED_FAULTS or name in STEP_EFFECTS or name == 'unit_error':
        return _draw_without_column(name, multiple, generator, sizing)
    if name in OUTSIDE_CATALOGUE:
        return _draw_outside(name, multiple, generator, sizing)
    shapes = ({key: value for key, value in fixed_parts.items() if key not in ('size', 'sign')}
              or form.shapes(sessions, generator))
    sign = fixed_parts.get('sign', float(generator.choice([-1.0, 1.0])) if form.is_signed else 1.0)
    if 'size' in fixed_parts:
        return Cause(name, fixed_parts['size'], shapes, form.unit, math.nan,
                     sizing.norm(name, fixed_parts['size'], shapes) / DETECTION_SIGMAS)
    if form.is_linear:
        least = DETECTION_SIGMAS / sizing.norm(name, 1.0, shapes)
        return Cause(name, sign * multiple * least, shapes, form.unit, least, multiple)
    if name == 'saturation':
        return _draw_saturation(multiple, sizing)
    most = form.max_size(sessions)

    def norm(size: float) -> float:
        return sizing.norm(name, sign * size, shapes)
    least = solve_size(norm, DETECTION_SIGMAS, 1e-3 * most, most)
    size = solve_size(norm, DETECTION_SIGMAS * multiple, min(least * multiple, most), most)
    return Cause(name, sign * size, shapes, form.unit, least, norm(size) / DETECTION_SIGMAS)


def _draw_outside(name: str, multiple: float, generator: np.random.Generator,
                  sizing: _Sizing) -> Cause:
    """Draw shapes until no catalogued effect explains much of it, or keep the least explained."""
    form, likeness = OUTSIDE_CATALOGUE[name], Likeness(sizing.sessions, sizing.gyro.figures)
    drawn: list[tuple[float, int, Shapes]] = []
    for _ in range(MAX_DRAWS):
        shapes = form.shapes(sizing.sessions, generator)
        column = effect_errors(form, 1.0, shapes, sizing.sessions)
        drawn.append((likeness.explained_share(column), len(drawn), shapes))
        if drawn[-1][0] < MAX_LIKENESS:
            break
    share, _, shapes = min(drawn, key=lambda each: each[:2])
    least = DETECTION_SIGMAS / sizing.norm(name, 1.0, shapes)
    size = float(generator.choice([-1.0, 1.0])) * multiple * least
    return Cause(name, size, shapes, form.unit, least, multiple, likeness=share)


def _draw_saturation(multiple: float, sizing: _Sizing) -> Cause:
    """Solve for the distance of the limit below the largest output; a higher limit shows less."""
    top = (1.0 + sizing.gyro.scale_factor_error) * top_rate(sizing.sessions) + max(
        map(abs, sizing.gyro.biases))

    def norm(below: float) -> float:
        return sizing.norm('saturation', top - below, {})
    below = solve_size(norm, DETECTION_SIGMAS, 1e-3 * top, 0.9 * top)
    further = solve_size(norm, DETECTION_SIGMAS * multiple, below, 0.9 * top)
    return Cause('saturation', top - further, {}, FORMS['saturation'].unit, top - below,
                 norm(further) / DETECTION_SIGMAS)


def _with_remaining_multiples(causes: list[Cause], sizing: _Sizing) -> tuple[Cause, ...]:
    """Return the causes with the multiples that are independent of the other causes."""
    shown = [cause for cause in causes if cause.name not in WITHOUT_COLUMN]
    if not shown:
        return tuple(causes)
    columns = [sizing.errors(cause.name, cause.size, cause.shapes) for cause in shown]
    gram = sizing.metric.gram(columns, sizing.known_nuisances)
    scale = np.sqrt(np.diag(gram))
    left = 1.0 / np.sqrt(np.diag(np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-12,
                                                hermitian=True)))
    apart = {cause.name: float(length * share) / DETECTION_SIGMAS
             for cause, length, share in zip(shown, scale, left)}
    return tuple(replace(cause, apart=apart.get(cause.name, math.nan)) for cause in causes)


def _draw_without_column(name: str, multiple: float, generator: np.random.Generator,
                         sizing: _Sizing) -> Cause:
    """Draw what has no column: counted faults, steps, and wrong units."""
    form, interval = FORMS[name], sizing.sessions[0].interval
    if name in COUNTED_FAULTS:
        return Cause(name, float(max(1, round(COUNTED_FAULTS[name] * multiple))), {}, form.unit,
                     COUNTED_FAULTS[name], multiple)
    if name == 'unit_error':
        kind = str(generator.choice([*UNIT_FACTORS, *UNIT_DELAYS]))
        shapes = {'delay': UNIT_DELAYS.get(kind, 0.0) * interval}
        return Cause(name, UNIT_FACTORS.get(kind, 1.0), shapes, form.unit, math.nan, math.nan)
    count = sum(len(each.time) for each in sizing.sessions)
    extra = (DETECTION_SIGMAS * math.sqrt(2.0 / count)
             * sizing.gyro.figures.sample_deviation(interval) ** 2)
    # a step q adds q² / 12 to the variance; differences of headings twice that / interval²
    least = (math.sqrt(12.0 * extra) if name == 'quantization'
             else math.sqrt(6.0 * extra) * interval)
    return Cause(name, multiple * least, {}, form.unit, least, multiple)


def _draw_noise(name: str, multiple: float, generator: np.random.Generator,
                sessions: list[Session], expected: NoiseFigures) -> tuple[Cause, NoiseFigures]:
    """Change a noise figure until the spectrum shows it; white noise up or down, others up."""
    start, sign = getattr(expected, name), 1.0
    if name == 'angle_random_walk' and multiple * DETECTION_SIGMAS / math.sqrt(
            2.0 * len(sessions[0].time)) < 0.5:
        sign = float(generator.choice([-1.0, 1.0]))

    def changed(change: float) -> NoiseFigures:
        return replace(expected, **{name: start + sign * change})
    guess = 1e-2 * (start or expected.angle_random_walk)
    least = solve_noise(changed, expected, DETECTION_SIGMAS, sessions, guess)
    change = solve_noise(changed, expected, DETECTION_SIGMAS * multiple, sessions, least)
    return (Cause(name, start + sign * change, {}, FORMS[name].unit, least, multiple),
            changed(change))


def record(gyro: Gyro, conditions: Session, generator: np.random.Generator, *,
           expected: NoiseFigures | None = None, reference: str = 'rate',
           encoder_step: float = 0.0, run: int = 0) -> HiddenLog:
    """Record a gyro under a session's conditions, perhaps not those its effects were sized for."""
    bias = gyro.bias_of(run, generator)
    delay = next((cause.shapes['delay'] for cause in gyro.causes if cause.name == 'unit_error'),
                 0.0)
    w = sensed_rate(conditions, gyro.size_of('time_offset') + delay, gyro.size_of('clock_rate'),
                    gyro.size_of('bandwidth'))
    added = bias + gyro.scale_factor_error * w
    for cause in gyro.causes:
        form = ALL[cause.name]
        if form.stage == 'sum' and not (form.is_single_event and cause.shapes['run'] != run):
            added = added + form.error(conditions, w, cause.size, cause.shapes)
    prediction = w + added
    white, slow = generate_noise(gyro.figures, len(w), conditions.interval, generator)
    output, wanted = (_finish_output(gyro, each) for each in (prediction + white + slow,
                                                              prediction))
    reference_rate, reference_heading = _stated_reference(gyro, conditions, run)
    columns = {'time_s': conditions.time, 'gyro_rad_s': output,
               **_measured_conditions(conditions, generator)}
    if step := gyro.size_of('reference_quantization') or encoder_step:
        columns['reference_heading_rad'] = np.round(reference_heading / step) * step
    else:
        both = {'reference_rate_rad_s': reference_rate, 'reference_heading_rad': reference_heading}
        columns |= {name: column for name, column in both.items()
                    if reference == 'both' or reference in name}
    columns, good, kept = _add_sample_faults(gyro, columns, generator, conditions)
    rows, figures = np.flatnonzero(kept), expected or gyro.figures
    model = {'bias': bias, 'scale_factor_error': gyro.scale_factor_error,
             'angle_random_walk': figures.angle_random_walk,
             'bias_instability': figures.equivalent_floor,
             'rate_random_walk': figures.rate_random_walk}
    truth = Truth(gyro, tuple(cause.name for cause in gyro.causes), bias, gyro.scale_factor_error,
                  model, conditions.rate[rows], conditions.heading[rows],
                  (prediction - conditions.rate)[rows], reference_rate[rows],
                  (white + slow)[rows], wanted[rows], good[rows])
    return HiddenLog(columns, truth, conditions)


def _finish_output(gyro: Gyro, signal: np.ndarray) -> np.ndarray:
    """Clip, round, and take the wrong unit."""
    if gyro.has('saturation'):
        signal = np.clip(signal, -gyro.size_of('saturation'), gyro.size_of('saturation'))
    if gyro.has('quantization'):
        signal = np.round(signal / gyro.size_of('quantization')) * gyro.size_of('quantization')
    return signal * gyro.size_of('unit_error') if gyro.has('unit_error') else signal


def _stated_reference(gyro: Gyro, each: Session, run: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rate and heading stated by the reference, true or wrong, without encoder steps."""
    rate, heading = each.rate, each.heading
    for cause in gyro.causes:
        if cause.name == 'reference_once_per_rev':
            phase = cause.shapes['phase']
            heading = heading - cause.size * (np.cos(each.heading + phase) - math.cos(phase))
        if cause.name == 'reference_scale':
            heading = heading + cause.size * each.heading
        form = ALL[cause.name]
        if form.stage == 'reference' and cause.name not in STEP_EFFECTS and not (
                form.is_single_event and cause.shapes['run'] != run):
            wrong = -form.error(each, each.rate, cause.size, cause.shapes)
            rate = rate + wrong
            if cause.name == 'reference_slip':
                heading = heading + cause.size * slip_angle(each, cause.shapes)
    return rate, heading


def _measured_conditions(each: Session, generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the other measurements; the thermometer has fine steps, or some noise, or neither."""
    temperature = each.temperature
    kind = generator.integers(4)
    if kind == 0:
        temperature = np.round(temperature * 340.0) / 340.0
    elif kind == 1:
        temperature = np.round(temperature * 16.0) / 16.0
    elif kind == 2:
        temperature = temperature + 0.01 * generator.standard_normal(len(temperature))
    count = len(temperature)
    return {'temperature_degc': temperature,
            'acceleration_mps2': each.specific_force + 0.005 * generator.standard_normal(count),
            'supply_v': each.supply + 0.0005 * generator.standard_normal(count),
            'moving': each.moving.astype(float)}


def _add_sample_faults(gyro: Gyro, columns: dict[str, np.ndarray], generator: np.random.Generator,
                       each: Session) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Make outliers, repeats and gaps; return the columns, good true rows, and kept rows."""
    output = columns['gyro_rad_s'].copy()
    count = len(output)
    good, kept = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    if gyro.has('outliers'):
        rows = generator.choice(count, int(gyro.size_of('outliers')), replace=False)
        size = gyro.figures.sample_deviation(each.interval) * generator.uniform(10.0, 40.0,
                                                                                len(rows))
        output[rows] += size * generator.choice([-1.0, 1.0], len(rows))
        good[rows] = False
    if gyro.has('stuck_samples'):
        for start in _turning_rows(each, int(gyro.size_of('stuck_samples')), generator):
            repeated = slice(start + 1, start + int(generator.integers(4, 20)))
            output[repeated], good[repeated] = output[start], False
    if gyro.has('dropped_samples'):
        for start in _turning_rows(each, int(gyro.size_of('dropped_samples')), generator):
            kept[start:start + int(generator.integers(1, 6))] = False
    columns = {**columns, 'gyro_rad_s': output}
    return {name: column[kept] for name, column in columns.items()}, good, kept


def _turning_rows(each: Session, count: int, generator: np.random.Generator) -> list[int]:
    """Choose rows while it turns, not in the first or last seconds, and not close together."""
    margin = round(2.0 / each.interval)
    rows = generator.permutation(margin + np.flatnonzero(
        np.abs(each.rate[margin:-margin]) > 0.02 * np.abs(each.rate).max()))
    chosen: list[int] = []
    for row in rows:
        if len(chosen) < count and all(abs(row - other) > 25 for other in chosen):
            chosen.append(int(row))
    return chosen
