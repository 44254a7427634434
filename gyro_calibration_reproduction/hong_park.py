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
Hong and Park (2008), heading of indoor mobile robots by a MEMS gyro.

Source: "Minimal-drift heading measurement using a MEMS gyro for indoor mobile robots", Sensors 8.
Published numbers are in their units; numbers here are computed in SI and converted.
"""

from __future__ import annotations

import math

from gyro_calibration.allan.noise_fit import fit_noise
from gyro_calibration.calibration.likelihood import fit_likelihood
from gyro_calibration.calibration.self_calibration import fit_heading, fit_rate, to_model_record
from gyro_calibration.heading.integration import integrate, Threshold, ThresholdFilter
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, Motion, motion_from_rates, ROBOT_MOTION)
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
from gyro_calibration_reproduction.finding import (
    Comparison, Contradiction, from_own_figures, Reproduction)
import numpy as np

TITLE = ('Hong and Park: Minimal-drift heading measurement using a MEMS gyro for indoor mobile '
         'robots, Sensors 8, 2008')
#: Scale factor error, 1, and bias, rad/s, of the simulations of section 3.1.
TRUE_SCALE_ERROR, TRUE_BIAS = -0.1, 0.1
#: Sampling rates of reference and gyro in section 4.1, Hz.
REFERENCE_SAMPLE_RATE, GYRO_SAMPLE_RATE = 20.0, 100.0
#: Sections 3.2 and 4.2: deg/s, deg/s as printed (deg/min is taken, see `_bias_unit`), s.
THRESHOLD, PRINTED_BIAS, DRIVE_DURATION = 0.3, 0.75, 160.0
#: Section 2.2: of ten gyros, 1.
MEAN_SCALE_ERROR = 0.0253
#: Table 1: mean and standard deviation of the heading error, deg.
TABLE_1 = {'pure integration': (1.6675, 1.5075), 'self-calibration': (1.1511, 1.1675),
           'threshold filter': (0.7768, 1.2653), 'both': (0.5985, 1.2998)}
PURE_ROW, CALIBRATED_ROW, FILTERED_ROW, PROPOSED_ROW = TABLE_1.values()
ASSUMED = (
    'The motions of figures 6 and 7 are not published; a rest of 2 s and one turn with ramps of '
    '0.25 s is taken, its speed and length being those that give the two errors.',
    'The drive of figure 10 is not published; the built-in motions `calibration` (20 s) and '
    '`robot` (160 s, half of it standing) are taken. The percentages compare, the degrees do not.',
    'b is taken in deg/min, the noise as white noise and flicker.',
    'The text has no number of figures 4 and 5, the change of bias with temperature and of scale '
    'factor with age.',
)


def reproduce(generator: np.random.Generator, runs: int = 200) -> Reproduction:
    errors, deviations = np.stack(
        [drive_errors(generator) for _ in range(runs)], axis=1)
    efficiency = _efficiency(generator, runs)
    instrument = _compare_instrument(generator, max(2, runs // 20))
    return Reproduction(TITLE, ASSUMED, (
        *instrument, *_compare_self_calibration(), *_compare_own_figures(),
        *_compare_table_1(errors, deviations)),
        (_rectangle_rule(), _exchanged_columns(), efficiency, _bias_unit(),
         _noise_over_threshold(errors)))


# figures 2, 3 and 8

def measured_figures(generator: np.random.Generator) -> tuple[float, ...]:
    """
    Measure a simulated gyro with the figures of the paper.

    Return the angle random walk, deg/√h, and the bias instability, deg/h, by an hour at rest; the
    scale factor error, %, by 22 rates of 10 s each; and the peak-to-peak noise of 1 s, deg/s.
    """
    interval = 1.0 / GYRO_SAMPLE_RATE
    rest = simulate_noise(XV3500.noise, 3600 * round(GYRO_SAMPLE_RATE), interval, generator)
    figures = fit_noise(rest, interval).figures
    rates = np.linspace(-100.0, 100.0, 22) * DEGREE
    means = simulate_noise(XV3500.noise, 22 * 1000, interval, generator).reshape(22, 1000).mean(1)
    scale = float(np.polyfit(rates, (1.0 + MEAN_SCALE_ERROR) * rates + means, 1)[0]) - 1.0
    return (figures['N'].value / DEGREE * 60.0, figures['B'].value / DEGREE * 3600.0,
            100.0 * scale, float(np.ptp(rest[:round(GYRO_SAMPLE_RATE)])) / DEGREE)


def _compare_instrument(generator: np.random.Generator, runs: int) -> list[Comparison]:
    found = np.array([measured_figures(generator) for _ in range(runs)])
    rows = (('angle random walk by an Allan chart of an hour', 'deg/sqrt(h)', '2.5', 'fig. 2', ''),
            ('bias instability by an Allan chart of an hour', 'deg/h', '17.99', 'fig. 2', ''),
            ('scale factor error of 2.53 %, by 22 rates', '%', '2.53', 'fig. 3', ''),
            ('peak-to-peak noise', 'deg/s', '2', 'fig. 8', 'of 1 s, which is not stated'))
    return [Comparison(quantity, unit, float(values.mean()), published, place,
                       3.0 * _standard_error(values), note=note)
            for (quantity, unit, published, place, note), values in zip(rows, found.T)]


# figures 6 and 7

def one_turn(speed: float, duration: float) -> Motion:
    """Return a rest of 2 s and a turn, rad/s, with ramps of 0.25 s that begin `duration` apart."""
    return motion_from_rates(np.array([0.0, 2.0, 2.25, 2.0 + duration, 2.25 + duration]),
                             np.array([0.0, 0.0, speed, speed, 0.0]))


def noiseless_output(motion: Motion) -> tuple[Array, Array]:
    """Return time, s, and output, rad/s, of the gyro of section 3.1, without noise."""
    time = np.arange(round(motion.duration * REFERENCE_SAMPLE_RATE) + 1) / REFERENCE_SAMPLE_RATE
    return time, (1.0 + TRUE_SCALE_ERROR) * motion.rate_at(time) + TRUE_BIAS


def _percent_errors(scale_factor_error: float, bias: float) -> tuple[float, float]:
    """Return the errors of s and b, per cent of the true ones."""
    return 100.0 * (scale_factor_error / TRUE_SCALE_ERROR - 1.0), 100.0 * (bias / TRUE_BIAS - 1.0)


def errors_by_rectangles(motion: Motion, delay_samples: int = 0) -> tuple[float, float]:
    """Return the errors of s and b, %, by eq. 4 to 7; the gyro lags by `delay_samples`."""
    time, rate = noiseless_output(motion)
    fit = fit_heading(time[:len(time) - delay_samples], rate[delay_samples:], motion)
    return _percent_errors(fit.scale_factor_error, fit.bias)


def errors_by_trapezoids(motion: Motion) -> tuple[float, float]:
    """Return the errors of s and b, %, by eq. 5 to 7 with the trapezoid rule for eq. 4."""
    time, rate = noiseless_output(motion)
    scale, offset = solve_equation_7(integrate(time, rate), time, motion.heading_at(time))
    return _percent_errors(1.0 / scale - 1.0, -offset / scale)


def solve_equation_7(integral: Array, time: Array, heading: Array) -> Array:
    """Return [s̄, b̄] of eq. 7 by integrals of the output, rad, at times since the begin, s."""
    return np.linalg.lstsq(np.column_stack([integral, time]), heading, rcond=None)[0]


def published_motion() -> Motion:
    """
    Return the turn at which the rectangle rule has the errors of section 3.1.

    Its length makes that of s, its speed that of b. The corners are at samples, so that the
    trapezoid rule is exact.
    """
    durations = np.arange(60, 120) / REFERENCE_SAMPLE_RATE
    duration = min(durations,
                   key=lambda length: abs(errors_by_rectangles(one_turn(1.0, length))[0] + 4.8))
    return one_turn(20.26 / -errors_by_rectangles(one_turn(1.0, duration))[1], duration)


def _compare_self_calibration() -> list[Comparison]:
    motion = published_motion()
    time, rate = noiseless_output(motion)
    by_rate, likely = fit_rate(time, rate, motion), fit_likelihood(time, rate, motion)
    estimators = (
        ('heading reference, rectangle rule of eq. 4', errors_by_rectangles(motion),
         ('4.8', '20.26'), 'fig. 6', 'by a turn made to fit'),
        ('heading reference, trapezoid rule', errors_by_trapezoids(motion), ('', ''), '', ''),
        ('rate reference', _percent_errors(by_rate.scale_factor_error, by_rate.bias), ('0', '0'),
         'fig. 7', ''),
        ('likelihood', _percent_errors(likely.scale_factor_error, likely.bias), ('', ''), '', ''))
    rows = [Comparison(f'error of {name}, {estimator}', '%', abs(error), published, place,
                       note=note) for estimator, errors, texts, place, note in estimators
            for name, error, published in zip('sb', errors, texts)]
    return [Comparison('s_bar for s = -10 %', '1', 1.0 / (1.0 + TRUE_SCALE_ERROR), '1.111',
                       'section 3.1'),
            Comparison('b_bar for b = 0.1 rad/s', 'rad/s', -TRUE_BIAS / (1.0 + TRUE_SCALE_ERROR),
                       '-0.111', 'section 3.1'), *rows]


def equation_8(as_printed: bool) -> Array:
    """Return [s̄, b̄] by eq. 8, with its columns as they are printed or exchanged."""
    time, measured = noiseless_output(CALIBRATION_MOTION)
    true = CALIBRATION_MOTION.rate_at(time)
    matrix = np.array([[measured.sum(), measured @ measured], [len(measured), measured.sum()]])
    return np.linalg.solve(matrix if as_printed else matrix[:, ::-1],
                           np.array([true @ measured, true.sum()]))


def _rectangle_rule() -> Contradiction:
    motion = published_motion()
    (s, b), (late_s, late_b) = (errors_by_rectangles(motion),
                                errors_by_rectangles(motion, delay_samples=1))
    numbers = {'speed': float(motion.rate_at(np.array([4.0]))[0]), 'turn': motion.duration - 2.25,
               's': s, 'b': b, 'late_s': late_s, 'late_b': late_b,
               'trapezoid': max(map(abs, errors_by_trapezoids(motion)))}
    return Contradiction(numbers,
                         'Figures 6 and 7: data without noise gave errors of 4.8 and 20.26 % by '
                         'the heading and 0 % by the rate, which no consistent estimator can '
                         'give. The rectangle rule of eq. 4 explains it: on a turn at '
                         '{speed:.2f} rad/s for {turn:.2f} s at 20 Hz it errs by {s:.2f} % in s '
                         'and {b:.2f} % in b, with the gyro one sample later by {late_s:.2f} and '
                         '{late_b:.2f} %, and the trapezoid rule by {trapezoid:.2f} %.')


def _exchanged_columns() -> Contradiction:
    printed = equation_8(as_printed=True)
    exchanged = equation_8(as_printed=False)
    return Contradiction({'first': printed[0], 'second': printed[1], 'right_first': exchanged[0],
                          'right_second': exchanged[1]},
                         'Eq. 8: the columns of the matrix are exchanged. The printed form gives '
                         '[s_bar, b_bar] = [{first:.4f}, {second:.4f}], the corrected form '
                         '[{right_first:.4f}, {right_second:.4f}].')


# drift by the noise figures of the gyro

def drift_in_half_an_hour() -> tuple[float, float]:
    """Return the drift in 30 min by bias instability and by angle random walk, deg."""
    return XV3500.bias_instability * 0.5, XV3500.angle_random_walk * math.sqrt(0.5)


def _compare_own_figures() -> list[Comparison]:
    drift = drift_in_half_an_hour()
    return [
        from_own_figures('scale factor error of 2.53 %, after one revolution', 'deg',
                         360.0 * MEAN_SCALE_ERROR, '9.1', 'section 2.2'),
        from_own_figures('drift in 30 min, sum of both parts', 'deg', sum(drift), '11',
                         'section 1', note='deviations do not add so'),
        from_own_figures('drift in 30 min, root of the sum of squares', 'deg', math.hypot(*drift),
                         '11', 'section 1', 'called a standard deviation'),
        from_own_figures('off pure integration, self-calibration', '%',
                         _percent_reduction(CALIBRATED_ROW[0]), '41', 'section 4.2',
                         'so says table 1'),
        from_own_figures('off pure integration, threshold filter', '%',
                         _percent_reduction(FILTERED_ROW[0]), '53', 'section 4.2'),
        from_own_figures('off pure integration, both', '%', _percent_reduction(PROPOSED_ROW[0]),
                         '64', 'section 4.2'),
    ]


def _percent_reduction(mean: float) -> float:
    """Return the reduction of the error of pure integration, table 1, %."""
    return 100.0 - 100.0 * mean / PURE_ROW[0]


def _bias_unit() -> Contradiction:
    drift = PRINTED_BIAS * DRIVE_DURATION
    return Contradiction({'drift': drift, 'mean': drift / 2.0, 'published': PURE_ROW[0],
                          'fits': drift / 60.0},
                         'Section 4.2: b = 0.75 deg/s drifts by {drift:.0f} deg in 160 s, with a '
                         'mean of {mean:.0f} deg; table 1 has a mean error of {published:.2f} '
                         'deg without any compensation; 0.75 deg/min drifts by {fits:.0f} deg.')


# table 1

#: The filters of table 1: single samples as published, and the mean of 0.2 s.
FILTERS = {'single samples': Threshold(THRESHOLD * DEGREE, 0.0),
           'mean of 0.2 s': Threshold(THRESHOLD * DEGREE, 0.2)}
_FILTER_REASONS = ('below the noise of a sample', 'the exact times of rest give no more',
                   's and b act during turns')
_OTHER_REASON = 'their error held more than s, b and noise'
#: The methods of `drive_errors`: name, the row of table 1, its reduction of the error of pure
#: integration, %, and the reason of the difference here, where only s, b and noise are simulated.
METHODS = (
    ('pure integration', PURE_ROW, '', ''),
    ('self-calibration by eq. 7', CALIBRATED_ROW, '31', _OTHER_REASON),
    ('self-calibration by likelihood', CALIBRATED_ROW, '31', _OTHER_REASON),
    ('threshold filter, single samples', FILTERED_ROW, '53', _FILTER_REASONS[0]),
    ('threshold filter, mean of 0.2 s', FILTERED_ROW, '53', _FILTER_REASONS[1]),
    ('rest known exactly', FILTERED_ROW, '53', _FILTER_REASONS[2]),
    ('eq. 7 and filter, single samples', PROPOSED_ROW, '64', _OTHER_REASON),
    ('eq. 7 and filter, mean of 0.2 s', PROPOSED_ROW, '64', _OTHER_REASON),
    ('likelihood and filter, single samples', PROPOSED_ROW, '64', _OTHER_REASON),
    ('likelihood and filter, mean of 0.2 s', PROPOSED_ROW, '64', _OTHER_REASON),
)
# Both motions in sequence, joined at rest.
FULL_MOTION = Motion(
    np.append(CALIBRATION_MOTION.time, CALIBRATION_MOTION.duration + ROBOT_MOTION.time[1:]),
    np.append(CALIBRATION_MOTION.heading,
              CALIBRATION_MOTION.heading[-1] + ROBOT_MOTION.heading[1:]),
    np.append(CALIBRATION_MOTION.rate_at(CALIBRATION_MOTION.time),
              ROBOT_MOTION.rate_at(ROBOT_MOTION.time)[1:]))


def noisy_output(motion: Motion, noise: Noise,
                 generator: np.random.Generator) -> tuple[Array, Array]:
    """Return time, s, and output, rad/s, of the gyro of section 4."""
    time = np.arange(round(motion.duration * GYRO_SAMPLE_RATE) + 1) / GYRO_SAMPLE_RATE
    return time, XV3500.model.output(motion.rate_at(time), 25.0) + simulate_noise(
        noise, len(time), 1.0 / GYRO_SAMPLE_RATE, generator)


def drive_errors(generator: np.random.Generator) -> Array:
    """
    Return the absolute heading errors of a simulated drive, deg, by each of `METHODS`.

    They are means and standard deviations over the drive, shape (2, methods).
    """
    time, output = noisy_output(FULL_MOTION, XV3500.noise, generator)
    run = time <= CALIBRATION_MOTION.duration
    fits = (fit_heading(time[run], output[run], CALIBRATION_MOTION),
            fit_likelihood(time[run], output[run], CALIBRATION_MOTION, 0.1))
    rates = [output, *(to_model_record(fit, '', '', None).correct(output) for fit in fits)]
    filtered = [[ThresholdFilter(each).apply_to_all(time, rate) for each in FILTERS.values()]
                for rate in rates]
    known = np.where(FULL_MOTION.rate_at(time) == 0.0, 0.0, output)
    drive = time >= CALIBRATION_MOTION.duration
    true = ROBOT_MOTION.heading_at(time[drive] - CALIBRATION_MOTION.duration)
    errors = np.abs([integrate(time[drive], rate[drive]) - true
                     for rate in (*rates, *filtered[0], known, *filtered[1], *filtered[2])])
    return np.stack([errors.mean(axis=1), errors.std(axis=1)]) / DEGREE


def _compare_table_1(errors: Array, deviations: Array) -> list[Comparison]:
    rows, means = [], errors.mean(axis=0)
    for number, (name, (published, deviation), percent, why) in enumerate(METHODS):
        uncertainty = 3.0 * _standard_error(errors[:, number])
        rows.append(Comparison(f'mean error, {name}', 'deg', means[number], f'{published}',
                               'table 1', uncertainty, 'another drive'))
        rows.append(Comparison(f'standard deviation of it, {name}', 'deg',
                               float(deviations[:, number].mean()), f'{deviation}', 'table 1',
                               3.0 * _standard_error(deviations[:, number]), 'another drive'))
        if percent:
            ratio = means[number] / means[0]
            # of the ratio of two means
            uncertainty = 300.0 * _standard_error(
                errors[:, number] - ratio * errors[:, 0]) / means[0]
            rows.append(Comparison(f'off pure integration, {name}', '%', 100.0 - 100.0 * ratio,
                                   percent, 'table 1', uncertainty, why))
    return rows


def _standard_error(values: Array) -> float:
    return float(values.std(ddof=1)) / math.sqrt(len(values))


# the threshold filter

def _noise_over_threshold(errors: Array) -> Contradiction:
    reductions = dict(zip((method[0] for method in METHODS),
                          100.0 - 100.0 * errors.mean(axis=0) / errors[:, 0].mean()))
    sigma = math.sqrt(XV3500.noise.rate_variance(1.0 / GYRO_SAMPLE_RATE)) / DEGREE
    numbers = {'sigma': sigma, 'ratio': THRESHOLD / sigma,
               'passes': 100.0 * math.erfc(THRESHOLD / sigma / math.sqrt(2.0)),
               'single': reductions['threshold filter, single samples'],
               'mean': reductions['threshold filter, mean of 0.2 s'],
               'known': reductions['rest known exactly'],
               'both': reductions['likelihood and filter, mean of 0.2 s']}
    return Contradiction(numbers,
                         'Eq. 12: 2.5 deg/sqrt(h) is {sigma:.3f} deg/s in a white sample at 100 '
                         'Hz, so 0.3 deg/s is {ratio:.2f} sigma, and {passes:.0f} % of the '
                         'samples of a robot at rest pass. In simulation the filter alone '
                         'reduces the error by {single:.1f} %, not 53 %. On the mean of 0.2 s it '
                         'reduces it by {mean:.0f} %, the exact times of rest by {known:.0f} %, '
                         'and the filter with self-calibration by {both:.0f} %.')


# the scatter of the estimators over the bound

def _efficiency(generator: np.random.Generator, runs: int) -> Contradiction:
    """Return the scatter of eq. 7 and of the likelihood over the Cramér-Rao bound, white noise."""
    white, found = Noise(XV3500.noise.angle_random_walk), []
    for _ in range(runs):
        time, rate = noisy_output(CALIBRATION_MOTION, white, generator)
        scale, offset = solve_equation_7(integrate(time, rate), time,
                                         CALIBRATION_MOTION.heading_at(time))
        likely = fit_likelihood(time, rate, CALIBRATION_MOTION, 0.1)
        found.append((1.0 / scale, -offset / scale, 1.0 + likely.scale_factor_error, likely.bias))
    columns = np.column_stack([CALIBRATION_MOTION.rate_at(time), np.ones(len(time))])
    bound = np.sqrt(np.diag(np.linalg.inv(columns.T @ columns))
                    * white.rate_variance(1.0 / GYRO_SAMPLE_RATE))
    ratios = np.std(found, axis=0, ddof=1).reshape(2, 2) / bound
    return Contradiction(
        {'s': ratios[0, 0], 'b': ratios[0, 1], 'likely_s': ratios[1, 0], 'likely_b': ratios[1, 1]},
        'Eq. 7: least squares on headings treats a random walk as independent errors. Its '
        'standard deviations are {s:.2f} (s) and {b:.2f} (b) times the Cramer-Rao bound, those of '
        'the likelihood {likely_s:.2f} and {likely_b:.2f}.')
