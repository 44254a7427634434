"""
Clocks that are set while nodes run, and simulated time that goes back: real processes, with the clock of one of them moved by libfaketime.

"""

import itertools
import math
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from fake_gyro import BEGIN, start_with_gyro
from test_compensation_node_live import BIAS, INTERVAL, MODEL, outputs, told

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import Sample, find

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.qos import QoSProfile
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

# The variant for programs with threads: the other one gives a wrong time now and then while threads read the file at once.
FAKETIME = [Path(f'/usr/lib/{machine}-linux-gnu/faketime/libfaketimeMT.so.1') for machine in ('x86_64', 'aarch64')]
HOUR = 3600.0


@pytest.fixture
def set_clock(tmp_path, monkeypatch):
    """
    Return a function that sets the clock of all nodes that are started after this, by so many s from the true one, and at first by 2 h.

    Never below 0: Fast DDS loses messages of writers whose clock is ahead of the reader's, and here only one of the two is moved.

    """
    library = next((path for path in FAKETIME if path.exists()), None)
    if library is None:
        pytest.skip('libfaketime is not installed (apt-get install faketime)')
    offset = tmp_path / 'offset'

    def set_clock(seconds):
        new = offset.with_suffix('.new')
        new.write_text(f'{seconds:+.0f}')
        os.replace(new, offset)
    set_clock(2.0 * HOUR)
    for name, value in {'LD_PRELOAD': library, 'FAKETIME_TIMESTAMP_FILE': offset, 'FAKETIME_NO_CACHE': 1,
                        'FAKETIME_DONT_FAKE_MONOTONIC': 1}.items():
        monkeypatch.setenv(name, str(value))
    return set_clock


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    return partial(start_with_gyro, start_node, ros, wait_until, tmp_path, MODEL, INTERVAL, BIAS)


def seconds(date):
    """Return a date of a file, as text or as what YAML takes it for, in s since 1970."""
    return np.datetime64(str(date).removesuffix('+00:00'), 's').astype('int64')


def test_the_heading_goes_on_where_the_clock_of_the_computer_is_set(set_clock, start, ros):
    _, gyro = start(bias_duration=20.0)
    gyro.play(outputs(10.0))
    gyro.play(outputs(4.0, 0.3))
    for offset, jump in ((3.0 * HOUR, HOUR), (HOUR, -2.0 * HOUR)):
        variance = gyro.imu[-1].orientation_covariance[8]
        set_clock(offset)
        gyro.wait(jump)
        gyro.play(outputs(4.0, 0.3))
        assert gyro.imu[-1].orientation_covariance[8] < variance + 0.3 ** 2
    headings = np.array([message.data for message in gyro.heading])
    assert headings[-1] == pytest.approx(12.0 * 0.3, abs=0.1) and np.abs(np.diff(headings)).max() < 1.2 * 0.3 * INTERVAL
    values = told(gyro, lambda values: values['clock_set'].startswith('2 times'), 'two steps of the clock')
    assert values['restarts'] == '0' and '-7200' in values['clock_set']
    future = gyro.call_later('calibrate_bias')
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.calibrating())
    set_clock(2.0 * HOUR)
    gyro.wait(HOUR)
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or future.done(), what='a calibration at rest')
    assert future.result().success, future.result().message


