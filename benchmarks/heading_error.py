"""
The heading error of Hong and Park's robot in simulation, beside their table 1.

    python benchmarks/heading_error.py

A gyro like their XV3500 (angle random walk 2.5 deg/sqrt(h), bias instability 18 deg/h, scale factor error 3.73 %, bias 0.75 deg/min) at
100 Hz: 20 s of calibration, then 160 s of driving, half of them standing. Twenty runs, seeds 0 to 19. Prints a table in Markdown: the mean
over the runs of the mean absolute heading error while driving, its standard deviation over the runs, and what is off pure integration.

"""

from __future__ import annotations

import numpy as np

from gyro_calibration.compensation import compensate
from gyro_calibration.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.heading import Threshold, ThresholdFilter, integrate
from gyro_calibration.log import DEGREE, Log
from gyro_calibration.model import GyroModel, Term, with_self_calibration
from gyro_calibration.motion import CALIBRATION, ROBOT, Motion
from gyro_calibration.noise import Noise
from gyro_calibration.self_calibration import record, self_calibrate
from gyro_calibration.simulation import simulate

XV3500 = GyroModel((Term(SCALE_FACTOR_ERROR, (0.0373,)), Term(BIAS, (0.75 * DEGREE / 60,))),
                   noise=Noise(2.5 * DEGREE / 60, 18 * DEGREE / 3600))
FILTERS = {'mean of 0.2 s': Threshold(window=0.2), 'single samples, as published': Threshold(window=0.0)}
METHODS = ('pure integration', 'self-calibration', 'threshold filter', 'both')
#: Hong and Park, table 1: mean error and standard deviation, deg.
PUBLISHED = {'pure integration': (1.6675, 1.5075), 'self-calibration': (1.1511, 1.1675), 'threshold filter': (0.7768, 1.2653),
             'both': (0.5985, 1.2998)}

# The two motions after each other, joined where both stand.
BOTH = Motion(np.append(CALIBRATION.time, CALIBRATION.duration + ROBOT.time[1:]),
              np.append(CALIBRATION.heading, CALIBRATION.heading[-1] + ROBOT.heading[1:]),
              np.append(CALIBRATION.rate, ROBOT.rate[1:]))


def filtered(settings: Threshold, log: Log, rate: np.ndarray) -> np.ndarray:
    """Return the rates, rad/s, after the threshold filter, sample by sample as on the robot."""
    threshold = ThresholdFilter(settings)
    return np.array([threshold.filter(*sample) for sample in zip(log.time.tolist(), rate.tolist())])


def run(seed: int) -> np.ndarray:
    """Return the mean absolute heading errors of one run, deg, shape (filters, methods)."""
    log = simulate(XV3500, BOTH, 100.0, np.random.default_rng(seed))
    first, drive = log.time <= CALIBRATION.duration, log.time >= CALIBRATION.duration
    fit = self_calibrate(log.time[first], log.output[first], CALIBRATION, noise=XV3500.noise)
    nominal = GyroModel(noise=XV3500.noise)
    calibrated = with_self_calibration(nominal, record(fit, 'likelihood', '', None))
    pure, corrected = compensate(nominal, log.output).rate, compensate(calibrated, log.output).rate
    true = log.reference_heading[drive] - log.reference_heading[drive][0]

    def error(rate: np.ndarray) -> float:
        return float(np.abs(integrate(log.time[drive], rate[drive]) - true).mean()) / DEGREE
    return np.array([[error(pure), error(corrected), error(filtered(settings, log, pure)), error(filtered(settings, log, corrected))]
                     for settings in FILTERS.values()])


def table(errors: np.ndarray) -> str:
    """Return errors of shape (runs, filters, methods) as a table."""
    lines = ['| | deg | standard deviation | off pure integration | Hong and Park, table 1 |', '|---|---|---|---|---|']
    means, deviations = errors.mean(axis=0), errors.std(axis=0, ddof=1)
    for method, name in enumerate(METHODS):
        mean, deviation = PUBLISHED[name]
        published = f'{mean:.4f} +- {deviation:.4f}, {100 - 100 * mean / PUBLISHED[METHODS[0]][0]:.0f} %'
        for index, kind in enumerate(FILTERS if method >= 2 else ['']):
            off = 100 - 100 * means[index, method] / means[index, 0]
            label = f'{name} ({kind})' if kind else name
            lines.append(f'| {label} | {means[index, method]:.3f} | {deviations[index, method]:.3f} | {off:.0f} % | {published} |')
    return '\n'.join(lines)


def errors(runs: int = 20) -> np.ndarray:
    """Return the heading errors, deg, shape (runs, filters, methods), of the seeds 0, 1, ..."""
    return np.array([run(seed) for seed in range(runs)])


if __name__ == '__main__':
    print(table(errors()))
