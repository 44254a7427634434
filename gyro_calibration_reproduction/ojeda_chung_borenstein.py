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
Ojeda, Chung and Borenstein (2000), rate-table calibration of fibre-optic gyros.

Source: "Precision calibration of fiber-optics gyroscopes for mobile robot navigation", ICRA.
Published numbers are in their units; numbers here are computed in SI and converted.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import fit_effects, Scatter
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, Effect, rate_temperature_polynomial, SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE, SINE_RESPONSE)
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration_reproduction.finding import (
    Comparison, Contradiction, from_own_figures, Reproduction)
import numpy as np

TITLE = ('Ojeda, Chung and Borenstein: Precision calibration of fiber-optics gyroscopes for '
         'mobile robot navigation, ICRA 2000')
#: Table I: deg/s; % over all temperatures, p-p; deg/s; deg/s over all temperatures, p-p;
#: (deg/h)/√Hz; and from section 4, Hz.
FULL_SCALE, SCALE_OVER_TEMPERATURE, BIAS_STABILITY = 100.0, 2.0, 0.002
BIAS_OVER_TEMPERATURE, ANGLE_RANDOM_WALK, OUTPUT_RATE = 0.2, 5.0, 10.0
#: Section 3: samples of a data set, orders p and q, degC.
SAMPLES_PER_SET, RATE_ORDER, TEMPERATURE_ORDER, MIN_TEMPERATURE, MAX_TEMPERATURE = (
    100, 3, 2, 25.0, 45.0)
#: Assumed: K from the coldest to the warmest of Table I; s, so that a turn at 100 deg/s reads
#: half a deg/s less.
TEMPERATURE_SPAN, SINE_CONSTANT = 115.0, 0.1
#: Assumed for comparison: a shaking table, deg/s, and the sine of another open-loop gyro, s.
VIBRATION_RATE, STRONG_SINE_CONSTANT = 1.0, 0.25
POLYNOMIAL = rate_temperature_polynomial(RATE_ORDER, TEMPERATURE_ORDER)
PHYSICAL_EFFECTS = ((BIAS, SCALE_FACTOR_ERROR, BIAS_TEMPERATURE, SCALE_FACTOR_TEMPERATURE,
                     SINE_RESPONSE))
#: Rates and temperatures of a campaign: the fewest, those of p = q = 11, and every 10 deg/s.
CAMPAIGNS = ((4, 3), (11, 11), (21, 11))
ASSUMED = (
    'The gyro is synthetic: noise (5 (deg/h)/sqrt(Hz) at 10 Hz, flicker of 0.002 deg/s), bias and '
    'scale over temperature of Table I, the two latter spread evenly over 115 K, a bias of '
    '0.02 deg/s, and a sine response with k = 0.1 s, which takes half a deg/s off 100 deg/s, '
    'since the errors of figures 3 to 6 are a few tenths of deg/s.',
    'The table turns exactly, the thermometer reads exactly, and nothing changes between '
    'calibration and use but the noise.',
    'Errors are taken at 5 to 100 deg/s both ways and 25 to 45 degC, each turn after 10 s of rest '
    'whose mean is subtracted (eq. 1 and 15).',
)


def rd2100(sine_constant: float = SINE_CONSTANT) -> GyroModel:
    """Return a gyro like the KVH E-Core RD2100, with the sine response of a given k, s."""
    terms = (Term(BIAS, (0.02 * DEGREE,)),
             Term(BIAS_TEMPERATURE,
                  (MIN_TEMPERATURE, BIAS_OVER_TEMPERATURE * DEGREE / TEMPERATURE_SPAN)),
             Term(SCALE_FACTOR_TEMPERATURE,
                  (MIN_TEMPERATURE, SCALE_OVER_TEMPERATURE / 100.0 / TEMPERATURE_SPAN)),
             Term(SINE_RESPONSE, (sine_constant, 1.0)))
    return GyroModel(terms, noise=Noise(ANGLE_RANDOM_WALK * DEGREE / 3600.0,
                                        BIAS_STABILITY * DEGREE))


