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
The heading on a robot, sample by sample: rests, temperature, earlier runs, and stamp jumps.

The gyro is simulated with the noise of the XV-3500 at 25 Hz.
"""

from dataclasses import replace
from datetime import datetime, timezone
import math

from gyro_calibration.heading.bias_table import BiasTable, Entry
from gyro_calibration.heading.heading_estimator import Assumptions, HeadingEstimator
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, CATALOGUE, rate_temperature_polynomial, SCALE_FACTOR_ERROR)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.noise import simulate_noise
from gyro_calibration.model.presets import XV3500
import numpy as np
import pytest

INTERVAL, NOW = 0.04, 1.7e9
NOISE = XV3500.noise
DATE = datetime.fromtimestamp(NOW, timezone.utc).isoformat()
CALIBRATED = SelfCalibration(0.0, 0.1 * DEGREE,
                             ((1e-8, 0.0), (0.0, (0.01 * DEGREE) ** 2)), DATE, 25.0)
MODEL = GyroModel(noise=NOISE, self_calibration=CALIBRATED)


def begun(model=MODEL, table=None, assumptions=None, now=NOW, temperature=25.0):
    """Return a heading that begins; with a temperature, if one is given."""
    live = HeadingEstimator(model, table or BiasTable(model), assumptions or Assumptions(),
                            TrackerSettings(), now)
    if temperature is not None:
        live.add_temperature(0.0, temperature)
    return live


class Gyro:

    def __init__(self, live, seed=0, bias=0.1 * DEGREE, coefficient=0.0, now=NOW):
        self.live, self.time, self.now, self.turned = live, 0.0, now, 0.0
        self._bias, self._coefficient = bias, coefficient
        self._generator = np.random.default_rng(seed)
        self.headings, self.messages, self._rate = [], [], 0.0

    def go(self, seconds, rate=0.0, temperature=25.0, wheels=None):
        """Turn at a rate, rad/s, for some time, at one temperature, a ramp of two, or None."""
        count = round(seconds / INTERVAL)
        noise = simulate_noise(NOISE, count, INTERVAL, self._generator)
        known = (np.full(count, np.nan) if temperature is None
                 else np.linspace(*np.broadcast_to(temperature, 2), count))
        for degc, wandering in zip(known, noise):
            self.time += INTERVAL
            if temperature is not None:
                self.live.add_temperature(self.time, degc)
            offset = self._bias + self._coefficient * (0.0 if temperature is None else degc - 25.0)
            now = self.now + self.time
            self.messages.append(
                self.live.add(self.time, rate + offset + wandering, now, wheels=wheels))
            self.headings.append(self.live.tracker.heading)
            if round(self.time / INTERVAL) % 25 == 0:
                self.live.update_table(now)
        self.turned += INTERVAL * (rate * (count - 1) + 0.5 * (rate + self._rate))
        self._rate = rate
        return self

    @property
    def error(self):
        return self.live.tracker.heading - self.turned

    @property
    def deviation(self):
        return math.sqrt(self.live.tracker.variance)


@pytest.mark.parametrize('sense', [1.0, -1.0])
def test_the_scale_factor_error_acts_on_the_turn_and_not_on_the_bias_that_rests_show(sense):
    """With one sense the bias turns as far as the robot, and back, in the output."""
    gyro = Gyro(begun(GyroModel(noise=NOISE)), bias=DEGREE).go(60.0, wheels=False)
    gyro.go(60.0, DEGREE * sense, wheels=True)
    assert gyro.deviation == pytest.approx(60.0 * DEGREE * 0.03, rel=0.35)


@pytest.mark.parametrize('effects, unknown', [
    ([], (True, True)), ([SCALE_FACTOR_ERROR], (False, True)), ([BIAS], (True, False)),
    ([SCALE_FACTOR_ERROR, BIAS_TEMPERATURE], (False, True)),
    ([BIAS, SCALE_FACTOR_ERROR], (False, False)),
    ([rate_temperature_polynomial(1, 1)], (False, False))],
    ids=lambda each: None if each and isinstance(each[0], bool) else ' '.join(
        effect.name for effect in each))
def test_what_a_model_was_not_fitted_to_is_not_known(effects, unknown):
    terms = tuple(Term(effect, tuple(0.0 if each.default is None else each.default
                                     for each in effect.parameters)) for effect in effects)
    count = sum(len(term.fitted_indices) for term in terms)
    live = begun(GyroModel(terms, 1e-12 * np.eye(count), noise=NOISE))
    live.add(0.0, 1.0, NOW)
    used = live.current_model.self_calibration
    assert live.bias_variance == pytest.approx(
        (0.5 * DEGREE) ** 2 if unknown[1] else 0.0, abs=1e-8)
    assert live.is_bias_assumed == unknown[1]
    assert (0.0 if used is None else used.covariance[0][0]) == (9e-4 if unknown[0] else 0.0)


@pytest.mark.parametrize('temperature', [25.0, None])
def test_a_robot_whose_clock_is_set_late_carries_its_calibration_as_if_it_had_been_right(
        temperature):
    later, deviations, headings = NOW + 300.0 * 86400.0, [], []
    for begin in (1000.0, later):
        live = begun(now=begin, temperature=temperature)
        for index in range(100):
            live.add(INTERVAL * index, 0.3, begin)
        live.shift_clock(later - begin)
        headings.append(live.tracker.heading)
        live.add(INTERVAL * 100, 0.3, later)
        deviations.append(live.tracker.bias[1])
        assert live.tracker.heading - headings[-1] == pytest.approx(INTERVAL * 0.3, rel=0.05)
    assert (deviations[0] == pytest.approx(deviations[1], rel=1e-3)
            and live.age(later) == pytest.approx(300.0 * 86400.0))


@pytest.mark.parametrize('ahead, known', [(-7200.0, True), (60.0, True), (3e7, False)])
def test_a_calibration_from_the_future_has_no_known_age_until_the_clock_is_set(ahead, known):
    date = datetime.fromtimestamp(NOW + ahead, timezone.utc).isoformat()
    live = begun(replace(MODEL, self_calibration=replace(CALIBRATED, time=date)))
    live.add(0.0, 0.1 * DEGREE, NOW)
    assert (live.age(NOW) == max(-ahead, 0.0)) == known == (
        'later than the clock' not in live.calibration_message)
    assert known or live.bias_variance > 100.0 * CALIBRATED.standard_deviations[1] ** 2
    live.shift_clock(ahead + 60.0)
    live.add(0.01, 0.1 * DEGREE, NOW + ahead + 60.0)
    assert 'later than the clock' not in live.calibration_message
    assert live.age(NOW + ahead + 60.0) == pytest.approx(60.0)


def test_the_variance_grows_with_the_distance_of_the_temperature_and_a_rest_takes_that_back():
    coefficient = 0.03 * DEGREE
    gyro = Gyro(begun(), coefficient=coefficient).go(30.0).go(20.0, 0.3, (25.0, 35.0))
    known = gyro.live.tracker.bias[1]
    assert 0.5 < known / (10.0 * coefficient) < 1.5
    gyro.go(30.0, temperature=35.0)
    assert gyro.live.tracker.bias[1] < 0.1 * known and abs(gyro.error) < 3.0 * gyro.deviation
    assert Gyro(begun(assumptions=Assumptions(bias_temperature_coefficient=0.0))).go(30.0).go(
        20.0, 0.3, (25.0, 35.0)).live.tracker.bias[1] < 0.1 * known


def test_a_model_over_temperature_leaves_no_more_than_it_explains():
    """Rests at one temperature, off by another power-on, are no slope for the next 10 K."""
    explained = GyroModel([Term(BIAS, (0.0,)), Term(SCALE_FACTOR_ERROR, (0.0,)),
                           Term(BIAS_TEMPERATURE, (25.0, 4e-4 * DEGREE))], noise=NOISE,
                          covariance=np.diag([(1e-4 * DEGREE) ** 2, 1e-8,
                                              (1e-5 * DEGREE) ** 2]))
    deviations = [Gyro(begun(model), coefficient=4e-4 * DEGREE, bias=0.0).go(
        30.0, temperature=25.0).go(20.0, 0.3, (25.0, 35.0)).live.tracker.bias[1]
        for model in (explained, MODEL)]
    assert deviations[0] < 0.02 * DEGREE < 0.15 * DEGREE < deviations[1]


def heated(live):
    """Return a gyro that rested from 25 to 45 degC and back."""
    gyro = Gyro(live, coefficient=0.03 * DEGREE).go(60.0)
    for degc in (25.0, 30.0, 35.0, 40.0, 45.0):
        gyro.go(20.0, 0.3, (degc, min(degc + 5.0, 45.0))).go(
            40.0, temperature=min(degc + 5.0, 45.0))
    return gyro


def test_what_one_run_learned_of_the_temperature_serves_the_next_without_compensating_twice():
    """The tracker begins anew where it is warm, and the heading does not jump."""
    table = BiasTable(MODEL)
    warm = heated(begun(table=table))
    assert len(table.entries) >= 4 and 3 <= warm.live.restart_count <= 8
    assert (np.abs(np.diff(warm.headings)).max() < 0.5 * INTERVAL
            and abs(warm.error) < 3.0 * warm.deviation)
    errors = {}
    for name, entries in (('learned', table.entries), ('new', [])):
        live = begun(MODEL, BiasTable(MODEL, entries=entries), now=NOW + 7200.0)
        gyro = Gyro(live, 1, coefficient=0.03 * DEGREE, now=NOW + 7200.0).go(30.0)
        before = gyro.error
        gyro.go(60.0, 0.3, (25.0, 44.0))
        errors[name] = abs(gyro.error - before), gyro.deviation
    assert (errors['new'][0] > 10.0 * DEGREE
            and errors['learned'][0] < 0.1 * errors['new'][0]), errors
    for error, deviation in errors.values():
        assert error < 3.0 * deviation


def test_a_gyro_that_was_without_power_may_have_another_bias():
    gyro = Gyro(begun()).go(40.0)
    gyro.live.use_calibration(MODEL, gyro.now + gyro.time)
    heading, variance = gyro.live.tracker.heading, gyro.live.covariance[-1, -1]
    gyro.live.begin_run(gyro.now + gyro.time)
    assert gyro.live.tracker.heading == heading and gyro.live.covariance[-1, -1] > 9.0 * variance
    gyro._bias += 0.1 * DEGREE
    gyro.go(40.0).go(10.0, 0.3)
    assert (len({each.run for each in gyro.live.table.entries}) == 2
            and abs(gyro.error) < 3.0 * gyro.deviation)


def test_a_calibrated_model_takes_the_bias_of_earlier_runs():
    model = GyroModel((Term(BIAS, (0.01,)),), np.array([[1e-8]]), noise=NOISE)
    table = BiasTable(model, entries=[Entry(25.0, 0.003, 1e-10, NOW - 100.0, 0)])
    live = begun(model, table)
    live.add(0.1, 0.0, NOW)
    assert (live.current_model.self_calibration.bias == pytest.approx(0.003, abs=1e-4)
            and live.model.self_calibration is None)


def test_a_temperature_that_comes_no_more_is_held_and_the_bias_becomes_less_known():
    model = GyroModel((Term(BIAS_TEMPERATURE, (25.0, 0.03 * DEGREE)),), np.array([[1e-14]]),
                      noise=NOISE, self_calibration=CALIBRATED)
    gyro = Gyro(begun(model), coefficient=0.03 * DEGREE).go(30.0, temperature=30.0)
    known, rate = gyro.live.tracker.bias[1], gyro.live.corrected_rate
    assert not gyro.live.is_temperature_lost
    gyro.go(1.0, 0.3, temperature=30.0)
    gyro._bias += 5.0 * 0.03 * DEGREE  # it stays as warm as it is, but nobody says so
    before = len(gyro.headings)
    gyro.go(60.0, 0.3, None)
    assert (gyro.live.is_temperature_lost and gyro.live.tracker.bias[1] > 2.0 * known
            and abs(rate) < 2.0 * DEGREE)
    assert np.abs(np.diff(gyro.headings[before:])).max() < 2.0 * 0.3 * INTERVAL
    assert abs(gyro.error) < 3.0 * gyro.deviation


@pytest.mark.parametrize('terms', [
    (), (Term(BIAS_TEMPERATURE, (25.0, 0.02 * DEGREE)),),
    (Term(BIAS_TEMPERATURE, (25.0, 0.02 * DEGREE)), Term(CATALOGUE['rate_ramp'], (1e-9,)))
], ids=['no effect', 'of temperature', 'of temperature and time'])
def test_a_calibration_while_no_temperature_comes_holds_when_one_comes_again(terms):
    model = GyroModel(terms, noise=NOISE)
    table = BiasTable(model, entries=[Entry(float(degc), 0.03 * DEGREE * (degc - 25), 1e-12,
                                            NOW - 1e5, 0) for degc in range(15, 45)])
    gyro = Gyro(begun(model, table), bias=0.0).go(20.0)
    gyro._bias = 0.3 * DEGREE  # it has become warmer by 10 K, but nobody says so
    gyro.go(20.0, temperature=None)
    assert gyro.live.is_temperature_lost
    calibration = SelfCalibration(0.0, 0.3 * DEGREE,
                                  ((1e-8, 0.0), (0.0, (0.002 * DEGREE) ** 2)), DATE)
    gyro.live.use_calibration(replace(model, self_calibration=calibration), gyro.now + gyro.time)
    before = gyro.go(4.0, 0.3, None).error
    assert not gyro.live.tracker.is_resting
    gyro.go(40.0, 0.3, 35.0)
    assert abs(gyro.error - before) < 2.0 * DEGREE


def test_a_rest_in_which_the_robot_turned_slowly_does_not_enter_the_table():
    table = BiasTable(MODEL)
    gyro = Gyro(begun(table=table)).go(40.0, wheels=False)
    entries = list(table.entries)
    gyro.go(25.0, 0.3 * DEGREE)
    gyro.go(10.0, 0.3)
    assert (len(entries) == 1
            and table.entries[0].bias == pytest.approx(0.1 * DEGREE, abs=0.03 * DEGREE))
    assert all(abs(each.bias - 0.1 * DEGREE) < 0.05 * DEGREE for each in table.entries)
