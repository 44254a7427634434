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
Bot Thoughts (blog): gyro calibration on a turntable and on a turntable with an encoder.

Counts, deg/s and per cent are as in the source; rates are computed in SI and converted.
"""

from __future__ import annotations

import math

from gyro_calibration.calibration.likelihood import fit_likelihood
from gyro_calibration.calibration.self_calibration import fit_rate
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import constant_rate_motion, Motion, motion_from_headings
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration_reproduction.finding import (
    Comparison, Contradiction, from_own_figures, Reproduction)
from gyro_calibration_reproduction.hong_park import solve_equation_7
import numpy as np
from scipy.stats import linregress
from scipy.stats import t as student

TITLE = 'Bot Thoughts: gyro calibration of an L3G4200D (blog)'
#: Turns a minute of a record player, and the nominal and the measured frequency of the strobe, Hz.
TURNS_PER_MINUTE, STROBE_FREQUENCY, MEASURED_STROBE_FREQUENCY = (
    (0.0, 100.0 / 3.0, 45.0), 60.0, 59.8)
#: Means at these speeds, counts.
MEAN_COUNTS = (2.5654, -2854.5, -3857.9)
#: From the three speeds: counts a deg/s, and deg/s; the first by the solver on the encoder's rate.
SCALE_FACTOR, NULL_RATE, SOLVED_SCALE = -14.309, -0.1793, -14.49787
#: deg/s/K of the data sheet.
BIAS_TEMPERATURE = 0.04
#: deg/s a count at full scale 2000 deg/s, data sheet of the L3G4200D.
SENSITIVITY = 0.07
ENCODER_STEP, SAMPLE_RATE = 2.0 * DEGREE, 50.0
#: Of the data sheet: 0.03 deg/s/sqrt(Hz), a one-sided density, which is sqrt(2) N.
NOISE = Noise(0.03 * DEGREE / math.sqrt(2.0))
#: Turns by hand at varying rates.
HAND_MOTION = constant_rate_motion(
    [(5, 0), (8, 60), (8, -120), (8, 200), (5, 0), (8, -200), (8, 120), (8, -60), (5, 0)], 1.0)
ASSUMED = ('The log of the encoder turntable is not published; 63 s of turning by hand up to 200 '
           'deg/s are simulated, with the noise of the L3G4200D (0.03 deg/s/sqrt(Hz)), an encoder '
           'of 2 deg that begins anywhere in a step, 50 Hz, and a known scale.',)


def reproduce(generator: np.random.Generator, runs: int = 200) -> Reproduction:
    found = np.array([encoder_errors(generator) for _ in range(runs)])
    return Reproduction(TITLE, ASSUMED, (*_compare_three_speeds(), *_compare_solver(found)),
                        (_slope_contradiction(), _strobe_contradiction(),
                         _method_contradiction(found)))


# three speeds of a record player

def segment_slopes() -> tuple[float, float]:
    """Return the slopes from 0 to 200 and from 200 to 270 deg/s, counts a deg/s."""
    rates = np.array(TURNS_PER_MINUTE) * 6.0
    first, second = np.diff(MEAN_COUNTS) / np.diff(rates)
    return float(first), float(second)


def fit_line() -> tuple[float, float, float, float]:
    """Return slope, its 95 % interval either way, count at rest, and error of the middle point."""
    rates, means = np.array(TURNS_PER_MINUTE) * 6.0, np.array(MEAN_COUNTS)
    fit = linregress(rates, means)
    interval = float(student.ppf(0.975, len(rates) - 2) * fit.stderr)
    return (float(fit.slope), interval, float(fit.intercept),
            float(means[1] - fit.intercept - fit.slope * rates[1]))


def _compare_three_speeds() -> list[Comparison]:
    (first, second), (slope, interval, rest, _) = segment_slopes(), fit_line()
    return [
        from_own_figures('slope from 0 to 200 deg/s', 'counts/(deg/s)', first, '-14.285',
                         'part 1'),
        from_own_figures('slope from 200 to 270 deg/s', 'counts/(deg/s)', second, '-14.334',
                         'part 1'),
        from_own_figures('SF, mean of the slopes', 'counts/(deg/s)', (first + second) / 2.0,
                         '-14.309', 'part 1', 'cut off, not rounded'),
        from_own_figures('N', 'deg/s', MEAN_COUNTS[0] / SCALE_FACTOR, '-0.1793', 'part 1'),
        from_own_figures('strobe at 59.8 Hz', '%', 100.0 *
                         (1.0 - MEASURED_STROBE_FREQUENCY / STROBE_FREQUENCY), '0.33', 'part 1'),
        from_own_figures('solver and turntable differ by', '%', 100.0 *
                         (1.0 - SCALE_FACTOR / SOLVED_SCALE), '1.30', 'part 2',
                         note="of the solver's scale"),
        Comparison('SF, line through three points', 'counts/(deg/s)', slope,
                   note=f'95 %: +- {interval:.2f}, one degree of freedom'),
        Comparison('N, line through three points', 'deg/s', rest / slope),
        Comparison('SF of the data sheet, 70 mdeg/s a count', 'counts/(deg/s)',
                   -1.0 / SENSITIVITY),
    ]


def _slope_contradiction() -> Contradiction:
    (first, second), (slope, interval, _, off) = segment_slopes(), fit_line()
    rates = np.array(TURNS_PER_MINUTE) * 6.0
    null = MEAN_COUNTS[1] - second * rates[1] - MEAN_COUNTS[0]
    return Contradiction(
        {'first': first, 'second': second, 'percent': 100.0 * (second / first - 1.0),
         'off': abs(off / slope), 'null': abs(null / slope),
         'kelvin': abs(null / slope) / BIAS_TEMPERATURE,
         'speed': (rates[2] - rates[1]) * (1.0 - first / second), 'interval': interval},
        'Part 1: the slopes {first:.3f} and {second:.3f} differ by {percent:.2f} %. An error of '
        'the strobe changes both slopes equally. One of these explains the difference: a middle '
        'point {off:.2f} deg/s off a line, an error of {speed:.2f} deg/s at 45 turns a minute, or '
        'a null that drifted by {null:.2f} deg/s, as by {kelvin:.0f} K. Three points do not '
        'distinguish them, and determine the slope to +- {interval:.2f}.')


def _strobe_contradiction() -> Contradiction:
    off, (first, second) = (100.0 * (1.0 - MEASURED_STROBE_FREQUENCY / STROBE_FREQUENCY),
                            segment_slopes())
    corrected = SCALE_FACTOR * STROBE_FREQUENCY / MEASURED_STROBE_FREQUENCY
    numbers = {'off': off, 'slopes': 100.0 * (second / first - 1.0), 'corrected': corrected,
               'crystal': 100.0 * 80e-6, 'left': 100.0 * (1.0 - corrected / SOLVED_SCALE),
               'nominal': 100.0 * (-SENSITIVITY * first - 1.0)}
    return Contradiction(
        numbers, 'Part 1: a strobe at 59.8 Hz has an error of {off:.2f} %, as much as the slopes '
        'differ ({slopes:.2f} %); the tolerance of the crystal is {crystal:.3f} %. A scale '
        'error of the reference and one of the gyro are not distinguishable: if the strobe '
        'was slow, SF is {corrected:.3f}, and the solver differs by {left:.2f} %; the first '
        'slope alone agrees with the data sheet to {nominal:.3f} %.')


# an encoder of 2 deg

def encoder_log(generator: np.random.Generator) -> tuple[Array, Array, Motion]:
    """Return time, s, rates of a gyro with noise only, rad/s, and the motion by the encoder."""
    time = np.arange(round(HAND_MOTION.duration * SAMPLE_RATE) + 1) / SAMPLE_RATE
    rate = HAND_MOTION.rate_at(time) + simulate_noise(
        NOISE, len(time), 1.0 / SAMPLE_RATE, generator)
    steps = np.floor(HAND_MOTION.heading_at(time) / ENCODER_STEP + generator.uniform())
    return time, rate, motion_from_headings(time, steps * ENCODER_STEP)


def encoder_errors(generator: np.random.Generator) -> tuple[float, ...]:
    """
    Return the errors of one run of the encoder turntable.

    They are those of scale, 1, and offset, rad/s, by the method of the solver, which is least
    squares of the encoder's gradient on the gyro; the same by likelihood; of the scale of the
    reverse regression; the largest of the heading after the method of the solver, rad; scale and
    offset by least squares of headings.
    """
    time, rate, motion = encoder_log(generator)
    gradient, likely = fit_rate(time, rate, motion), fit_likelihood(time, rate, motion, 0.1)
    reverse = linregress(motion.rate_at(time), rate).slope - 1.0
    heading = integrate(time, rate - gradient.bias) / (1.0 + gradient.scale_factor_error)
    scale, offset = solve_equation_7(integrate(time, rate), time, motion.heading).tolist()
    return (gradient.scale_factor_error, gradient.bias, likely.scale_factor_error, likely.bias,
            float(reverse), float(np.abs(heading - motion.heading).max()), 1.0 / scale - 1.0,
            -offset / scale)


def _compare_solver(found: Array) -> list[Comparison]:
    means, deviations = found.mean(axis=0), found.std(axis=0, ddof=1)
    return [
        Comparison("scale by the solver's way on a gyro with this SF", 'counts/(deg/s)',
                   SCALE_FACTOR * (1.0 + means[0]), '-14.49787', 'part 2',
                   3.0 * abs(SCALE_FACTOR) * deviations[0],
                   'not by the method; a scale error of encoder, strobe or time'),
        Comparison("offset by the solver's way on a gyro with this N", 'deg/s',
                   NULL_RATE + means[1] / DEGREE, '-0.20168', 'part 2',
                   3.0 * deviations[1] / DEGREE, 'not by the method; possibly another null'),
        Comparison("error of scale, solver's way: mean", '%', 100.0 * means[0]),
        Comparison("error of scale, solver's way: standard deviation", '%', 100.0 * deviations[0]),
        Comparison('error of scale, headings: standard deviation', '%', 100.0 * deviations[6],
                   note='"heading rate ... a better fit" in part 2'),
        Comparison('error of scale, likelihood: mean', '%', 100.0 * means[2]),
        Comparison('error of scale, likelihood: standard deviation', '%', 100.0 * deviations[2]),
        Comparison("error of offset, solver's way: standard deviation", 'deg/s',
                   deviations[1] / DEGREE),
        Comparison('error of offset, headings: standard deviation', 'deg/s',
                   deviations[7] / DEGREE),
        Comparison('error of offset, likelihood: standard deviation', 'deg/s',
                   deviations[3] / DEGREE),
        Comparison("largest error of heading, solver's way", 'deg', means[5] / DEGREE, '< 3',
                   'part 2', 3.0 * deviations[5] / DEGREE),
    ]


def _method_contradiction(found: Array) -> Contradiction:
    means, deviations = 100.0 * found.mean(axis=0), 100.0 * found.std(axis=0, ddof=1)
    return Contradiction(
        {'solver': means[0], 'solver_scatter': deviations[0], 'likely': means[2],
         'likely_scatter': deviations[2], 'reverse': means[4],
         'turntable': 100.0 * (SOLVED_SCALE / SCALE_FACTOR - 1.0)},
        "Part 2: the two methods differ by {turntable:.2f} % of the turntable's SF. Fitting the "
        'gradient of a 2 deg encoder at 50 Hz errs by {solver:.4f} +- {solver_scatter:.4f} % '
        'only, the likelihood by {likely:.4f} +- {likely_scatter:.4f} %. In the reverse '
        'regression, of the gyro on the gradient, the steps of the encoder give an error of '
        '{reverse:.1f} %.')
