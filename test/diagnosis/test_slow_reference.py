# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A reference that is slow, was smoothed, or repeats its last value causes no false names."""

from dataclasses import replace

from chance import seeds
from gyro_calibration.calibration.encoder import calibrate_encoder, choose_reference
from gyro_calibration.calibration.own_instants import find_own_instants, keep_own_instants
from gyro_calibration.calibration.reference_noise import drop_repeated_headings
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.logs.log import DEGREE, Log
import numpy as np
import pytest

RATE, BIAS, SCALE = 50.0, 0.4 * DEGREE, 0.006
TIME = np.arange(0.0, 90.0, 1.0 / RATE)


def turning(seed, asymmetry=0.0):
    """Return a log of a robot that turns and stops, its rate, and its heading as functions."""
    generator, fine = np.random.default_rng(seed), np.arange(-1.0, 92.0, 0.004)
    rate, begin = np.zeros(len(fine)), 3.0
    while begin < 90.0:
        end = begin + generator.uniform(0.8, 3.0)
        rate[(fine >= begin) & (fine < end)] = generator.uniform(-70.0, 70.0) * DEGREE
        begin = end + generator.uniform(0.5, 4.0)
    for length in (0.3, 0.2):
        window = np.hanning(round(length / 0.004))
        rate = np.convolve(rate, window / window.sum(), 'same')
    heading = np.cumsum(rate) * 0.004
    own = np.interp(TIME, fine, rate)
    output = ((1.0 + SCALE) * own + asymmetry * np.abs(own) + BIAS
              + 4e-4 * np.sqrt(RATE) * generator.standard_normal(len(TIME)))
    return (Log(time=TIME, output=output), lambda time: np.interp(time, fine, rate),
            lambda time: np.interp(time, fine, heading - 0.002 * rate))


def held(true, interval):
    """Return the last of values that were taken at even instants, at each sample."""
    return true(np.floor((TIME + 1e-9) / interval - 0.3) * interval + 0.3 * interval)


def linear(true, interval):
    """Return lines between values that were taken at even instants, at each sample."""
    at = np.arange(-0.37 * interval, 91.0, interval)
    return np.interp(TIME, at, true(at))


@pytest.mark.parametrize('given', [held, linear])
@pytest.mark.parametrize('interval', [0.05, 0.1, 0.2])
def test_the_own_instants_of_a_slow_reference_are_found(given, interval):
    for true in turning(1)[1:]:
        found = find_own_instants(TIME, given(true, interval))
        assert found.interval == pytest.approx(interval, rel=0.01)
        assert found.is_held == (given is held)
        assert find_own_instants(TIME, true(TIME)) is None
    log = replace(turning(1)[0], reference_heading=given(true, interval))
    own, instants = keep_own_instants(log)
    known = np.isfinite(own.reference_heading)
    assert instants.interval == found.interval
    assert (np.isfinite(instants.time) == known).all()
    if given is linear:  # where a held heading stands, it may be lost
        assert known.sum() == pytest.approx(TIME[-1] / interval, rel=0.01)
    # held values were taken since the sample before, those on lines are as exact as the splines
    error = np.abs(own.reference_heading - true(TIME))[known]
    fastest = np.abs(np.diff(true(TIME))).max()
    assert error.max() < (fastest if given is held else 0.1 * interval * RATE * fastest)


def test_a_table_that_holds_each_rate_for_seconds_is_not_slow():
    rate = np.repeat(np.random.default_rng(2).uniform(-1.0, 1.0, 36), 125)
    log = Log(time=TIME, output=rate, reference_rate=rate,
              reference_heading=np.cumsum(rate) / RATE)
    assert keep_own_instants(log)[1] is None


SLOW = {'rate held': ('reference_rate', held, 0.1), 'rate linear': ('reference_rate', linear, 0.2),
        'heading held': ('reference_heading', held, 0.1),
        'heading linear': ('reference_heading', linear, 0.2)}


@pytest.mark.parametrize('asymmetry', [0.0, 0.02])
@pytest.mark.parametrize('name', SLOW)
@pytest.mark.parametrize('seed', seeds(1))
def test_a_slow_reference_shows_the_gyro_and_nothing_else(name, asymmetry, seed):
    quantity, given, interval = SLOW[name]
    log, *true = turning(seed + 3, asymmetry)
    log = replace(log, **{quantity: given(true[quantity == 'reference_heading'], interval)})
    found = diagnose([log], np.random.default_rng(0))
    assert found.remarks[0].startswith('The reference has a value of its own every '
                                       f'{1000.0 * interval:.3g} ms')
    names = {each.effect for each in found.findings if each.status == 'established'}
    assert names - {'time_offset'} == ({'scale_factor_asymmetry'} if asymmetry else set())
    assert not found.unexplained
    values = {term.effect.name: term.values[0] for term in found.model.terms}
    assert values['scale_factor_error'] == pytest.approx(SCALE, abs=2e-3)
    assert values['bias'] == pytest.approx(BIAS, abs=0.03 * DEGREE)


