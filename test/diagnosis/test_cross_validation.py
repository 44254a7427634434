# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The stated improvement by an extended model on held-out blocks: the state before, and limits."""

from gyro_calibration.diagnosis.extended_model import (
    heading_error_shares, jackknife_change, measure_gain)
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.search import start_search
from gyro_calibration.logs.log import Log
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

#: Standard deviation of a sample, rad/s, and samples a second.
WHITE, RATE = 1e-3, 10.0


def drive(generator, duration=600.0, bias=0.0, scale=0.0):
    """Return a drive with a reference rate, of a gyro with bias, scale error and white noise."""
    time = np.arange(round(duration * RATE)) / RATE
    rate = np.sin(0.3 * time) + 0.4 * np.sin(0.071 * time + 1.0)
    output = (1.0 + scale) * rate + bias + WHITE * generator.standard_normal(len(time))
    return Log(time=time, output=output, reference_rate=rate)


def blocks(log, length=60.0):
    """Return which samples are held out: every third block."""
    return np.floor(log.time / length).astype(int) % 3 == 1


# beside a model

@pytest.mark.parametrize('bias, scale', [(0.02, 0.0), (0.0, 0.03), (0.02, 0.03)])
def test_the_improvement_by_a_right_bias_and_scale_factor_is_measured_from_the_given_model(
        bias, scale):
    log = drive(np.random.default_rng(1), bias=bias, scale=scale)
    model = GyroModel((Term(BIAS, (0.0,)), Term(SCALE_FACTOR_ERROR, (0.0,))),
                      noise=Noise(WHITE / np.sqrt(RATE)))
    found = diagnose([log], np.random.default_rng(2), model)
    assert {each.effect for each in found.findings} == {
        name for name, size in (('bias', bias), ('scale_factor_error', scale)) if size}
    out = blocks(log)
    assert found.gain.rate.before == pytest.approx(
        np.sqrt(np.mean((log.output - log.reference_rate)[out] ** 2)), rel=1e-3)
    assert found.gain.rate.after == pytest.approx(WHITE, rel=0.1)
    curve = next(each for each in found.curves if each.along == 'rate')
    assert np.abs(curve.before - bias - scale * curve.at).max() < 0.1 * max(bias, scale)
    assert np.abs(curve.after).max() < 0.1 * max(bias, scale)
    # the answer is about heading: what each explains of the error over a minute, and what is left
    shares, models = found.heading_shares, found.gain.models
    assert shares['bias'] + shares['scale_factor_error'] > 0.99 and shares['left'] < 0.01
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)
    assert models['given'] == found.gain.heading.before > 10.0 * models['plain']
    assert models['extended'] == found.gain.heading.after
    assert all(each.remedy and each.share_of_heading_error == shares[each.effect]
               for each in found.findings)


# little to hold out

PARTLY = {'nothing that is held out': [lambda time: (time < 40.0) | (time >= 295.0)],
          'one log within what is held out': [
              lambda time: time >= 0.0, lambda time: (time >= 51.0) & (time < 96.0)]}


@pytest.mark.parametrize('known', PARTLY.values(), ids=PARTLY)
def test_a_reference_that_is_known_in_too_few_blocks_gives_no_gain(known):
    generator = np.random.default_rng(5)
    logs = [drive(generator, 300.0) for _ in known]
    laid = [replay(log, where(log.time), generator) for log, where in zip(logs, known)]
    assert measure_gain(start_search(laid), {'rate_ramp'}, False) is None


def test_one_part_has_no_interval_and_is_not_called_worse():
    change = jackknife_change(np.array([[1.0, 2.0]]), np.ones(1))
    assert change.interval is None and not change.is_worse and change.to_dict()['ci95'] is None
    assert jackknife_change(np.array([[1.0, 2.0]] * 2), np.ones(2)).is_worse
    assert not jackknife_change(np.array([[1.0, 2.0], [1.0, 1.2]]), np.ones(2)).is_worse


# how sure

@pytest.mark.parametrize('parts', [2, 3, 5, 8])
@pytest.mark.parametrize('shared', [0.0, 0.7, 1.0],
                         ids=['all is won', 'some is won', 'nothing is won'])
def test_intervals_of_the_improvement_hold_the_truth_for_few_parts(parts, shared):
    generator, runs = np.random.default_rng(8), 2000
    inside = 0
    for _ in range(runs):
        mine, other = generator.standard_normal((2, parts))
        after = shared * mine + 0.2 * other
        before = mine + 0.2 * generator.standard_normal(parts)
        change = jackknife_change(np.column_stack([before, after]) ** 2, np.ones(parts))
        low, high = change.interval
        inside += low <= np.hypot(1.0, 0.2) - np.hypot(shared, 0.2) <= high
    # Few squares are skew, which costs some per cent; resampled blocks cover 62 to 86 of 100.
    assert inside > 0.86 * runs, inside / runs


def test_what_a_cause_adds_like_a_bias_or_a_scale_factor_error_is_not_its_share():
    # a quadratic term at nearly one speed and a bias of the other sign, each 70 times the error
    time = np.arange(601.0)
    rate = 1.0 + 0.1 * np.sin(0.2 * time[1:])
    parts = {'scale_factor_error': 0.02 * rate, 'quadratic_nonlinearity': 0.5 * rate ** 2,
             'bias': np.full(600, -0.5), 'left': 1e-4 * np.cos(time[1:])}
    found = heading_error_shares([(parts, time)])
    assert abs(found['quadratic_nonlinearity']) < 0.01
    assert sum(found.values()) == pytest.approx(1.0)
    # what no bias and no scale factor error makes is its own
    own = {**parts, 'quadratic_nonlinearity': 1e-3 * np.sin(0.01 * time[1:]),
           'bias': 0.0 * rate, 'scale_factor_error': 0.0 * rate}
    assert heading_error_shares([(own, time)])['quadratic_nonlinearity'] > 0.5
