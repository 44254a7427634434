# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Channels with memory: against exact responses, and equal for a stream, a log, and its blocks."""

from conftest import operations
from gyro_calibration.logs.log import Log
from gyro_calibration.model.channels import ChannelHistory, channels_from_log
import numpy as np
import pytest

UNEVEN = np.cumsum(np.random.default_rng(0).exponential(0.3, 3000))
LAGS = [('temperature', 0.01), ('temperature', 20.0), ('temperature', 3000.0),
        ('specific_force', 1.0), ('vibration', 1.0), ('vibration', 30.0)]
BRANCHES = [(10.0, 1e-3), (3.0, 0.0)]


def surroundings(time):
    """Return temperature, specific force and supply over time."""
    generator = np.random.default_rng(1)
    return (25.0 + 8.0 * np.sin(time / 90.0) + 0.01 * generator.standard_normal(len(time)),
            generator.standard_normal(len(time)), 5.0 + 0.1 * np.cos(time / 50.0))


def everything(channels):
    """Return all that a history says, shape (channels, ...)."""
    return np.array([channels.time, channels.temperature, channels.specific_force, channels.supply,
                     *[channels.lagged(*lag) for lag in LAGS],
                     *[channels.heating(*branch) for branch in BRANCHES]])


def ramp_response(time, time_constant):
    """Return the exact response of a first-order lag to a ramp that begins at time zero."""
    return time - time_constant * (1.0 - np.exp(-time / time_constant))


def lagged(time, temperature, time_constant):
    return channels_from_log(Log(output=time, time=time, temperature=temperature)).lagged(
        'temperature', time_constant)


@pytest.mark.parametrize('time_constant', [0.02, 1.0, 25.0, 3000.0])
@pytest.mark.parametrize('time', [np.arange(2000) * 0.1, UNEVEN - UNEVEN[0]],
                         ids=['even', 'uneven'])
def test_ramps_and_their_corners_are_answered_exactly_whatever_the_stamps(time, time_constant):
    expected = ramp_response(time, time_constant)
    assert lagged(time + 7.0, 20.0 + 0.5 * time, time_constant) == pytest.approx(
        20.0 + 0.5 * expected, rel=0.0, abs=1e-10)
    corner = time[len(time) // 3]
    late = ramp_response(np.maximum(time - corner, 0.0), time_constant)
    assert lagged(time, np.minimum(time, corner), time_constant) == pytest.approx(
        expected - late, rel=0.0, abs=1e-10)


def test_vibration_is_the_mean_square_about_the_mean():
    time = np.arange(0.0, 3000.0, 0.01)
    force = 9.81 + 0.3 * np.random.default_rng(2).standard_normal(len(time))
    vibration = channels_from_log(Log(output=time, time=time, specific_force=force)).lagged(
        'vibration', 1.0)[1000:]
    kept = 1.0 - 0.01 / 2.0  # of a white deviation; the mean over 1 s takes the rest
    assert vibration.mean() == pytest.approx(0.09 * kept, rel=0.01)


@pytest.mark.parametrize('noise', [0.0, 0.03])
def test_the_branch_turns_soon_after_the_temperature_does_and_not_by_noise(noise):
    time = np.arange(0.0, 1800.0, 0.05)
    turned = np.abs((time / 300.0) % 2.0 - 1.0)
    temperature = 40.0 - 6.0 * turned + noise * np.random.default_rng(3).standard_normal(len(time))

    def branch(temperature):
        log = Log(output=time, time=time, temperature=temperature)
        return channels_from_log(log).heating(10.0, 1e-3)
    settled = (time % 300.0) > 20.0
    assert (branch(temperature)[settled].tolist()
            == np.where((time // 300.0) % 2.0, -1.0, 1.0)[settled].tolist())
    # none before the temperature changes, and then it keeps the last one
    once = branch(np.clip(time, 200.0, 300.0))
    assert not once[time < 200.0].any() and once[time > 210.0].min() == 1.0


@pytest.mark.parametrize('cuts', [[1, 2, 500, 501, 2999], list(range(1, 300))],
                         ids=['blocks', 'sample by sample'])
def test_blocks_of_a_log_say_what_the_whole_says(cuts):
    whole = everything(ChannelHistory().update(UNEVEN, *surroundings(UNEVEN)))
    history, pieces = ChannelHistory(), []
    for block in np.split(np.arange(len(UNEVEN)), cuts):
        pieces.append(everything(history.update(UNEVEN[block],
                                                *(each[block] for each in surroundings(UNEVEN)))))
    assert np.hstack(pieces) == pytest.approx(whole, rel=1e-12, abs=1e-12)


def test_a_lag_goes_on_in_blocks_that_do_not_use_it():
    history, (temperature, *_) = ChannelHistory(), surroundings(UNEVEN)
    history.update(UNEVEN[:10], temperature[:10]).lagged('temperature', 20.0)
    history.update(UNEVEN[10:2000], temperature[10:2000])
    last = history.update(UNEVEN[2000:], temperature[2000:]).lagged('temperature', 20.0)
    assert last == pytest.approx(
        ChannelHistory().update(UNEVEN, temperature).lagged('temperature', 20.0)[2000:], rel=1e-12)


def test_while_no_temperature_is_known_one_stands_in_and_nothing_is_lagging():
    history = ChannelHistory(default_temperature=33.0)
    early = history.update(0.0)
    assert early.temperature == early.lagged('temperature', 100.0) == 33.0
    first = history.update(1.0, 10.0)
    assert first.temperature == first.lagged('temperature', 100.0) == 10.0, (
        'a temperature that comes is no change of temperature')
    ahead = history.update(2.0, 12.0).lagged('temperature', 100.0) - 12.0
    lost = history.update(102.0)
    assert (lost.temperature == 33.0
            and lost.lagged('temperature', 100.0) - 33.0 == pytest.approx(ahead / np.e, rel=1e-12))
    channels = channels_from_log(Log(output=UNEVEN))
    assert (channels.supply is None and not channels.time.any()
            and channels.lagged('temperature', 10.0).tolist() == [25.0] * len(UNEVEN))
    assert set(lagged(UNEVEN, np.full(len(UNEVEN), 31.7), 50.0)) == {31.7}


def test_a_lag_of_a_log_loops_over_no_samples():
    time = np.cumsum(np.random.default_rng(4).uniform(0.005, 0.015, 10 ** 5))
    channels = channels_from_log(Log(output=time, time=time, temperature=time))
    assert operations(lambda: channels.lagged('temperature', 120.0)) < 0.1 * len(time)