def test_all_verbs_take_the_heading_where_a_rate_is_late_and_state_that_once():
    """The twist of odometry is often a mean over the last second, and its pose is not."""
    log, rate, heading = turning(4)
    late = np.mean([rate(TIME - back) for back in np.arange(0.0, 1.2, 0.02)], axis=0)
    log = replace(log, reference_heading=heading(TIME))
    alone, both = (diagnose([each], np.random.default_rng(0))
                   for each in (log, replace(log, reference_rate=late)))
    fitted = calibrate_encoder(replace(log, reference_rate=late))
    for found in (both, fitted):
        remarks = [each for each in found.remarks if 'the heading is used' in each]
        assert len(remarks) == 1, found.remarks
        assert remarks[0].startswith('The reference rate is 0.6 s behind the reference heading')
    assert [each.effect for each in both.findings] == [each.effect for each in alone.findings]
    assert both.model.terms == alone.model.terms
    assert fitted.fit.scale_factor_error == pytest.approx(SCALE, abs=2e-3)
    assert fitted.model.terms == calibrate_encoder(log).model.terms


def test_a_heading_that_is_seldom_known_gives_way_to_the_rate():
    log, rate, heading = turning(4)
    log = replace(log, reference_rate=rate(TIME), reference_heading=np.where(
        TIME < 40.0, heading(TIME), np.nan))
    left, remarks = choose_reference(log)
    assert left.reference_heading is None and 'heading is known in 2000 samples only' in remarks[0]
    assert choose_reference(replace(log, reference_heading=heading(TIME)))[1] == []


def test_headings_that_are_repeated_while_the_gyro_turns_are_not_used():
    log, _, heading = turning(5)
    tracked = heading(TIME)
    assert drop_repeated_headings(replace(log, reference_heading=tracked))[1] == []
    moving = np.flatnonzero(np.abs(log.output - BIAS) > 20.0 * DEGREE)
    for start in moving[[200, 600, 1000]].tolist():
        tracked[start:start + 150] = tracked[start]
    log = replace(log, reference_heading=tracked)
    fit = calibrate_encoder(log)
    assert 'as if it were lost' in fit.remarks[0]
    assert fit.fit.bias == pytest.approx(BIAS, abs=0.01 * DEGREE)
    found = diagnose([log], np.random.default_rng(0))
    assert found.verdict == 'adequate', found
    assert 'as if it were lost' in found.remarks[0]
    assert found.model.terms[1].values[0] == pytest.approx(SCALE, abs=2e-3)
    still = diagnose([replace(log, reference_heading=0.0 * tracked)], np.random.default_rng(0))
    assert [each.name for each in still.gates if each.passed is False] == ['motion']
    assert still.verdict == 'mismatched'


@pytest.mark.parametrize('seed', [1, 2, 7])
def test_rests_in_which_the_bias_wanders_are_no_lost_reference(seed):
    generator, interval, count, white = np.random.default_rng(seed), 0.1, 12000, 1e-4
    dwells = np.where(np.arange(60) % 3, generator.uniform(-1.5, 1.5, 60), 0.0)
    rate = np.convolve(np.repeat(dwells, count // 60), np.ones(3) / 3.0, 'same')
    # a random walk that exceeds the white noise after a second
    output = (rate + white / np.sqrt(interval) * generator.standard_normal(count)
              + np.sqrt(3.0 * interval) * white * np.cumsum(generator.standard_normal(count)))
    heading = np.append(0.0, np.cumsum(0.5 * interval * (rate[1:] + rate[:-1])))
    log = Log(time=interval * np.arange(count), output=output, reference_heading=heading)
    assert drop_repeated_headings(log)[1] == []


def test_the_instants_of_a_held_rate_are_found_beside_a_gap():
    """Two of them might be the same at the end of the gap, and no spline goes through these."""
    time = np.arange(6000) / 50.0
    for seed in range(40):
        generator = np.random.default_rng(seed)
        motion = sum(size * np.sin(2.0 * np.pi * frequency * time) for size, frequency in zip(
            generator.uniform(0.1, 0.5, 3), generator.uniform(0.02, 0.3, 3)))
        measured = motion[np.arange(6000) // 5 * 5]
        begin, length = generator.integers([500, 10], [5000, 300])
        kept = np.delete(np.arange(6000), slice(begin, begin + length))
        _, instants = keep_own_instants(Log(
            time=time[kept], reference_rate=measured[kept],
            output=(motion + 0.01 * generator.standard_normal(6000))[kept]))
        known = instants.time[np.isfinite(instants.time)]
        assert (np.diff(known) > 0.0).all() and len(known) == pytest.approx(len(kept) / 5, rel=0.1)
