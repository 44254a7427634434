"""Dwells: what a rate table's file holds, and what is found in a log in time."""

from dataclasses import replace

import numpy as np
import pytest

from gyro_calibration.dwells import dwells, find_dwells, from_table, join
from gyro_calibration.log import DEGREE, DataRefused, Log, read_log


def table(rates, **more):
    rate = np.array(rates, dtype=float) * DEGREE
    return Log(output=1.01 * rate, reference_rate=rate, **more)


def test_the_rows_of_a_rate_table_are_its_dwells(data):
    found = dwells(read_log(data / 'fog_rate_table' / 'table.csv'))
    assert len(found) == 695
    assert found.sweep.max() + 1 == 24


def test_the_order_of_the_rates_tells_the_sweeps_that_the_file_names(data):
    log = read_log(data / 'fog_rate_table' / 'table.csv')
    assert (dwells(replace(log, others={})).sweep == dwells(log).sweep).mean() > 0.99


def test_three_speeds_of_a_record_player_are_three_blocks():
    assert list(from_table(table([33.3, 45.0, 78.0])).sweep) == [0, 1, 2]


def test_a_log_that_swings_is_refused():
    time = np.arange(0.0, 60.0, 0.01)
    rate = 45.0 * DEGREE * np.sin(time)
    with pytest.raises(DataRefused, match='--method likelihood'):
        find_dwells(Log(output=rate, time=time, reference_rate=rate))


def test_joined_logs_keep_their_sweeps_apart():
    whole = join([dwells(table([33.3, 45.0, 78.0]), 'a.csv')] * 2)
    assert len(whole) == 6 and len(set(whole.sweep)) == 6 and whole.place[0] == 'a.csv: row 1'
