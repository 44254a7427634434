# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The planned motion: feasible, accepted, better than a plain one, and as good as predicted."""

from functools import cache
import json
import math

from gyro_calibration.calibration.motion_design import (
    CalibrationForecast, can_follow, find_best_motion, plain_motion, RobotLimits)
from gyro_calibration.calibration.self_calibration import (
    check_rest, find_rest_after, ReferenceErrors, self_calibrate)
from gyro_calibration.cli.plan import write_motion
from gyro_calibration.logs.log import DataRefused, DEGREE
from gyro_calibration.model import presets
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, motion_from_rates, read_motion, ROBOT_MOTION)
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
import pytest
import yaml

XV3500 = presets.XV3500.noise
WHITE = Noise(XV3500.angle_random_walk)
TIME = np.arange(2001) / 100.0
ABILITIES = {
    'a cable': RobotLimits(60 * DEGREE, 120 * DEGREE, lowest=-180 * DEGREE, highest=180 * DEGREE),
    'free': RobotLimits(60 * DEGREE, 120 * DEGREE),
    'a narrow place': RobotLimits(60 * DEGREE, 60 * DEGREE, lowest=-20 * DEGREE,
                                  highest=20 * DEGREE),
    'limited jerk': RobotLimits(60 * DEGREE, 120 * DEGREE, 600 * DEGREE, 5 * DEGREE, -90 * DEGREE,
                                90 * DEGREE),
    'one way only': RobotLimits(100 * DEGREE, 200 * DEGREE, lowest=-90 * DEGREE, highest=0.0),
    'long rests': RobotLimits(30 * DEGREE, 30 * DEGREE, lowest=-50 * DEGREE, highest=100 * DEGREE,
                              rest=4.0),
}


@cache
def planned(name):
    return find_best_motion(ABILITIES[name],
                            CalibrationForecast(XV3500, 20.0, ROBOT_MOTION, 160.0), 20.0,
                            np.random.default_rng(0), 30)


@pytest.mark.parametrize('name', ABILITIES)
def test_a_planned_motion_can_be_driven_tells_the_scale_better_and_calibrates(name, tmp_path):
    motion, ability = planned(name)[0], ABILITIES[name]
    simple = plain_motion(ability, 20.0)
    for each in (motion, simple):
        assert (can_follow(ability, each) and each.duration == pytest.approx(20.0, abs=1e-9)
                and abs(each.heading[-1]) < 1e-12)
    for begin in (0.0, 20.0 - ability.rest):
        assert not motion.rate_at(np.linspace(begin + 1e-6, begin + ability.rest - 1e-6, 50)).any()
    steady = np.abs(motion.rate[:-1][np.diff(motion.rate) == 0.0])
    assert (steady[steady > 0.0] >= ability.slowest * (1.0 - 1e-9)).all()
    # the rate is linear between points, so that accelerations are known at their middles
    step = np.diff(motion.time)
    jerk = np.diff(np.diff(motion.rate) / step) / (0.5 * (step[1:] + step[:-1]))
    assert np.abs(jerk).max() <= 1.01 * ability.jerk
    forecast = CalibrationForecast(XV3500, 20.0, ROBOT_MOTION, 160.0)
    assert planned(name)[1].scale_deviation < 0.75 * forecast.predict(simple).scale_deviation
    write_motion(tmp_path / 'profile.csv', motion)
    noise = simulate_noise(XV3500, len(TIME), 0.01, np.random.default_rng(0))
    fit = self_calibrate(TIME, 1.03 * motion.rate_at(TIME) + 0.001 + noise,
                         read_motion(tmp_path / 'profile.csv'), noise=XV3500)
    assert abs(fit.scale_factor_error - 0.03) < 4.0 * math.sqrt(fit.covariance[0, 0])


@pytest.mark.parametrize('size', [1.0, 0.03])
def test_a_calibration_states_what_the_plan_promised(size):
    noise, deviations = Noise(size * WHITE.angle_random_walk), []
    time = np.arange(2450) / 100.0
    for seed in range(12):
        rate = np.where(time <= 20.0, CALIBRATION_MOTION.rate_at(time), 0.0) + simulate_noise(
            noise, len(time), 0.01, np.random.default_rng([3, seed]))
        fit = self_calibrate(time[time < 21.0], rate[time < 21.0], CALIBRATION_MOTION, noise=noise,
                             reference=ReferenceErrors())
        rest = find_rest_after(time, rate, fit, CALIBRATION_MOTION)
        deviations.append(
            np.sqrt(np.diag(check_rest(time[rest], rate[rest], fit, noise).fit.covariance)))
    promised = CalibrationForecast(noise, 20.0, ROBOT_MOTION, 160.0).predict(CALIBRATION_MOTION)
    ratio = np.median(deviations, axis=0) / (promised.scale_deviation, promised.bias_deviation)
    assert (np.abs(np.log(ratio)) < math.log(1.1)).all(), ratio


