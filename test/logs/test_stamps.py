# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Stamps that a host gives on arrival: delayed samples are not lost, and lost ones are counted."""

from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.logs.log import Log
from gyro_calibration.logs.stamps import fit_stamp_grid
import numpy as np
import pytest

INTERVAL = 0.01


def stalled(seconds):
    """Return stamps of a host that stalls for some seconds, then takes 0.2 ms a sample."""
    due = np.arange(6000) * INTERVAL
    late = 20.0 + seconds + 2e-4 * np.arange(6000)
    return np.concatenate([due[:2000], np.maximum(due[2000:], late[:4000])])


@pytest.mark.parametrize('seconds', [0.05, 0.3, 1.0])
@pytest.mark.parametrize('jitter', [0.0, 1e-3])
def test_what_waited_at_a_host_is_not_lost(seconds, jitter):
    time = (stalled(seconds)
            + jitter * np.random.default_rng(1).random(6000) * (np.arange(6000) < 2000))
    stamps = fit_stamp_grid(time)
    assert not stamps.has_bursts and not stamps.lost_after.any()
    noise = 1e-3 * np.random.default_rng(2).standard_normal(6000)
    assert not inspect_record(Log(output=noise, time=time)).findings


@pytest.mark.parametrize('time, lost', [
    (np.delete(stalled(0.3), np.arange(2015, 2027)), 12),
    *((np.delete(stalled(0.3), [*range(500, 500 + missing), *range(4000, 4000 + missing)]),
       2 * missing) for missing in (1, 5, 40)),
    *((np.delete(INTERVAL * np.arange(10_000), np.s_[1::every]), len(range(1, 10_000, every)))
      for every in (8, 20))],
    ids=['while a host stands', *(f'{missing} before and after' for missing in (1, 5, 40)),
         'one of 8', 'one of 20'])
def test_what_is_lost_is_counted(time, lost):
    assert fit_stamp_grid(time).lost_after.sum() == lost


@pytest.mark.parametrize('change', [0.0, 0.1])
def test_an_interval_that_changes_over_the_log_is_no_burst(change):
    generator, places = np.random.default_rng(3), np.arange(3000)
    steps = 0.04 * (1.0 + change * np.sin(places / 500.0))
    time = np.cumsum(steps) + 0.03 * generator.random(3000)
    stamps = fit_stamp_grid(time)
    assert stamps.has_bursts == (change == 0.0) == bool(stamps.burst_remarks)
    assert change or stamps.max_deviation < 0.04