def test_driver_and_compensation_go_on_together_where_the_clock_is_set(set_clock, start_node, ros, wait_until, tmp_path):
    """A gyro that turns evenly: the stamps jump as the clock did, once, and the heading does not."""
    (tmp_path / 'model.yaml').write_text(yaml.safe_dump(MODEL))
    heading = ros.collect(Imu, 'imu/data')
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
    samples = (Sample(0.31, None, 0.01 * number) for number in itertools.count())
    with Emulator(find('kvh_dsp3000'), samples, wait_for_reader=True) as gyro:
        start_node('compensation_node', {'calibration_file': tmp_path / 'calibration.yaml', 'model_file': tmp_path / 'model.yaml'})
        start_node('driver_node', {'port': gyro.path})
        wait_until(lambda: len(heading) > 200, what='headings')
        for hours in (3.0, 1.0):
            set_clock(hours * HOUR)
            later, begin = heading[-1].header.stamp.sec + (HOUR if hours == 3.0 else -2.0 * HOUR), len(heading)
            wait_until(lambda: abs(heading[-1].header.stamp.sec - later) < 100.0 and len(heading) > begin + 200,  # noqa: B023, at once
                       what='headings with stamps of the clock that was set')
        wait_until(lambda: any('2 times' in value.value for value in values_of(diagnostics, 'clock_set')), what='two steps of the clock')
    messages = list(heading)
    steps = np.diff([stamp.sec + 1e-9 * stamp.nanosec for stamp in (message.header.stamp for message in messages)])
    jumps = np.where(np.abs(steps) > 100.0, np.round(steps / HOUR) * HOUR, 0.0)
    assert jumps[jumps != 0.0] == pytest.approx([HOUR, -2.0 * HOUR])
    directions = np.unwrap([2.0 * math.atan2(message.orientation.z, message.orientation.w) for message in messages])
    assert directions - directions[0] == pytest.approx(0.3 * np.append(0.0, np.cumsum(steps - jumps)), abs=0.3 * 0.1)
    assert all(value.value == '0' for value in values_of(diagnostics, 'restarts'))
    assert max(message.orientation_covariance[8] for message in heading) < 0.5 ** 2


def values_of(diagnostics, key):
    return [value for array in diagnostics for status in array.status for value in status.values if value.key == key]


def test_timers_and_time_limits_go_on_where_the_clock_is_set_back(set_clock, start, ros, wait_until):
    _, gyro = start(bias_duration=20.0, sample_timeout=1.0)
    gyro.play(outputs(2.0))
    future = gyro.call_later('calibrate_bias')
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.calibrating())
    set_clock(HOUR)
    wait_until(future.done, what='a refusal')
    assert 'no sample came for 1 s' in future.result().message
    gyro.diagnostics.clear()
    wait_until(lambda: gyro.diagnostics and gyro.says('no samples on imu/data_raw'), what='diagnostics')


def test_a_calibration_of_before_the_clock_was_set_gets_the_date_that_it_had(set_clock, start, tmp_path):
    _, gyro = start(bias_duration=5.0)
    future = gyro.call_later('calibrate_bias')
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or future.done(), what='a calibration at rest')
    assert future.result().success, future.result().message
    assert abs(float(told(gyro, lambda values: values.get('calibration_age_h'), 'an age')['calibration_age_h'])) < 1.0
    begun = yaml.safe_load((tmp_path / 'calibration.yaml').read_text())['self_calibration']['time']
    set_clock(2.0 * HOUR + 1e8)
    gyro.wait(1e8)
    values = told(gyro, lambda values: values['clock_set'], 'a step of the clock')
    assert abs(float(values['calibration_age_h'])) < 1.0 and values['restarts'] == '0'
    stored = yaml.safe_load((tmp_path / 'calibration.yaml').read_text())['self_calibration']['time']
    assert seconds(stored) - seconds(begun) == pytest.approx(1e8, abs=60.0)


def test_simulated_time_that_goes_back_and_on_again(start, ros):
    """As where a recording is played in a loop: the heading begins anew there and does not jump, and the node goes on telling."""
    clock = ros.publisher(Clock, '/clock', QoSProfile(depth=10))
    _, gyro = start(use_sim_time='true')
    gyro.wait_until(clock.get_subscription_count)

    def tick(number):
        if number % 5 == 0:
            clock.publish(Clock(clock=gyro.stamp()))
    for _ in range(3):
        gyro.play(outputs(5.0), before=tick)
        gyro.play(outputs(4.0, 0.3), before=tick)
        gyro.nanoseconds = BEGIN
    headings = np.array([message.data for message in gyro.heading])
    assert np.abs(np.diff(headings)).max() < 1.2 * 0.3 * INTERVAL and headings[-1] == pytest.approx(3.6, abs=0.2)
    gyro.diagnostics.clear()
    gyro.wait_until(lambda: gyro.play(outputs(0.4), before=tick) or gyro.diagnostics, what='diagnostics')
    values = gyro.values()
    assert int(values['restarts']) >= 2 and values['clock_set'] == ''
    assert ros.call(Trigger, 'reset_heading').success and math.isfinite(float(values['heading_deg']))
