# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What keeps gyro and reference from being compared is the only finding, with its remedy."""

from dataclasses import replace
import re

from chance import seeds
from diagnosed import limited
from gyro_calibration import fit
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.gates import (
    check_gates, is_at_rest, refuse_unusable, select_reference)
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.logs.log import (
    DataRefused, DEGREE, Log, log_from_table, refuse_wrapped, select_rows, unwrap_heading)
import numpy as np
import pytest
from scipy.signal import lfilter

TIME = np.arange(0.0, 120.0, 0.01)
MOTION = 0.6 * np.sin(0.7 * TIME) + 0.3 * np.sin(1.9 * TIME + 1.0) + 0.1 * np.sin(0.11 * TIME)
HEADING = np.cumsum(MOTION) * 0.01


def drive(seed=0, heading_noise=0.0):
    generator = np.random.default_rng(seed)
    output = 1.01 * MOTION + 0.005 + 2e-3 * generator.standard_normal(len(TIME))
    return Log(output=output, time=TIME,
               reference_heading=HEADING + heading_noise * generator.standard_normal(len(TIME)))


def other_motion():
    generator = np.random.default_rng(7)
    other = np.repeat(generator.standard_normal(len(TIME) // 200), 200)
    return np.cumsum(other) * 0.01


def tumbling(log):
    """Return a log whose axis tilts: the gyro sees a part of the turns, and other turns."""
    tilt = np.cos(0.9 * TIME)
    return replace(
        log, output=log.output * tilt + 1.5 * np.sin(0.13 * TIME) * np.sqrt(1.0 - tilt**2))


@pytest.mark.parametrize('ramps', [False, True])
@pytest.mark.parametrize('digits', [6, 9])
def test_an_attitude_that_turns_at_one_rate_is_no_unit_error(ramps, digits):
    time = np.arange(0.0, 120.0, 1.0 / 70.7)  # spans of unequal length
    rate = 30.0 * DEGREE * np.clip(np.minimum(time - 5.0, 115.0 - time), 1.0 - ramps, 1.0)
    half = 0.5 * np.cumsum(rate) / 70.7
    log = log_from_table({
        'time_s': time, 'qw': np.cos(half).round(digits), 'qz': np.sin(half).round(digits),
        'qx': 0.0 * time, 'qy': 0.0 * time,
        'gyro_rad_s': 1.01 * np.interp(time - 0.03, time, rate)
        + 3e-4 * np.random.default_rng(1).standard_normal(len(time))},
        {'attitude': 'qw/qx/qy/qz'})
    gates = {each.name: each.passed for each in check_gates(log)}
    assert gates.get('unit', True) and gates['motion'] is (True if ramps else None)


@pytest.mark.parametrize('frequency, delay', [(0.265, 0.083), (0.307, 0.064), (0.344, 0.055)])
def test_a_swing_that_agrees_half_a_period_later_has_the_sense_of_its_small_delay(
        frequency, delay):
    time = np.arange(0.0, 150.0, 0.02)
    phase, turns = 2.0 * np.pi * frequency * time, 2.0 * np.pi * frequency * delay
    log = Log(output=np.cos(phase - turns), time=time,
              reference_heading=np.sin(phase) / (2.0 * np.pi * frequency))
    (gate,) = [each for each in check_gates(log) if each.name == 'sense']
    assert gate.passed and check_gates(replace(log, output=-log.output))[-1].name == 'sense'


WRONG = {
    'sense': lambda log: replace(log, output=-log.output),
    'output in deg': lambda log: replace(log, output=log.output / DEGREE),
    'output in rad': lambda log: replace(log, output=log.output * DEGREE),
    'heading in deg': lambda log: replace(log, reference_heading=log.reference_heading / DEGREE),
    'heading in rad': lambda log: replace(log, reference_heading=log.reference_heading * DEGREE),
    'factor 2': lambda log: replace(log, output=2.0 * log.output),
    'factor 8.5': lambda log: replace(log, output=8.5 * log.output),
    'factor 1e12': lambda log: replace(log, output=1e12 * log.output),
    'stamps in ms': lambda log: replace(log, time=1e3 * log.time),
    'stamps ten times too slow': lambda log: replace(log, time=10.0 * log.time),
    'wrapped': lambda log: replace(
        log, reference_heading=(log.reference_heading + 3.0) % (2.0 * np.pi)),
    'other motion': lambda log: replace(log, reference_heading=other_motion()),
    'tumbling': tumbling,
}
FAILED = {'sense': 'sense', 'stamps in ms': 'time_unit', 'stamps ten times too slow': 'time_unit',
          'wrapped': 'wrapped_heading', 'other motion': 'motion', 'tumbling': 'motion'}


@pytest.mark.parametrize('noise', [0.0, 1.0 * DEGREE], ids=['exact', 'course'])
@pytest.mark.parametrize('wrong', WRONG)
def test_what_keeps_gyro_and_reference_apart_is_the_only_finding(wrong, noise):
    if wrong == 'wrapped' and noise:
        noise = 1e-4
    log = WRONG[wrong](drive(heading_noise=noise))
    found = diagnose([log], np.random.default_rng(0))
    (finding,) = found.findings
    failed = [gate.name for gate in found.gates if gate.passed is False]
    assert (found.verdict == 'mismatched' and finding.remedy
            and failed == [FAILED.get(wrong, 'unit')]), (failed, finding.evidence)
    assert (found.to_dict()['gates'][-1]['passed'] is False
            and found.to_dict()['findings'][0]['remedy'] == finding.remedy)
    assert finding.remedy in ' '.join(' '.join(terminal_lines(found)).split())
    with pytest.raises(DataRefused, match=re.escape(finding.remedy)):
        fit(log)


@pytest.mark.parametrize('wrap', [lambda heading: heading, lambda heading: heading % 360.0],
                         ids=['continuous', 'wrapped'])
def test_fixes_in_deg_that_are_named_rad_have_another_unit_and_are_not_wrapped(wrap):
    log = drive(heading_noise=1.0 * DEGREE)
    degrees = np.where(np.arange(len(TIME)) % 25, np.nan, wrap(log.reference_heading / DEGREE))
    for heading in (degrees, unwrap_heading(TIME, degrees, TIME, log.output)[0]):
        failed = check_gates(replace(log, reference_heading=heading))[-1]
        assert failed.name == 'unit' and 'deg or rad' in failed.remedy, failed.evidence


@pytest.mark.parametrize('seed', range(3))
def test_turns_between_long_rests_that_the_gyro_does_not_make_are_another_motion(seed):
    generator = np.random.default_rng(seed)
    turns = np.zeros((2, len(TIME)))  # of the gyro, and of the reference
    for row in turns:
        for begin in generator.integers(0, len(TIME) - 200, 8):
            row[begin:begin + 200] = generator.uniform(-1.5, 1.5)
    log = Log(TIME, turns[0] + 1e-3 * generator.standard_normal(len(TIME)),
              reference_heading=np.cumsum(turns[1]) * 0.01)
    gate = check_gates(log)[-1]
    assert gate.name == 'motion' and gate.passed is False, gate


def small_turns(seed):
    """Return a log of turns of some degrees, and the generator of its noise."""
    generator = np.random.default_rng(seed)
    turns = np.interp(TIME, np.arange(121.0), 0.1 * generator.standard_normal(121))
    return Log(TIME, turns + 1e-3 * generator.standard_normal(len(TIME)),
               reference_heading=np.cumsum(turns) * 0.01), generator


@pytest.mark.parametrize('seed', seeds(3))
def test_a_reference_of_the_same_small_turns_with_larger_errors_passes(seed):
    log, generator = small_turns(seed)
    errors = np.interp(TIME, np.arange(121.0), 5.0 * DEGREE * generator.standard_normal(121))
    assert not [gate for gate in check_gates(
        replace(log, reference_heading=log.reference_heading + errors)) if gate.passed is False]


def test_a_commanded_rate_that_hardly_changes_shows_no_unit():
    generator = np.random.default_rng(1)
    time = np.arange(0.0, 27.0, 1.0 / 64.0)
    command = np.where(np.arange(len(time)) < len(time) - 1, -0.4259, 0.0)
    log = Log(output=command + 0.01 + 0.02 * generator.standard_normal(len(time)), time=time,
              reference_rate=command)
    assert all(gate.passed is not False for gate in check_gates(log))


def test_a_robot_that_follows_a_swing_in_part_is_no_unit_error():
    command = np.sin(2.0 * np.pi * 0.3 * TIME)
    output = limited(command, 0.005) + 1e-3 * np.random.default_rng(1).standard_normal(len(TIME))
    log = Log(output=output, time=TIME, reference_rate=command)
    gate = check_gates(log)[-1]
    assert gate.name == 'motion' and not gate.passed and 'rate_command' in gate.remedy, gate
    assert all(gate.passed is not False for gate in check_gates(log, is_command=True))


@pytest.mark.parametrize('factor, name', [(-1.0, 'sense'), (DEGREE, 'unit'), (0.5, 'unit')])
def test_a_robot_that_follows_steps_late_shows_its_unit(factor, name):
    generator = np.random.default_rng(2)
    command = np.repeat(generator.uniform(-1.0, 1.0, 40), 300)
    output = factor * (limited(command, 0.005) + 1e-3 * generator.standard_normal(len(TIME)))
    gate = check_gates(Log(output=output, time=TIME, reference_rate=command), is_command=True)[-1]
    assert gate.name == name and gate.passed is False, gate


@pytest.mark.parametrize('seed', range(3))
def test_a_robot_that_follows_quick_commands_late_shows_that_its_gyro_is_inverted(seed):
    """No single lag shows it, and another motion was left to the fit of a response."""
    generator = np.random.default_rng(seed)
    command = np.repeat(generator.uniform(-1.0, 1.0, 751), 2)[:1500]
    output = (-lfilter([0.125], [1.0, -0.875], command)
              + 5e-3 * generator.standard_normal(len(command)))
    gate = check_gates(Log(output=output, time=0.1 * np.arange(1500), reference_rate=command),
                       is_command=True)[-1]
    assert gate.name == 'sense' and gate.passed is False, gate


@pytest.mark.parametrize('factor, refused', [
    (-1.0, 'opposite senses'), (DEGREE, 'different units'), (1.0, None)])
def test_the_unit_and_sense_of_a_rate_table_are_checked(factor, refused):
    rate = np.repeat(np.arange(-100.0, 101.0, 20.0) * DEGREE, 3)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(len(rate))
    table = Log(output=factor * (rate + noise), reference_rate=rate)
    if refused is None:
        fit(table)
    else:
        with pytest.raises(DataRefused, match=refused):
            fit(table)


# Which reference is taken, what is rest, and what is refused

COUNT = len(TIME)
RATE = np.sin(0.9 * TIME) * np.clip(3.0 * np.sin(0.11 * TIME), 0.0, 1.0)
ANGLE = np.concatenate([[0.0], np.cumsum(0.005 * (RATE[1:] + RATE[:-1]))])
TURNED = np.cumsum(np.abs(RATE)) * 0.01


def gyro(rate, seed=1):
    """Return the output of a gyro with noise of 0.057 deg/s and a scale factor error of 1 %."""
    return 1.01 * rate + 2e-3 + 1e-3 * np.random.default_rng(seed).standard_normal(len(rate))


LOG = Log(output=gyro(RATE), time=TIME, reference_rate=RATE)
STILL = Log(output=gyro(np.zeros(COUNT)), time=TIME)


def test_a_reference_of_nan_alone_is_none():
    nothing = np.full(COUNT, np.nan)
    by_heading, by_none = (select_reference(replace(log, reference_rate=nothing))[0]
                           for log in (replace(LOG, reference_heading=ANGLE), STILL))
    assert by_heading.reference_rate is None and by_heading.reference_heading is ANGLE
    assert by_none.reference_rate is None and is_at_rest(by_none)
    assert not diagnose([replace(STILL, reference_heading=nothing)],
                        np.random.default_rng(1)).findings


def test_a_rate_that_is_known_at_times_gives_way_to_the_heading():
    some = np.where(np.arange(COUNT) < 50, RATE, np.nan)
    log = replace(LOG, reference_rate=some, reference_heading=np.round(ANGLE / 1e-3) * 1e-3)
    quality = inspect_record(log)
    assert quality.heading_step == pytest.approx(1e-3)
    assert select_reference(log)[0].reference_rate is None


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
    swing = size * DEGREE * np.sin(0.5 * TIME)
    for kind in ('odometry', 'motion capture'):
        noise = next(iter(noisy(kind).values()))
        motion = {'odometry': {'reference_rate': 0.1 * noise + np.gradient(swing, TIME)},
                  'motion capture': {'reference_heading': 0.1 * noise + swing}}[kind]
        assert not is_at_rest(replace(STILL, output=gyro(np.gradient(swing, TIME)), **motion))


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
    with pytest.raises(DataRefused, match='full turn that the gyro does not show, first at '
                                          r'37\..* use --unwrap'):
        use(log)
    restored, _ = unwrap_heading(TIME, heading, TIME, log.output)
    refuse_wrapped(replace(log, reference_heading=restored))


@pytest.mark.parametrize('rows_are_missing', [False, True])
def test_turns_while_the_gyro_has_no_samples_are_no_other_motion(rows_are_missing):
    """Interpolated over these 40 s, it would turn by 775 deg."""
    lost = (TIME > 17.0) & (TIME < 57.0)
    log = replace(drive(heading_noise=0.002), output=np.where(lost, np.nan, drive().output))
    if rows_are_missing:
        log = select_rows(log, ~lost)
    assert all(each.passed for each in check_gates(log))
    found = calibrate_encoder(log)
    assert found.fit.scale_factor_error == pytest.approx(0.01, abs=1e-3)
    assert np.sqrt(np.mean(found.residual_after ** 2)) < 0.2 * DEGREE


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
