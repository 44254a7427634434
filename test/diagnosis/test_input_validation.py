# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The door: the usable reference is taken, noise is no motion, huge data are refused."""

from dataclasses import replace

from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.gates import is_at_rest, refuse_unusable, select_reference
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, refuse_wrapped, unwrap_heading
import numpy as np
import pytest

INTERVAL = 0.01
COUNT = 12_000
TIME = np.arange(COUNT) * INTERVAL
RATE = np.sin(0.9 * TIME) * np.clip(3.0 * np.sin(0.11 * TIME), 0.0, 1.0)
HEADING = np.concatenate([[0.0], np.cumsum(0.5 * INTERVAL * (RATE[1:] + RATE[:-1]))])
TURNED = np.cumsum(np.abs(RATE)) * INTERVAL


def gyro(rate, seed=1):
    """Return the output of a gyro with noise of 0.057 deg/s and a scale factor error of 1 %."""
    return 1.01 * rate + 2e-3 + 1e-3 * np.random.default_rng(seed).standard_normal(len(rate))


LOG = Log(output=gyro(RATE), time=TIME, reference_rate=RATE)
STILL = Log(output=gyro(np.zeros(COUNT)), time=TIME)


# a reference that says nothing

def test_a_reference_of_nan_alone_is_none():
    """Beside a heading that says all, and at rest."""
    nothing = np.full(COUNT, np.nan)
    by_heading, by_none = (select_reference(replace(log, reference_rate=nothing))[0]
                           for log in (replace(LOG, reference_heading=HEADING), STILL))
    assert by_heading.reference_rate is None and by_heading.reference_heading is HEADING
    assert by_none.reference_rate is None and is_at_rest(by_none)
    assert not diagnose([replace(STILL, reference_heading=nothing)],
                        np.random.default_rng(1)).findings


def test_a_rate_that_is_known_at_times_gives_way_to_the_heading():
    some = np.where(np.arange(COUNT) < 50, RATE, np.nan)
    log = replace(LOG, reference_rate=some, reference_heading=np.round(HEADING / 1e-3) * 1e-3)
    quality = inspect_record(log)
    assert quality.heading_step == pytest.approx(1e-3)
    assert select_reference(log)[0].reference_rate is None


# noise is no motion

def noisy(kind):
    """Return a reference at rest: odometry, motion capture, a simulator, or an encoder."""
    generator = np.random.default_rng(7)
    noise = generator.standard_normal(COUNT)
    if kind == 'odometry':
        return {'reference_rate': 0.01 * noise}
    if kind == 'simulator':
        return {'reference_rate': 1e-8 * noise}
    if kind == 'motion capture':
        return {'reference_heading': 1e-3 * noise + 2e-3 * np.sin(0.05 * TIME)}
    return {'reference_heading': 0.088 * DEGREE * (np.sin(0.07 * TIME) + 0.3 * noise > 0.0)}


@pytest.mark.parametrize('kind', ['odometry', 'simulator', 'motion capture', 'encoder'])
def test_the_noise_of_a_reference_at_rest_is_no_motion(kind):
    log = replace(STILL, **noisy(kind))
    refuse_unusable(log)
    assert is_at_rest(log) and not np.nan_to_num(select_reference(log)[0].reference_rate).any()
    assert 'taken to be at rest' in ' '.join(inspect_record(log).remarks)


def test_a_gyro_at_rest_beside_a_noisy_reference_has_no_findings():
    found = diagnose([replace(STILL, **noisy('motion capture'))], np.random.default_rng(1))
    assert not found.findings and 'scale_factor_error' in found.cannot_show


@pytest.mark.parametrize('size', [0.05, 0.5])
def test_a_small_motion_that_the_gyro_sees_stays_motion(size):
    """Swings of so many deg, beside the noise of the references above."""
    swing = size * DEGREE * np.sin(0.5 * TIME)
    for kind in ('odometry', 'motion capture'):
        noise = next(iter(noisy(kind).values()))
        motion = {'odometry': {'reference_rate': 0.1 * noise + np.gradient(swing, TIME)},
                  'motion capture': {'reference_heading': 0.1 * noise + swing}}[kind]
        assert not is_at_rest(replace(STILL, output=gyro(np.gradient(swing, TIME)), **motion))


# what is refused

def jumped(seconds):
    """Return a log in the middle of which a clock was set."""
    return replace(LOG, time=TIME + np.where(np.arange(COUNT) < COUNT // 2, 0.0, seconds))


@pytest.mark.parametrize('log', [jumped(12.0 * 86400.0), jumped(1500.0),
                                 replace(jumped(12.0 * 86400.0), output=LOG.output - RATE,
                                         reference_rate=0.0 * RATE)],
                         ids=['a clock that was set', 'two drives', 'at rest'])
def test_a_log_that_is_a_gap_for_the_most_part_is_refused_with_where_it_is(log):
    with pytest.raises(
            DataRefused,
            match=r'12000 of .* samples can be used.*begins at 59\.990 s: cut the log there'):
        diagnose([log], np.random.default_rng(1))


@pytest.mark.parametrize('first', [0.0, -np.pi])
@pytest.mark.parametrize('use', [refuse_unusable, calibrate_encoder])
def test_a_wrapped_heading_is_refused_with_the_way_out(use, first):
    heading = np.where(TIME % 7.0 < 0.1, np.nan, (TURNED - first) % (2.0 * np.pi) + first)
    with pytest.raises(DataRefused,
                       match='heading jumps by a full turn, first at .* s: use --unwrap'):
        use(Log(output=gyro(np.abs(RATE)), time=TIME, reference_heading=heading))


@pytest.mark.parametrize('use', [refuse_unusable, calibrate_encoder])
def test_a_full_turn_in_a_gap_that_the_gyro_does_not_show_is_refused(use):
    heading = np.where((TIME > 30.0) & (TIME < 37.0), np.nan, TURNED + 2.0 * np.pi * (TIME > 32.0))
    log = Log(output=1.03 * np.abs(RATE) + 0.01, time=TIME, reference_heading=heading)
    with pytest.raises(DataRefused, match='full turn that the gyro does not show, first in the '
                                          r'gap that ends at 37\..* use --unwrap'):
        use(log)
    restored, _ = unwrap_heading(TIME, heading, TIME, log.output)
    refuse_wrapped(replace(log, reference_heading=restored))


def test_turns_in_gaps_or_between_slow_samples_are_no_wrapped_heading():
    turn = 2.0 * np.pi * np.clip(TIME - 32.0, 0.0, 1.0)
    lost = np.where((TIME > 30.0) & (TIME < 37.0), np.nan, TURNED + turn)
    measured = gyro(np.abs(RATE) + np.gradient(turn, TIME))
    refuse_unusable(Log(output=measured, time=TIME, reference_heading=lost))
    # nor where the gyro was lost too, or has another unit
    either = np.where(np.isnan(lost), np.nan, gyro(np.abs(RATE)))
    refuse_unusable(Log(output=either, time=TIME, reference_heading=lost))
    refuse_wrapped(Log(output=57.3 * measured, time=TIME, reference_heading=lost))
    slow = np.arange(1000) * 1.0
    turned = np.cumsum(2.0 * np.pi * (np.sin(0.05 * slow) > 0.0))
    rate = np.gradient(turned, slow)
    refuse_unusable(Log(output=gyro(rate), time=slow, reference_heading=turned))
