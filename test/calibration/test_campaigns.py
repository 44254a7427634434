# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations

"""A calibration by one campaign on a rate table holds in a hotter and faster one."""


from campaigns import judge, least_squares_error, simulated
from gyro_calibration.calibration.dwells import dwells_from_table, select_dwells
from gyro_calibration.calibration.selection import select_effects
from gyro_calibration.logs.log import DEGREE, read_log
import numpy as np
import pytest


@pytest.mark.parametrize('sine', [True, False], ids=['open-loop', 'MEMS'])
@pytest.mark.parametrize('gyros', [4, pytest.param(40, marks=pytest.mark.evidence)])
def test_the_stated_deviation_is_that_of_another_campaign(sine, gyros):
    """The 12 sweeps of a gyro are correlated, so z² scatters as that of a few numbers."""
    errors, z, peers = [], [], []
    for seed in range(100, 100 + gyros):
        cool, hot = (simulated(np.random.default_rng(seed), sine, each) for each in (False, True))
        found = judge(select_effects(cool).calibration.model, hot)
        errors.append(found[0])
        z.append(found[1])
        peers.append(least_squares_error(cool, hot))
    assert np.mean(errors) < 1.1 * np.mean(peers)
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 2.0


def test_on_the_recorded_table_the_cooler_half_predicts_the_hotter_one(data):
    dwells = dwells_from_table(read_log(data / 'fog_rate_table' / 'table.csv'))
    first, second = (select_dwells(dwells, (dwells.sweep < 12) == part) for part in (True, False))
    error, z = judge(select_effects(first).calibration.model, second)
    assert error < 0.065 and z < 1.6
    slow = select_dwells(first, np.abs(first.rate) < 60.0 * DEGREE)
    error, z = judge(select_effects(slow).calibration.model, second)
    assert error < 0.08 and z < 1.6
