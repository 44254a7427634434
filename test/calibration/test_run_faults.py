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
Self-calibration: bad runs are refused by name, good ones accepted, and rests check them.

`benchmarks/fooled.py` does the first two with 200 runs of each kind at each noise level.
"""

from functools import cache
import json
import math

from chance import fewest, most
from conftest import operations
from fooled import LEVELS, tried, WAYS
from gyro_calibration.calibration.likelihood import MIN_FIT_PROBABILITY, ScaleBiasFit
from gyro_calibration.calibration.run_faults import split_run
from gyro_calibration.calibration.self_calibration import (
    check_end, check_rest, describe_implausible_scale, find_rest_after, ReferenceErrors, RunLimits,
    self_calibrate)
from gyro_calibration.calibration.whole_turns import calibrate_turns
from gyro_calibration.logs.log import DataRefused, DEGREE
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import write_model
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, constant_rate_motion, motion_from_headings, motion_from_rates)
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
import numpy as np
import pytest
from scipy.signal import lfilter

GOOD = [name for name, (_, _, word) in WAYS.items() if not word]
BAD = [name for name in WAYS if name not in GOOD]
TIME = np.arange(2001) / 100.0
S, B = 0.03, 0.05 * DEGREE


@pytest.mark.parametrize('level', LEVELS)
@pytest.mark.parametrize('name', BAD)
def test_a_run_that_went_wrong_is_refused_by_its_name(name, level):
    reasons = [tried((name, number, level))[0] for number in range(2)]
    assert all(reasons) and not any('\n' in reason for reason in reasons)
    assert any(WAYS[name][2] in reason for reason in reasons), reasons


@pytest.mark.parametrize('runs', [8, pytest.param(20, marks=pytest.mark.evidence)])
@pytest.mark.parametrize('level', LEVELS)
def test_good_runs_are_accepted_and_their_intervals_hold_the_truth(level, runs):
    found = [tried(('good', number, level)) for number in range(runs)]
    accepted = np.array([errors for reason, errors in found if not reason])
    assert len(accepted) >= runs - 1, found
    assert (np.abs(accepted[:, :2]) < 4.0).all()


def output(seed=0, motion=CALIBRATION_MOTION, time=TIME, level=1.0):
    """Return the output of an XV3500 with a multiple of its noise in a motion."""
    noise = Noise(level * XV3500.noise.angle_random_walk, level * XV3500.noise.bias_instability)
    return ((1 + S) * motion.rate_at(time) + B
            + simulate_noise(noise, len(time), 0.01, np.random.default_rng(seed)))


@pytest.mark.parametrize('runs', [15, pytest.param(40, marks=pytest.mark.evidence)])
def test_the_goodness_of_fit_has_the_probability_that_it_says(runs):
    probabilities = [self_calibrate(TIME, output(seed), CALIBRATION_MOTION,
                                    noise=XV3500.noise).goodness.probability
                     for seed in range(runs)]
    assert np.mean(probabilities) == pytest.approx(0.5, abs=4.0 / math.sqrt(12.0 * runs))


def test_noise_beyond_the_models_is_reported_and_more_of_it_refused():
    goodness = (
        self_calibrate(TIME, output(level=3.0), CALIBRATION_MOTION, noise=XV3500.noise).goodness)
    assert (goodness.probability < MIN_FIT_PROBABILITY
            and goodness.noise_ratio == pytest.approx(3.0, rel=0.4))
    assert 'larger than expected from the noise' in str(goodness)
    assert self_calibrate(TIME, output(), CALIBRATION_MOTION).goodness is None, 'no figures'
    with pytest.raises(DataRefused, match='times as noisy as the model states|a slip or a bump'):
        self_calibrate(TIME, output(level=15.0), CALIBRATION_MOTION, noise=XV3500.noise,
                       limits=RunLimits(max_scale_deviation=1.0))


LONG = np.arange(2301) / 100.0


@pytest.mark.parametrize('time, moved, said', [
    (TIME, output(motion=constant_rate_motion([(1, 0), (4, 45), (1, 0), (2, -45), (20, 0)])),
     r'does not follow the profile, which explains \d+ % of the run, least at about (7|8)\.\d s'),
    (LONG, output(time=LONG - 2.5), r'the gyro is (2\.4|2\.5|2\.6) s behind the profile'),
    (TIME, output() + (1 + S) * np.clip(CALIBRATION_MOTION.rate_at(TIME), -0.5, 0.5)
     - (1 + S) * CALIBRATION_MOTION.rate_at(TIME), 'a limit of the motion')],
    ids=['an early end', 'a late beginning', 'a limit of the robot'])
def test_another_motion_is_reported_by_where_it_deviates(time, moved, said):
    with pytest.raises(DataRefused, match=said):
        self_calibrate(time, moved, CALIBRATION_MOTION, noise=XV3500.noise)


def test_a_run_that_ends_after_the_first_of_two_equal_halves_is_not_ahead_of_its_profile():
    turns = [(1, 0), (3, 60), (1, 0), (3, -60)]
    time = np.arange(0.0, 18.0, 0.02)
    run, profile = (constant_rate_motion([*turns * times, (1, 0)]) for times in (1, 2))
    with pytest.raises(DataRefused, match='from its beginning to its end'):
        self_calibrate(time, 1.01 * run.rate_at(time) + 1e-4 * np.random.default_rng(
            0).standard_normal(len(time)), profile)


def test_a_run_without_known_noise_is_judged_by_the_noise_of_its_samples():
    """White noise of a gyro is no fault; a robot that swings about its profile is one."""
    limits = RunLimits(max_scale_deviation=1.0, max_heading_error=math.tau)
    assert self_calibrate(TIME, output(level=15.0), CALIBRATION_MOTION, limits=limits)
    wander = 4.0 * DEGREE * np.sin(2.0 * math.pi * TIME / 3.1)
    with pytest.raises(DataRefused, match='times as noisy as its samples show'):
        self_calibrate(TIME, output() + wander, CALIBRATION_MOTION, limits=limits)


def test_a_scale_factor_error_that_gyros_hardly_have_is_remarked_with_a_remedy():
    wheels = output() - 0.27 * CALIBRATION_MOTION.rate_at(TIME)
    off, good = (self_calibrate(TIME, rate, CALIBRATION_MOTION) for rate in (wheels, output()))
    assert describe_implausible_scale(good, 0.01, 'profile') == ''
    assert ' 22 standard deviations' in describe_implausible_scale(off, 0.01, 'profile')
    assert 'radius and track of the wheels' in describe_implausible_scale(off, 0.01, 'profile')


def test_a_slip_in_a_long_run_is_found_by_work_that_grows_no_faster_than_its_length():
    """The node serves nothing else meanwhile; short pieces only would take 10 times as long."""
    time, work = np.arange(12000) / 100.0, []
    motion = motion_from_rates(time, 0.5 * np.sin(0.5 * time))
    rate = ((1.0 + S) * motion.rate_at(time) + B + 0.3 * ((time > 9.0) & (time < 9.7))
            + 1e-3 * np.random.default_rng(0).standard_normal(len(time)))

    def refused(count):
        with pytest.raises(DataRefused, match='differs by (9|1[0-9.]+)[0-9.]* deg from .* at '
                                              'about [789].* a slip or a bump'):
            self_calibrate(time[:count], rate[:count],
                           motion_from_rates(time[:count], motion.rate[:count]), noise=Noise(1e-4))
    for count in (len(time) // 4, len(time)):
        work.append(operations(lambda: refused(count)))  # noqa: B023
        assert len(split_run(time[:count], rate[:count]).gyro_angle) <= 650
    assert work[1] < 4.0 * work[0]
    assert np.diff(split_run(time[:6000], rate[:6000]).edges) == pytest.approx(0.1), (
        'a minute keeps its short pieces')


@pytest.mark.parametrize('factor, words', [
    (60.0, 'the gyro is in deg/s and read as rad/s, or the profile in rad/s and read as'),
    (0.159, 'either the gyro is in revolutions/s and read as rad/s, or the profile in rad/s and '),
    (9.55, 'is in revolutions/min and read as rad/s, or the profile in rad/s and read as rev'),
    (1000.0, 'either the gyro is in mdeg/s and read as deg/s, or the profile in deg/s and read'),
])
def test_one_confusion_of_units_is_named_the_usual_one_first(factor, words):
    with pytest.raises(DataRefused, match=words):
        self_calibrate(TIME, factor * CALIBRATION_MOTION.rate_at(TIME), CALIBRATION_MOTION)


def test_a_limit_hidden_by_the_model_is_seen_in_the_output():
    clipped = np.clip(output(), -40 * DEGREE, 40 * DEGREE)
    drifting = clipped - 1e-4 * TIME  # a compensation that changes with temperature
    with pytest.raises(DataRefused, match='saturated'):
        self_calibrate(TIME, drifting, CALIBRATION_MOTION, output=clipped)


@cache
def calibrated(seed):
    return self_calibrate(TIME, output(seed), CALIBRATION_MOTION, noise=XV3500.noise)


def rested(seed, change=0.0):
    noise = simulate_noise(XV3500.noise, 201, 0.01, np.random.default_rng([seed, 1]))
    return 20.0 + np.arange(201) / 100.0, B + change + noise


def test_the_rates_at_rest_after_the_run_have_their_stated_deviation():
    checks = [check_rest(*rested(seed), calibrated(seed % 20), XV3500.noise)
              for seed in range(200)]
    beyond = sum(abs(check.rate) > 1.645 * check.deviation for check in checks)
    assert fewest(200, 0.1) <= beyond <= most(200, 0.1)


@pytest.mark.parametrize('change, count, words', [
    (0.3 * DEGREE, 201, 'the corrected rate is 0.'),
    (-1.0 * DEGREE, 201, 'the corrected rate is -'),
    (np.linspace(0.0, 10.0 * DEGREE, 201), 201, 'still moved'),
    (0.0, 50, 'after the run 0.5 s of rest came')])
def test_a_rest_after_the_run_refuses_a_drift_and_a_motion_and_must_be_there(change, count, words):
    time, rate = rested(0, change)
    with pytest.raises(DataRefused, match=words):
        check_rest(time[:count], rate[:count], calibrated(0), XV3500.noise)


def test_the_rest_after_a_run_is_found_and_a_drive_is_none():
    time = np.arange(2600) / 100.0
    rate = output(0, time=time)
    rest = find_rest_after(time, rate, calibrated(0), CALIBRATION_MOTION)
    assert (time[rest][0] == pytest.approx(21.0, abs=0.02)
            and time[rest][-1] == pytest.approx(26.0, abs=0.3))
    driven = find_rest_after(time, rate + np.where(time > 24.5, 0.2, 0.0), calibrated(0),
                             CALIBRATION_MOTION)
    assert driven.start == rest.start and 23.0 <= time[driven][-1] <= 24.5
    assert find_rest_after(time, rate + np.where(time > 20.5, 0.2, 0.0), calibrated(0),
                           CALIBRATION_MOTION) is None
    assert find_rest_after(TIME, rate[:2001], calibrated(0), CALIBRATION_MOTION) is None


#: The built-in profile, one that ends with 1.5 s of rest, and the built-in one by its headings.
PROFILES = [CALIBRATION_MOTION, constant_rate_motion(
    [(1, 0), (4, 45), (1, 0), (4, -45), (1, 0), (3.5, 30), (1, 0), (3.5, -30), (1.5, 0)]),
    motion_from_headings(TIME[::5], CALIBRATION_MOTION.heading_at(TIME[::5]), is_measured=False)]


@pytest.mark.parametrize('motion, degrees, rest, lasts, words', [
    *((profile, degrees, 0.4, 0.0, 'the robot turned throughout the run')
      for profile in PROFILES for degrees in (0.05, -0.1, 0.2, 0.3, -0.5)),
    *((CALIBRATION_MOTION, degrees, 0.9, lasts, 'still turned after it')
      for degrees in (0.5, -1.0) for lasts in (0.2, 0.4, 0.6))])
def test_a_steady_turn_in_a_log_that_ends_soon_is_refused_or_in_the_interval(
        motion, degrees, rest, lasts, words):
    """Without a rest, or so many s of the turn within it; what the whole log has is a bias."""
    time = np.arange(0.0, motion.duration + rest, 0.01)
    turn = np.where(time < motion.duration + lasts, degrees * DEGREE, 0.0)
    for seed in range(4):
        rate = output(seed, motion=motion, time=time) + turn
        fit = self_calibrate(time, rate, motion, noise=XV3500.noise)
        try:
            fit = check_end(time, rate, fit, motion, XV3500.noise)
        except DataRefused as refused:
            assert words in str(refused)
        else:
            assert abs(fit.bias - B) < 5.0 * math.sqrt(fit.covariance[1, 1])


def test_a_robot_that_settles_before_its_log_ends_is_at_rest_then(tmp_path, run):
    """The turn by which it settles was in the deviation of the bias, 0.3 deg/s."""
    fine = np.arange(0.0, 22.0, 0.001)
    lagging = lfilter([1e-3 / 0.3], [1.0, 1e-3 / 0.3 - 1.0],
                      CALIBRATION_MOTION.rate_at(fine - 0.4))[::10]
    deviations = []
    for seed in range(6):
        generator = np.random.default_rng([seed, 8])
        s, b = generator.uniform(-0.03, 0.03), generator.uniform(-1.0, 1.0) * DEGREE
        rate = (1 + s) * lagging + b + simulate_noise(XV3500.noise, len(lagging), 0.01, generator)
        fit = self_calibrate(fine[::10], rate, CALIBRATION_MOTION, noise=XV3500.noise)
        fit = check_end(fine[::10], rate, fit, CALIBRATION_MOTION, XV3500.noise)
        deviations.append(math.sqrt(fit.covariance[1, 1]))
        assert abs(fit.bias - b) < 4.0 * deviations[-1]
    assert np.median(deviations) < 0.15 * DEGREE
    words = run('self-calibrate', write_log(tmp_path / 'log.csv', fine[::10], rate), '--profile',
                write_log(tmp_path / 'profile.csv', CALIBRATION_MOTION.time,
                          CALIBRATION_MOTION.rate, 'rate_rad_s'))[1]
    assert 'no rest up to 3.7 s after the profile' in words


@pytest.mark.parametrize('off', [0.0, 3.0, -10.0])
def test_the_rest_after_a_run_draws_the_bias_of_a_run_that_is_off(off):
    """The run states 0.01 deg/s, its error is a multiple; the rest has a fifth of it."""
    time, generator = np.arange(201) / 100.0, np.random.default_rng(7)
    run, errors = (0.01 * DEGREE) ** 2, []
    for _ in range(50):
        fit = ScaleBiasFit(0.0, off * math.sqrt(run), np.diag([1e-6, run]))
        rest = check_rest(time, 0.2 * math.sqrt(run * len(time)) * generator.standard_normal(201),
                          fit, limits=RunLimits(max_rest_rate=1.0)).fit
        errors.append(rest.bias / math.sqrt(rest.covariance[1, 1]))
        assert rest.covariance[1, 1] < 0.3 * run and rest.covariance[0, 0] == pytest.approx(1e-6)
    assert np.mean(np.abs(errors) < 1.96) > 0.8


def odometry(seed, deviation, drift):
    """Return the heading of wheels at 50 Hz with errors of scale and drift, and with slip."""
    generator = np.random.default_rng([seed, 2])
    fine = np.arange(20001) / 1000.0
    rate = ((1 + deviation * generator.standard_normal()) * CALIBRATION_MOTION.rate_at(fine)
            + drift * generator.standard_normal())
    slip = (0.3 * DEGREE * np.sqrt(np.abs(rate) / (90 * DEGREE) / 1000.0)
            * generator.standard_normal(len(fine)))
    heading = np.concatenate([[0.0], np.cumsum(rate / 1000.0 + slip)[:-1]])
    return motion_from_headings(fine[::20], heading[::20])


@pytest.mark.parametrize('runs', [10, pytest.param(25, marks=pytest.mark.evidence)])
def test_odometry_calibrates_and_its_own_scale_and_drift_are_in_the_deviations(runs):
    reference, sizes = ReferenceErrors(0.0075, 0.01 * DEGREE), []
    for seed in range(runs):
        late = np.random.default_rng([seed, 3]).uniform(-0.3, 0.3)
        try:
            fit = self_calibrate(TIME, output(seed, time=TIME - late),
                                 odometry(seed, 0.0075, 0.01 * DEGREE), reference=reference)
        except DataRefused as refusal:
            assert 'a slip or a bump' in str(refusal)
            continue
        sizes.append(np.abs([fit.scale_factor_error - S, fit.bias - B, fit.time_offset - late])
                     / [math.sqrt(fit.covariance[0, 0]), math.sqrt(fit.covariance[1, 1]),
                        fit.time_offset_deviation])
    assert runs - len(sizes) <= most(runs, 0.02)
    assert ((np.array(sizes) < 1.96).sum(axis=0) >= fewest(len(sizes), 0.93)).all(), sizes


def turned(number, seed=0, s=S, before=3.0, after=3.0, speed=45.0):
    """Return time and output of whole turns that are closed to about a degree."""
    generator = np.random.default_rng([seed, 5])
    angle = 360.0 * number + generator.standard_normal()
    motion = constant_rate_motion([(before, 0), (abs(angle) / speed, math.copysign(speed, angle)),
                                   (after + 0.5, 0)])
    time = np.arange(int(100 * motion.duration) + 1) / 100.0
    return time, ((1 + s) * motion.rate_at(time) + B
                  + simulate_noise(XV3500.noise, len(time), 0.01, generator))


@pytest.mark.parametrize('number', [1, 2, 5, -5])
def test_whole_turns_give_scale_and_bias_with_their_deviations(number):
    sizes = []
    for seed in range(40):
        found = calibrate_turns(*turned(number, seed), number, noise=XV3500.noise)
        assert found.turns == number
        sizes.append(np.abs([found.fit.scale_factor_error - S, found.fit.bias - B])
                     / np.sqrt(np.diag(found.fit.covariance)))
    assert ((np.array(sizes) < 1.96).sum(axis=0) >= fewest(40, 0.95)).all()
    assert calibrate_turns(*turned(number), noise=XV3500.noise).turns == number, 'counted'


def test_the_steps_of_a_coarse_output_are_in_the_deviations_of_whole_turns():
    """A rest, and turns at one rate, err by one part of a step however long they last."""
    step, motion = 0.6 * DEGREE, constant_rate_motion([(5, 0), (36, 50.0), (5.5, 0)])
    time = np.arange(0.0, motion.duration, 0.04)
    for seed in range(12):
        generator = np.random.default_rng([seed, 7])
        s, b = generator.uniform(-0.03, 0.03), generator.uniform(-2.0, 2.0) * DEGREE
        noise = generator.uniform(0.05, 0.3) * generator.standard_normal(len(time))
        rate = step * np.round(((1 + s) * motion.rate_at(time) + b) / step + noise)
        fit = calibrate_turns(time, rate, 5, mark_deviation=0.1 * DEGREE).fit
        errors = np.abs([fit.scale_factor_error - s, fit.bias - b])
        assert (errors < 4.0 * np.sqrt(np.diag(fit.covariance))).all()


def test_ramps_of_a_finely_stepped_output_do_not_widen_whole_turns():
    """Few values of a ramp lie on a grid 17 times too coarse; noise is larger than the steps."""
    step, time = 0.06 * DEGREE, np.arange(0.0, 47.0, 0.02)
    rate = np.clip(np.minimum(time - 5.0, 42.0 - time) / 0.5, 0.0, 1.0)
    rate *= 5.0 * math.tau / (0.02 * rate.sum())
    for seed in range(6):
        noise = 0.7 * np.random.default_rng(seed).standard_normal(len(time))
        output = step * np.round((1.01 * rate - 0.15 * DEGREE) / step + noise)
        fit = calibrate_turns(time, output, 5).fit
        deviation = math.sqrt(fit.covariance[1, 1])
        assert abs(fit.bias + 0.15 * DEGREE) < 4.0 * deviation < 0.03 * DEGREE


CLOCK, TURNED = turned(2)
NO_TURNS = {
    'half a turn too much': (turned(2.5), 2, 'counts 2.5'),
    'half a turn, uncounted': (turned(2.5), None, 'counts 2.5'),
    'one more': (turned(3), 2, 'and 2 were given'),
    'too many to count': (turned(12, speed=90.0), None, 'too many to count'),
    'the other way': (turned(2), -2, 'the other way'),
    'not at all': (turned(2), 0, 'turn once at least'),
    'no rest before': (turned(2, before=0.6), 2, 's before the turns'),
    'no rest after': (turned(2, after=0.2), 2, 's after the turns'),
    'scale and count': (turned(5, s=0.1), 5, 'one whole number'),
    'a large scale': (turned(1, s=0.33), 1, 'beyond 30 %'),
    'deg/s': ((CLOCK, TURNED / DEGREE), 2, 'is in deg/s and read as rad/s'),
    'saturated': ((CLOCK, np.clip(TURNED, -0.6, 0.6)), 2, 'saturated'),
    'a bias that moves': ((CLOCK, TURNED + np.where(CLOCK > 15.0, 0.02, 0.0)), 2,
                          'rests before and after'),
    'dead': ((CLOCK, B + 0.0 * TURNED), 2, 'same value'),
    'no motion': ((CLOCK, -S * TURNED + 1e-3 * np.sin(97.0 * CLOCK)), 2,
                  'check that the robot moved'),
}


@pytest.mark.parametrize('log, number, words', NO_TURNS.values(), ids=NO_TURNS)
def test_what_cannot_be_whole_turns_is_refused(log, number, words):
    with pytest.raises(DataRefused, match=words):
        calibrate_turns(*log, number, noise=XV3500.noise)


def write_log(path, time, rate, name='gyro_rad_s'):
    path.write_text(f'time_s,{name}\n'
                    + ''.join(f'{t:.4f},{r:.9f}\n' for t, r in zip(time.tolist(), rate.tolist())))
    return path


def test_the_verb_says_all_that_the_fit_found_and_checks_the_rest(tmp_path, run):
    write_model(tmp_path / 'model.yaml', GyroModel(noise=XV3500.noise))
    profile = tmp_path / 'profile.csv'
    profile.write_text('time_s,rate_rad_s\n' + ''.join(
        f'{t},{r}\n' for t, r in zip(CALIBRATION_MOTION.time, CALIBRATION_MOTION.rate)))
    time = np.arange(2500) / 100.0
    log = write_log(tmp_path / 'log.csv', time, output(0, time=time))
    words = ('self-calibrate', log, '--profile', profile, '--model', tmp_path / 'model.yaml',
             '--reference-scale-deviation', '0.5')
    code, text, _ = run(*words, '--json')
    found = json.loads(text)
    assert (code == 0 and found['scale_factor_error_standard_deviation']
            == pytest.approx(0.0052, abs=0.0003))
    assert abs(found['rest_rate_rad_s']) < found['rest_limit_rad_s']
    assert found['time_offset_standard_deviation_s'] < 0.01 and found['noise_ratio'] < 2.0
    said = run(*words)[1]
    assert 'At rest after the run' in said and '+-' in said
    spoiled = write_log(tmp_path / 'spoiled.csv', time,
                        output(0, time=time) + np.where(time > 20.5, 0.5 * DEGREE, 0.0))
    code, _, error = run('self-calibrate', spoiled, *words[2:])
    assert code == 1 and 'after the run, at rest' in error and error.count('\n') == 1


@pytest.mark.parametrize('column, deviation, is_said', [
    ('heading_rad', 0.0058, True), ('reference_heading_rad', 0.0003, False)])
def test_the_verb_takes_a_heading_as_commanded_unless_its_column_is_a_reference(
        tmp_path, run, column, deviation, is_said):
    time = np.arange(2500) / 100.0
    log, profile = write_log(tmp_path / 'log.csv', time, output(0, time=time)), write_log(
        tmp_path / 'profile.csv', TIME, CALIBRATION_MOTION.heading_at(TIME), column)
    words = 'self-calibrate', log, '--profile', profile
    found = json.loads(run(*words, '--json')[1])
    assert found['scale_factor_error_standard_deviation'] == pytest.approx(deviation, rel=0.5)
    assert ('taken as commanded' in run(*words)[1]) == is_said


def test_the_verb_calibrates_by_turns(tmp_path, run):
    log = write_log(tmp_path / 'turns.csv', *turned(5))
    code, text, _ = run('self-calibrate', log, '--turns', '5', '--marking', '2',
                        '--out', tmp_path / 'new.yaml', '--json')
    found = json.loads(text)
    assert code == 0 and found['turns'] == 5 and found['method'] == 'turns'
    assert (abs(found['scale_factor_error'] - S)
            < 3.0 * found['scale_factor_error_standard_deviation'] < 0.006)
    code, text, _ = run('self-calibrate', write_log(tmp_path / 'two.csv', *turned(-2)),
                        '--turns', 'nearest')
    assert code == 0 and '2 full turns clockwise' in text
