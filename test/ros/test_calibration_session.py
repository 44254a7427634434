# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A running calibration: when it is complete, what it is compared with, and its results."""

import math

from gyro_calibration.calibration.self_calibration import ReferenceErrors, RunLimits
from gyro_calibration.logs.log import DataRefused, DEGREE
from gyro_calibration.model.motion import CALIBRATION_MOTION, constant_rate_motion
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.calibration_session import (
    CalibrationRun,
    FINISH_TIMEOUT,
    fit_run,
    ODOMETRY,
    PROFILE,
    REST,
    TURNS,
)
import numpy as np
import pytest

INTERVAL, S, B = 0.02, 0.0373, 0.75 * DEGREE / 60
ROUND = constant_rate_motion([(3.0, 0.0), (12.0, 60.0), (3.0, 0.0)])
BEGIN = 1000.0


def ran(kind, motion, duration=None, drift=0.0):
    """Return a run over a motion and the rest after it, where it may drift, rad/s."""
    profile = motion if kind == PROFILE else None
    length = motion.duration if duration is None else duration
    run = CalibrationRun(kind, length, 0.0, profile, RunLimits(), ReferenceErrors(0.01), 2)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(2000)
    for number in range(2000):
        time = number * INTERVAL
        heading, turning = (float(of(np.array(time)))
                            for of in (motion.heading_at, motion.rate_at))
        rate = (1 + S) * turning + B + noise[number] + (drift if time > motion.duration else 0.0)
        if number % 3 == 0:
            run.odometry.append((BEGIN + time, heading, turning))
        run.add(BEGIN + time, rate, rate, 25.0)
        if kind in (ODOMETRY, TURNS) and time >= motion.duration:
            run.finish()
        if run.due_end_reason is not None:
            break
    return run, run.due_end_reason


def test_turns_that_are_not_finished_are_given_up():
    run = CalibrationRun(TURNS, math.inf, 0.0)
    for time in (0.0, FINISH_TIMEOUT, FINISH_TIMEOUT + 1.0):
        run.add(time, 0.0, 0.0, None)
    assert 'finish_calibration' in run.due_end_reason and 'rest on the mark' in run.status


@pytest.mark.parametrize('kind, duration', [(ODOMETRY, 600.0), (PROFILE, 700.0), (TURNS, 599.0)])
def test_a_run_of_known_length_may_be_longer_than_one_that_waits_for_a_call(kind, duration):
    run = CalibrationRun(kind, math.inf if kind == TURNS else duration, 0.0)
    run.add(0.0, 0.0, 0.0, None)
    run.add(duration, 0.0, 0.0, None)
    if kind == TURNS:
        run.finish()
    run.add(duration + 2.0, 0.0, 0.0, None)
    assert run.due_end_reason is None and run.progress < 1.0
    run.add(duration + 4.0, 0.0, 0.0, None)
    assert run.due_end_reason == ''


def test_odometry_without_a_yaw_is_taken_by_its_rates():
    run, _ = ran(ODOMETRY, CALIBRATION_MOTION, 20.0)
    run.odometry = [(time, 0.0, rate) for time, _, rate in run.odometry]
    assert fit_run(run, Noise(), '')[0].scale_factor_error == pytest.approx(S, abs=5e-3)


@pytest.mark.parametrize('spoil, reason', [(lambda given: [], '0 messages came on odom'),
                                           (lambda given: given[:20], '20 messages came'),
                                           (lambda given: given[::-1], 'increasing stamps')],
                         ids=['none', 'too few', 'out of order'])
def test_odometry_that_cannot_be_used_is_refused(spoil, reason):
    run, _ = ran(ODOMETRY, CALIBRATION_MOTION, 20.0)
    run.odometry = spoil(run.odometry)
    with pytest.raises(DataRefused, match=reason):
        fit_run(run, Noise(), '')


def test_the_gyro_may_count_the_turns_and_a_wrong_count_is_refused():
    run, _ = ran(TURNS, ROUND, math.inf)
    run.turns = 0
    assert '2 whole turns' in fit_run(run, Noise(), '')[1]
    run.turns = 3
    with pytest.raises(DataRefused, match='3 were given|turns'):
        fit_run(run, Noise(), '')


def test_a_drift_after_a_profile_refuses_it():
    run, _ = ran(PROFILE, CALIBRATION_MOTION, drift=0.05 * DEGREE)
    with pytest.raises(DataRefused, match='after the run'):
        fit_run(run, Noise(), '')


def test_who_drives_on_after_a_run_by_odometry_is_not_checked():
    run, _ = ran(ODOMETRY, CALIBRATION_MOTION, 20.0, drift=20.0 * DEGREE)
    run.odometry = [each for each in run.odometry if each[0] <= BEGIN + 20.0]
    run.limits = RunLimits(max_time_offset=0.5)
    assert 'at rest after it' not in fit_run(run, Noise(), '')[1]


def test_a_dead_gyro_at_rest_is_seen_behind_a_model_that_follows_the_temperature():
    run = CalibrationRun(REST, 10.0, 0.0)
    for number, noise in enumerate(1e-5 * np.random.default_rng(1).standard_normal(520)):
        run.add(number * INTERVAL, B, B + noise, 25.0)
    with pytest.raises(DataRefused, match='the gyro is dead'):
        fit_run(run, Noise(), '')