IMPOSSIBLE = {
    'no time': (RobotLimits(1.0, 2.0, rest=10.0), 20.0, '20 s are too short for rests of 10 s'),
    'no time at the slowest rate': (RobotLimits(1.0, 0.5, slowest=0.5,
                                                rest=1.0), 5.0, 'too short'),
    'no angle': (RobotLimits(1.0, 2.0, lowest=0.0,
                             highest=0.0), 20.0, 'the headings allow a turn of 0 deg'),
    'no angle at the slowest rate': (RobotLimits(
        1.0, 1.0, slowest=0.9, lowest=-0.5, highest=0.5), 20.0, 'angle or more acceleration'),
    'nothing worth it': (RobotLimits(0.01, 0.02), 20.0, 'determines the scale factor to'),
    'next to no time': (RobotLimits(1.0, 2.0, 0.5, rest=1.0), 2.02, ''),
}


@pytest.mark.parametrize('ability, seconds, reason', IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_the_impossible_is_refused_in_a_sentence(ability, seconds, reason):
    with pytest.raises(DataRefused) as refused:
        find_best_motion(ability, CalibrationForecast(XV3500, seconds, ROBOT_MOTION, 160.0),
                         seconds, np.random.default_rng(0), 5)
    assert reason in str(refused.value) and '\n' not in str(refused.value)


@pytest.fixture
def limits(tmp_path, monkeypatch):
    monkeypatch.setattr('gyro_calibration.cli.plan.find_best_motion',
                        lambda *given: find_best_motion(*given[:4], generations=5))

    def write(**values):
        path = tmp_path / 'limits.yaml'
        path.write_text(
            yaml.safe_dump({'maximum_rate_dps': 60, 'maximum_acceleration_dps2': 120, **values}))
        return path
    return write


def test_the_verb_writes_a_profile_and_says_what_it_is_worth(run, limits, tmp_path):
    code, text, _ = run('plan', '--limits', limits(maximum_heading_deg=90.0), '--seconds', 15,
                        '--out', tmp_path / 'profile.csv', '--json')
    answer, motion = json.loads(text), read_motion(tmp_path / 'profile.csv')
    assert (code == 0 and motion.duration == pytest.approx(15.0)
            and motion.heading.max() < 90.01 * DEGREE)
    assert answer['scale_gain'] > 1.5
    assert answer['drive_s'] == 160.0 and answer['built_in_within_limits'] is False


def test_the_verb_prints_a_summary(run, limits, tmp_path):
    write_motion(tmp_path / 'drive.csv',
                 motion_from_rates(np.array([0.0, 10.0]), np.array([0.5, 0.5])))
    code, text, _ = run('plan', '--limits', limits(), '--seconds', 10,
                        '--motion', tmp_path / 'drive.csv', '--drive', 30)
    assert (code == 0 and 'heading over 30 s' in text
            and 'wheels that follow the profile, self-calibrate adds 0.58 %' in text
            and text.count('mean heading error') == 4)


WRONG = {
    'unknown': ({'maximum_speed': 3}, 'maximum_speed'),
    'no acceleration': ({'maximum_acceleration_dps2': 0},
                        'maximum_acceleration_dps2 is 0; wanted a finite number of at least 0.01'),
    'a text': ({'maximum_rate_dps': 'fast'}, "maximum_rate_dps is 'fast'"),
    'not a number': ({'maximum_rate_dps': math.nan}, 'maximum_rate_dps is nan'),
    'yes': ({'rest_s': True}, 'rest_s is True'),
    'start outside the headings': ({'minimum_heading_deg': 10},
                                   'minimum_heading_deg is 10; wanted a number from -1e+09 to 0'),
    'slowest above fastest': ({'minimum_rate_dps': 70},
                              'minimum_rate_dps is above maximum_rate_dps'),
}


@pytest.mark.parametrize('values, reason', WRONG.values(), ids=WRONG)
def test_wrong_limits_are_wrong_use(run, limits, values, reason):
    code, text, said = run('plan', '--limits', limits(**values))
    assert code == 2 and reason in said and said.count('\n') == 1 and not text


@pytest.mark.parametrize('options, rest, wanted', [
    (('--seconds', 301), 1, 2), (('--seconds', 0), 1, 2), (('--model', 'quiet.yaml'), 1, 2),
    (('--motion', 'nowhere.csv'), 1, 2), (('--seconds', 20), 10, 1)])
def test_wrong_options_are_wrong_use_and_limits_that_leave_no_motion_no_answer(
        run, limits, tmp_path, monkeypatch, options, rest, wanted):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'quiet.yaml').write_text('effects: {bias: {bias: 0.01}}')
    code, _, said = run('plan', '--limits', limits(rest_s=rest), *options)
    assert code == wanted and ('allow more seconds' in said) == (wanted == 1)
