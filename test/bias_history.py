# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Gyros of known truth over days: what their rests show, and errors of a bias table of them."""

from dataclasses import dataclass, replace
import math

from gyro_calibration.heading.bias_table import BiasTable, Prior
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np

#: Time between two rests, s.
STEP = 60.0
#: A cheap gyro (Hong and Park's XV3500, with a random walk besides).
NOISE = Noise(2.5 * DEGREE / 60.0, 18.0 * DEGREE / 3600.0, 1e-7)
#: Variance of a mean over 10 s by white noise, (rad/s)².
WHITE = NOISE.angle_random_walk ** 2 / 10.0
MODEL = GyroModel(noise=NOISE)
#: Standard deviation of the bias of a calibration, rad/s.
OWN = 0.011 * DEGREE
CALIBRATION = SelfCalibration(0.01, 1.0 * DEGREE, ((1e-6, 1e-8), (1e-8, OWN ** 2)),
                              '2026-01-01T00:00:00+00:00', 20.0, 'likelihood')


@dataclass(frozen=True)
class History:
    """Runs of a gyro; all arrays have shape (runs, rests)."""

    time: np.ndarray  # s
    temperature: np.ndarray  # degC
    bias: np.ndarray  # true, rad/s
    curve: object  # what of it the temperature makes, rad/s; a function of the temperature
    estimate: np.ndarray  # what a rest showed, rad/s
    outlier: np.ndarray  # whether that was off


def linear(generator):
    """Return a bias over temperature with one coefficient, drawn as the prior has it."""
    slope = generator.normal(0.0, Prior().coefficient)
    return lambda temperature: slope * (temperature - 25.0)


def cubic(generator):
    """Return a bias over temperature whose slope is a parabola of the size of the prior."""
    first, second, third = generator.normal(0.0, Prior().coefficient / np.sqrt(3.0)
                                            * np.array([1.0, np.sqrt(3.0), np.sqrt(5.0)]))

    def curve(temperature):
        x = (temperature - 25.0) / 25.0
        return 25.0 * (first * x + second * x ** 2 / 2.0 + third * x ** 3 / 3.0)

    return curve


def simulate(generator, curve, runs=6, rests=30, turn_on=None, outliers=0.02, jump=0.0,
             noise=NOISE, prior=None):
    """
    Return runs of a gyro on as many days.

    Each begins between 10 and 25 degC and warms up by 3 to 20 K. Flicker, random walk and ageing
    go on between the runs; the bias turns on anew each day. An outlier is off by 0.1 to 1 deg/s.
    A jump comes early in the middle run, and stays.

    """
    prior = prior or Prior()
    turn_on = prior.turn_on if turn_on is None else turn_on
    day = 86400.0
    time = day * np.arange(runs)[:, None] + STEP * np.arange(rests) + 36000.0
    begin, rise = generator.uniform(10.0, 25.0, (runs, 1)), generator.uniform(3.0, 20.0, (runs, 1))
    temperature = begin + rise * (
        1.0 - np.exp(-STEP * np.arange(rests) / generator.uniform(300.0, 1200.0, (runs, 1))))
    drift = simulate_noise(Noise(0.0, noise.bias_instability, noise.rate_random_walk),
                           int(runs * day / 10.0), 10.0, generator)
    ageing = np.cumsum(generator.normal(0.0, prior.ageing * np.sqrt(1.0 / 365.25), runs))[:, None]
    steps = jump * (np.arange(runs * rests).reshape(runs, rests) >= runs // 2 * rests + rests // 6)
    bias = (curve(temperature) + generator.normal(0.0, turn_on, (runs, 1))
            + drift[(time / 10.0).astype(int) % len(drift)] + ageing + steps
            + generator.normal(0.0, 1.0 * DEGREE))
    outlier = generator.random((runs, rests)) < outliers
    off = (generator.choice([-1.0, 1.0], (runs, rests))
           * generator.uniform(0.1, 1.0, (runs, rests)) * DEGREE)
    estimate = (
        bias + generator.normal(0.0, np.sqrt(noise.angle_random_walk ** 2 / 10.0), (runs, rests))
        + outlier * off)
    return History(time, temperature, bias, curve, estimate, outlier)


def learn(table, history, run, rests=slice(None)):
    """Give a table what the rests of a run showed, and return what it said."""
    rows = zip(history.temperature[run, rests], history.estimate[run, rests],
               history.time[run, rests])
    return [table.add(temperature, bias, WHITE, time) for temperature, bias, time in rows]


def learned(history, runs):
    """Return a table after some runs, in the next."""
    table = BiasTable(MODEL)
    for run in range(runs):
        table.begin_run()
        learn(table, history, run)
    table.begin_run()
    return table


def answers(generator, curve, runs=5, rests=12, **given):
    """
    Ask a table at the begin of each run, and in its middle up to 8 K from the temperature there.

    Returns
    -------
    shape (runs, 10): error and standard deviation of the bias at the begin, of the bias in the
    middle, of the difference; the true difference, rad/s; then the number of outliers, of those
    held back, and of good estimates held back

    """
    history, table, rows = simulate(generator, curve, runs, rests, **given), BiasTable(MODEL), []
    for run in range(runs):
        table.begin_run()
        at_begin = _predicted(table, history, run, 0, 0.0)
        said = learn(table, history, run, slice(0, rests // 2))
        rest, further = rests // 2, generator.uniform(-8.0, 8.0)
        temperature, time = history.temperature[run, rest], history.time[run, rest]
        change = history.curve(temperature + further) - history.curve(temperature)
        difference, variance = table.bias_difference(temperature, temperature + further, time)
        middle = (*_predicted(table, history, run, rest, further), difference - change,
                  math.sqrt(variance), change)
        said = np.array(
            [bool(text) for text in said + learn(table, history, run, slice(rests // 2, None))])
        outlier = history.outlier[run]
        rows.append([*at_begin, *middle, outlier.sum(), said[outlier].sum(), said[~outlier].sum()])
    return np.array(rows)


def _predicted(table, history, run, rest, further):
    """Return what a prediction is off, rad/s, and its standard deviation."""
    temperature, time = history.temperature[run, rest], history.time[run, rest]
    bias, variance = table.predict(temperature + further, time)
    return (bias - history.bias[run, rest] - history.curve(temperature + further)
            + history.curve(temperature), math.sqrt(variance))


def carried_answers(generator, curve, runs=4, rests=12, **given):
    """
    Calibrate in the first run, and use that at the begin of a later one.

    Returns
    -------
    error and standard deviation of the bias, rad/s: without a table, and with one of the runs
    between, shape (2, 2)

    """
    history = simulate(generator, curve, runs, rests, **given)
    run, made = int(generator.integers(1, runs)), int(generator.integers(0, rests))
    calibration = replace(CALIBRATION, bias=history.bias[0, made] + generator.normal(0.0, OWN),
                          temperature=history.temperature[0, made])
    time, rows = history.time[run, 0], []
    for table in (BiasTable(MODEL), learned(history, run)):
        now, _ = table.propagate_calibration(calibration, time - history.time[0, made], time,
                                             history.temperature[run, 0])
        rows.append((now.bias - history.bias[run, 0], now.standard_deviations[1]))
    return np.array(rows)


def coverage(errors, deviations):
    """Return how often errors lie inside their interval of 95 %."""
    return float(np.mean(np.abs(errors) < 1.96 * deviations))