def reproduce(generator: np.random.Generator, runs: int = 200) -> Reproduction:
    found = np.array([calibrate_and_turn(generator) for _ in range(max(2, runs // 20))])
    regressor, sine = _regressor(generator), _sine(generator, len(found))
    return Reproduction(TITLE, ASSUMED, (*_compare_own_figures(), *_compare_instrument(),
                                         *_compare_results(found), *_compare_drifts(generator)),
                        (_index(), regressor, sine, _full_turn()))


# a rate table

def rate_temperature_grid(rates: Array, temperatures: Array) -> tuple[Array, Array]:
    """Return every rate at every temperature, temperature by temperature."""
    return np.tile(rates, len(temperatures)), np.repeat(temperatures, len(rates))


def simulate_rate_table(gyro: GyroModel, rates: Array, temperatures: Array,
                        generator: np.random.Generator) -> Dwells:
    """Return averaged data sets (eq. 5 to 7) for rates, rad/s, and temperatures, degC."""
    rate, temperature = rate_temperature_grid(rates, temperatures)
    noise = simulate_noise(gyro.noise, len(rate) * SAMPLES_PER_SET, 1.0 / OUTPUT_RATE,
                           generator).reshape(len(rate), SAMPLES_PER_SET)
    return Dwells(rate, gyro.output(rate, temperature) + noise.mean(axis=1), temperature,
                  np.full(len(rate), np.nan),
                  np.repeat(np.arange(len(temperatures)), len(rates)), ('',) * len(rate))


def fit_model(dwells: Dwells, effects: Sequence[Effect]) -> GyroModel:
    """Return the model by least squares with equal weights of all data sets (eq. 9)."""
    equal_scatter = Scatter(dwell_bias=1.0, dwell_scale=0.0, sweep_bias=0.0, sweep_scale=0.0,
                            inliers=np.ones(len(dwells), bool))
    return fit_effects(dwells, effects, equal_scatter).model


def full_range_rates(count: int) -> Array:
    """Return rates over the whole range, rad/s."""
    return np.linspace(-FULL_SCALE, FULL_SCALE, count) * DEGREE


def calibrate_and_turn(generator: np.random.Generator) -> Array:
    """
    Calibrate by each of `CAMPAIGNS`, then turn by 360 deg at all rates and temperatures.

    Return the rms error of the rate, rad/s, and the largest error of a turn, rad, without a model
    and with each, shape (1 + campaigns, 2).
    """
    gyro = rd2100()
    tables = (simulate_rate_table(gyro, full_range_rates(rates),
                                  np.linspace(MIN_TEMPERATURE, MAX_TEMPERATURE, temperatures),
                                  generator) for rates, temperatures in CAMPAIGNS)
    models = [GyroModel(), *(fit_model(table, [POLYNOMIAL]) for table in tables)]
    speeds = np.arange(5.0, FULL_SCALE + 1.0, 5.0) * DEGREE
    rates, temperatures = rate_temperature_grid(
        np.concatenate([-speeds[::-1], speeds]),
        np.arange(MIN_TEMPERATURE, MAX_TEMPERATURE + 1.0, 2.0))
    errors, durations = simulate_turn_errors(gyro, models, rates, temperatures, generator)
    return np.column_stack([np.sqrt(np.mean((errors / durations) ** 2, axis=1)),
                            np.abs(errors).max(axis=1)])


def simulate_turn_errors(gyro: GyroModel, models: Sequence[GyroModel], rates: Array,
                         temperatures: Array,
                         generator: np.random.Generator) -> tuple[Array, Array]:
    """Return errors of full turns after rests, rad, (models, n), and their durations, s, (n,)."""
    turning = np.round(2.0 * math.pi / np.abs(rates) * OUTPUT_RATE).astype(int)
    # of rest and turn in turn
    lengths = np.column_stack([np.full(len(rates), SAMPLES_PER_SET), turning]).ravel()
    rate = np.repeat(np.column_stack([np.zeros(len(rates)), rates]).ravel(), lengths)
    temperature = np.repeat(np.repeat(temperatures, 2), lengths)
    output = gyro.output(rate, temperature) + simulate_noise(
        gyro.noise, len(rate), 1.0 / OUTPUT_RATE, generator)
    begins = np.cumsum(lengths) - lengths
    means = np.array([np.add.reduceat(model.rate(output, temperature) - rate, begins) / lengths
                      for model in models])
    return (means[:, 1::2] - means[:, 0::2]) * turning / OUTPUT_RATE, turning / OUTPUT_RATE


# Table I and the synthetic gyro

def _compare_own_figures() -> list[Comparison]:
    sets = (len(np.arange(-FULL_SCALE, FULL_SCALE + 1.0, 10.0))
            * len(np.arange(MIN_TEMPERATURE, MAX_TEMPERATURE + 1.0, 2.0)))
    return [
        from_own_figures('drift of 0.002 deg/s in an hour', 'deg/h', 3600.0 * BIAS_STABILITY,
                         '7.2', 'section 1'),
        from_own_figures('drift of 0.002 deg/s in 10 min', 'deg', 600.0 * BIAS_STABILITY, '1.2',
                         'section 1'),
        from_own_figures('angle random walk of 5 (deg/h)/sqrt(Hz)', 'deg/sqrt(h)',
                         ANGLE_RANDOM_WALK / 60.0, '0.08', 'table I'),
        from_own_figures('data sets, every 10 deg/s and 2 K', '1', float(sets), '121',
                         'section 3.3', '+-100 deg/s are 21 rates, not 11'),
    ]


def _compare_instrument() -> list[Comparison]:
    rates, gyro = full_range_rates(201), rd2100()
    line = gyro.output(rates, MIN_TEMPERATURE)
    left = line - np.polyval(np.polyfit(rates, line, 1), rates)
    slopes = [np.polyfit(rates, gyro.output(rates, temperature), 1)
              for temperature in (MIN_TEMPERATURE, MAX_TEMPERATURE)]
    (cold_slope, cold_bias), (warm_slope, warm_bias) = slopes
    return [
        Comparison('synthetic: error at 100 deg/s, 25 degC', 'deg/s',
                   abs(line[-1] - rates[-1]) / DEGREE),
        Comparison('synthetic: nonlinearity, rms', '%',
                   100.0 * float(np.sqrt(np.mean(left ** 2))) / rates[-1], '< 0.5', 'table I'),
        Comparison('synthetic: scale from 25 to 45 degC', '%', 100.0 * (warm_slope - cold_slope),
                   '< 2', 'table I'),
        Comparison('synthetic: bias from 25 to 45 degC', 'deg/s', (warm_bias - cold_bias) / DEGREE,
                   '< 0.2', 'table I'),
    ]


def _compare_results(found: Array) -> list[Comparison]:
    means = found.mean(axis=0)
    uncertainties = 3.0 * found.std(axis=0, ddof=1) / math.sqrt(len(found))
    percent = 100.0 / (2.0 * math.pi)
    rows = [Comparison('rms error of the rate, static bias only', 'deg/s', means[0, 0] / DEGREE,
                       uncertainty=uncertainties[0, 0] / DEGREE),
            Comparison('largest error of a full turn, static bias only', '%',
                       percent * means[0, 1], uncertainty=percent * uncertainties[0, 1])]
    for number, (rates, temperatures) in enumerate(CAMPAIGNS, 1):
        ratio = found[:, 0, 0] / found[:, number, 0]
        name = f'n = {rates * temperatures}'
        rows += [
            Comparison(f'rms error of the rate, {name}', 'deg/s', means[number, 0] / DEGREE,
                       uncertainty=uncertainties[number, 0] / DEGREE),
            Comparison(f'error of the rate, before over after, {name}', '1', float(ratio.mean()),
                       '~ 10', 'abstract', 3.0 * float(ratio.std(ddof=1)) / math.sqrt(len(found)),
                       'larger, as only Table I is simulated'),
            Comparison(f'largest error of a full turn, {name}', '%', percent * means[number, 1],
                       '< 2', 'section 5, fig. 9', percent * uncertainties[number, 1])]
    return rows


def _compare_drifts(generator: np.random.Generator, runs: int = 100) -> list[Comparison]:
    """Compare the headings after 10 min at constant temperature, by the time since the rest."""
    noise, minutes = rd2100().noise, (0, 60, 480)
    samples = round(60.0 * (minutes[-1] + 10) * OUTPUT_RATE)
    drifts = np.empty((runs, len(minutes)))
    for run in range(runs):
        rate = simulate_noise(noise, SAMPLES_PER_SET + samples, 1.0 / OUTPUT_RATE, generator)
        static, powered = rate[:SAMPLES_PER_SET].mean(), rate[SAMPLES_PER_SET:]
        for place, begin in enumerate(round(60.0 * each * OUTPUT_RATE) for each in minutes):
            mission = powered[begin:begin + round(600.0 * OUTPUT_RATE)]
            drifts[run, place] = (mission - static).sum() / OUTPUT_RATE / DEGREE
    sizes = np.sqrt(np.mean(drifts ** 2, axis=0))
    return [Comparison(f'heading after 10 min, rms, {when}', 'deg', size, published, place,
                       3.0 * size / math.sqrt(2.0 * runs), why)
            for size, (when, published, place, why) in zip(sizes.tolist(), (
                ('rest before it', '< 1', 'section 2', 'flicker of 0.002 deg/s drifts by more'),
                ('rest 1 h before it', '', '', ''),
                ('rest 8 h before it', '', '', '')))]


# misprints, and properties of the method

def columns_of_equation_10(rate_order: int, temperature_order: int, stride: int) -> int:
    """Return the number of different columns that the index ``i + (j - 1) stride`` gives."""
    return len({i + (j - 1) * stride
                for i in range(1, rate_order + 2) for j in range(1, temperature_order + 2)})


def _index() -> Contradiction:
    p, q = RATE_ORDER, TEMPERATURE_ORDER
    numbers = {'printed': columns_of_equation_10(p, q, p),
               'right': columns_of_equation_10(p, q, p + 1),
               'cubic': columns_of_equation_10(p, p, p),
               'cubic_right': columns_of_equation_10(p, p, p + 1)}
    return Contradiction(numbers,
                         'Eq. 10: the index i + (j-1)p is the same for several pairs of i and j. '
                         'With p = 3 and q = 2 it gives {printed:d} different columns of '
                         '{right:d}, with p = q = 3 {cubic:d} of {cubic_right:d}; the index i + '
                         '(j-1)(p+1) gives all columns.')


def regressor_error(deviation: float, averaged: int, generator: np.random.Generator,
                    samples: int = 20_000) -> float:
    """
    Return the error of eq. 3 at 100 deg/s if it is fitted over noisy outputs, rad/s.

    The deviation is that of a sample, rad/s; `averaged` samples are a data set, `samples` are
    taken at each rate.
    """
    rates = np.repeat(full_range_rates(21), samples // averaged)
    clean = rd2100().output(rates, MIN_TEMPERATURE)
    noisy = clean + generator.standard_normal(len(rates)) * deviation / math.sqrt(averaged)
    wrong, right = (np.polynomial.Polynomial.fit(output, noisy - rates, RATE_ORDER)
                    for output in (noisy, clean))
    return float(wrong(clean[-1]) - right(clean[-1]))


def _regressor(generator: np.random.Generator) -> Contradiction:
    white = math.sqrt(rd2100().noise.rate_variance(1.0 / OUTPUT_RATE))
    numbers = {'white': white / DEGREE, 'vibration': VIBRATION_RATE}
    for name, deviation in (('white', white), ('vibration', VIBRATION_RATE * DEGREE)):
        for kind, averaged in (('single', 1), ('mean', SAMPLES_PER_SET)):
            numbers[f'{name}_{kind}'] = regressor_error(deviation, averaged, generator) / DEGREE
    return Contradiction(numbers,
                         'Eq. 9: the regressor is the output, which contains the same noise as '
                         'the error. With samples that scatter by {white:.4f} deg/s the error at '
                         '100 deg/s is wrong by {white_single:.0e} deg/s, with means of 100 by '
                         '{white_mean:.0e}; on a table that vibrates by {vibration:.0f} deg/s by '
                         '{vibration_single:.3f} and {vibration_mean:.4f} deg/s.')


def extrapolation_errors(sine_constant: float,
                         generator: np.random.Generator) -> tuple[float, float]:
    """Return the rms errors, rad/s, at 70 to 100 deg/s of polynomial and sine from up to 60."""
    gyro, temperatures = rd2100(sine_constant), np.linspace(MIN_TEMPERATURE, MAX_TEMPERATURE, 11)
    table = simulate_rate_table(gyro,
                                np.arange(-60.0, 61.0, 10.0) * DEGREE, temperatures, generator)
    beyond = np.arange(70.0, 101.0, 10.0) * DEGREE
    rate, temperature = rate_temperature_grid(np.concatenate([-beyond, beyond]), temperatures)
    output = gyro.output(rate, temperature)
    polynomial, sine = (
        float(np.sqrt(np.mean((fit_model(table, effects).rate(output, temperature) - rate) ** 2)))
        for effects in ([POLYNOMIAL], PHYSICAL_EFFECTS))
    return polynomial, sine


def _sine(generator: np.random.Generator, runs: int) -> Contradiction:
    found = [[extrapolation_errors(sagnac, generator)
              for sagnac in (SINE_CONSTANT, STRONG_SINE_CONSTANT)] for _ in range(runs)]
    (weak, weak_sine), (strong, strong_sine) = np.mean(found, axis=0) / DEGREE
    return Contradiction(
        {'k': SINE_CONSTANT, 'weak': weak, 'weak_sine': weak_sine,
         'strong_k': STRONG_SINE_CONSTANT, 'strong': strong, 'strong_sine': strong_sine},
        'Eq. 3: a cubic approximates a sine at low rates only. Calibrated up to 60 deg/s, the '
        'polynomial (3, 2) errs between 70 and 100 deg/s by {weak:.4f} deg/s, five effects with a '
        'sine by {weak_sine:.4f} (k = {k:.2f} s); with k = {strong_k:.2f} s by {strong:.3f} and '
        '{strong_sine:.4f}.')


def _full_turn() -> Contradiction:
    error, rate = 0.1, 36.0
    duration = 360.0 / rate
    return Contradiction({'error': error, 'rate': rate, 'right': error * duration,
                          'printed': error * OUTPUT_RATE * duration},
                         'Eq. 14: error times output rate times time does not have the unit of '
                         'an angle. {error:.1f} deg/s in a turn at {rate:.0f} deg/s give '
                         '{right:.0f} deg, and {printed:.0f} deg by the printed formula; the '
                         'samples must be divided by the output rate.')
