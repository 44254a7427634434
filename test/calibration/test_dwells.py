# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Dwells: from the file of a rate table, and found in simulated and recorded logs."""

from dataclasses import replace
import math

from chance import fewest, most, rms_bounds
from gyro_calibration.calibration.dwells import (
    dwells_from_table, extract_dwells, find_dwells, join_dwells)
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log
from gyro_calibration.model.motion import constant_rate_motion
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
import pytest
from scipy.signal import lfilter

RATES = (0, *(sign * rate for rate in range(10, 101, 10) for sign in (1, -1)))
RUN = constant_rate_motion([(16.0, rate) for rate in RATES])
TIME = np.arange(0.0, RUN.duration, 0.01)
RATE, HEADING = RUN.rate_at(TIME), RUN.heading_at(TIME)
SCALE, BIAS = 1.01, 0.3 * DEGREE


@pytest.fixture
def generator():
    return np.random.default_rng(3)


def table(rates, **more):
    rate = np.array(rates, dtype=float) * DEGREE
    drift = 1e-9 * np.arange(len(rate))  # so that repeats of a rate differ
    return Log(output=SCALE * rate + BIAS + drift, reference_rate=rate, **more)


def run(generator, noise=0.01, rate=RATE, **more):
    """Return the log of a gyro on a rate table; angle random walk in deg/√s."""
    output = (SCALE * rate + BIAS
              + simulate_noise(Noise(noise * DEGREE), len(TIME), 0.01, generator))
    return Log(output=output, time=TIME, **(more or {'reference_rate': RATE}))


def encoder(step, generator, heading=HEADING):
    """Return the heading by an encoder with this step, deg, that begins anywhere in a step."""
    return np.floor(heading / (step * DEGREE) + generator.random()) * step * DEGREE


def errors(found):
    """Return the errors of the means in their stated deviations."""
    return (found.output - SCALE * found.rate - BIAS) / found.deviation


def test_the_rows_of_a_rate_table_are_its_dwells_and_their_order_tells_the_named_sweeps(data):
    log = read_log(data / 'fog_rate_table' / 'table.csv')
    found = extract_dwells(log)
    assert (len(found), found.sweep.max() + 1) == (695, 24)
    assert (extract_dwells(replace(log, others={})).sweep == found.sweep).all()


TENS = range(10, 101, 10)
SWEEPS = {
    'one direction': list(range(-100, 101, 20)),
    'both signs in turn': [0, *(sign * rate for rate in TENS for sign in (1, -1))],
    'rests between': [rate for size in TENS for rate in (0, size)],
    'rests between, both signs in turn': [rate for size in TENS for rate in (0, size, 0, -size)],
    'rests around': [0, *range(-90, 91, 20), 0],
    'two dwells at each rate one way, rests around and in the middle':
        [0, *np.repeat(TENS[:5], 2), 0, *np.repeat(TENS[5:], 2), 0],
}


@pytest.mark.parametrize('sweep', SWEEPS.values(), ids=SWEEPS)
def test_sweeps_are_found_by_the_order_of_the_rates(sweep):
    found = dwells_from_table(table(sweep * 3))
    assert list(found.sweep) == list(np.repeat([0, 1, 2], len(sweep)))
    assert found.remarks[0].startswith('without a column sweep, the 3 sweeps are numbered by the ')


@pytest.mark.parametrize('rates, more, sweeps', [
    ([1, 2, 3, 4], {'sweep': ('cold', 'warm', 'cold', 'warm')}, [0, 1, 0, 1]),
    ([-100, -50, 0, 50, 100, 50, 0, -50, -100], {}, [0] * 5 + [1] * 4),
    (np.random.default_rng(3).permutation(np.linspace(-100.0, 100.0, 90)), {},
     [block for block in range(9) for _ in range(10)])],
    ids=['named by a column', 'where the rates turn back', 'rates in random order'])
def test_sweeps_end_where_a_column_or_the_rates_say(rates, more, sweeps):
    assert list(dwells_from_table(table(rates, others=more)).sweep) == sweeps


def test_rows_without_output_or_reference_are_left_out_and_a_column_gives_deviations():
    log = table([10, 20, math.nan, 40, 50], temperature=np.arange(5.0),
                others={'deviation_dps': ('0.5', 'nan', '1', '1', '0')})
    found = dwells_from_table(replace(log, output=np.where(np.arange(5) == 3, np.nan, log.output)))
    assert found.location == ('row 1', 'row 2', 'row 5')
    assert list(found.temperature) == [0.0, 1.0, 4.0]
    assert found.remarks[0] == '2 rows without output or reference are left out: 3, 4'
    assert found.deviation[0] == pytest.approx(0.5 * DEGREE)
    assert np.isnan(found.deviation[1:]).all()


@pytest.mark.parametrize(('log', 'message'), [
    (Log(counts=np.ones(3), reference_rate=np.ones(3)), 'how many deg/s a count'),
    (Log(output=np.ones(3)), 'reference_rate_dps'),
    (Log(output=np.ones(3), time=np.arange(3.0)), 'reference_heading_deg'),
    (Log(output=np.ones(3), reference_rate=np.full(3, np.nan)), 'none of the 3 rows'),
    (Log(output=np.ones(3), time=np.arange(3.0), reference_rate=np.full(3, np.nan)),
     '0 of 3 samples'),
    (Log(output=np.ones(3), time=np.arange(3.0), reference_heading=np.full(3, np.nan)),
     '0 of 3 samples'),
    (Log(output=np.ones(2), reference_rate=np.ones(2), others={'deviation_dps': ('0.1', 'good')}),
     'good'),
])
def test_a_log_that_lacks_something_is_refused_with_the_remedy(log, message):
    with pytest.raises(DataRefused, match=message):
        extract_dwells(log)


def test_joined_logs_keep_their_sweeps_and_places_apart():
    parts = [extract_dwells(table([33.3, 45.0, 78.0], temperature=np.ones(3)), name)
             for name in ('a.csv', 'b.csv')]
    whole = join_dwells(parts)
    assert list(whole.sweep) == [0, 1, 2, 3, 4, 5]
    assert whole.location[0] == 'a.csv: row 1' and whole.location[3] == 'b.csv: row 1'
    assert len(whole.temperature) == len(whole) == 6
    whole = join_dwells([*parts, replace(parts[1], temperature=None)])
    assert whole.temperature is None and '1 of 3 logs hold no temperature' in whole.remarks[-1]


def references(generator):
    return {'rate': {'reference_rate': RATE}, 'heading': {'reference_heading': HEADING},
            'fine encoder': {'reference_heading': encoder(0.088, generator)},
            'coarse encoder': {'reference_heading': encoder(2.0, generator)}}


@pytest.mark.parametrize('every, sign', [(1, 1.0), (10, 1.0), (100, -1.0)])
@pytest.mark.parametrize('reference', ['rate', 'heading', 'fine encoder', 'coarse encoder'])
def test_every_rate_of_a_table_is_found(reference, every, sign, generator):
    (name, given), = references(generator)[reference].items()
    log = run(generator)
    found = find_dwells(Log(output=sign * log.output[::every], time=TIME[::every],
                            **{name: given[::every]}))
    assert np.allclose(found.rate / DEGREE, RATES, atol=0.01)
    assert (np.abs(errors(replace(found, output=sign * found.output))) < 5.0).all()
    lengths = [float(place.split()[2]) - float(place.split()[0]) for place in found.location]
    ends = 0.04 * (every - 1)  # two samples at each end, s
    assert min(lengths) > 12.5 - ends and np.median(lengths) > 14.0 - ends


@pytest.mark.parametrize('reference', ['rate', 'fine encoder'])
def test_the_means_scatter_as_they_claim_under_white_noise(reference, generator):
    found = np.concatenate([errors(find_dwells(run(generator, **references(generator)[reference])))
                            for _ in range(12)])
    low, high = rms_bounds(len(found))
    assert low < np.sqrt(np.mean(found ** 2)) < high
    held = np.sum(np.abs(found) < 1.96)
    assert fewest(len(found), 0.95) <= held <= most(len(found), 0.95)


@pytest.mark.parametrize('reference', ['rate', 'fine encoder'])
@pytest.mark.parametrize(('late', 'lag'), [(2, 0.1), (-5, 0.0), (5, 0.0), (0, 0.3)])
def test_neither_ramps_nor_the_settling_of_the_gyro_get_into_the_means(
        reference, late, lag, generator):
    keep = math.exp(-0.01 / lag) if lag else 0.0
    rate = lfilter([1.0 - keep], [1.0, -keep], np.roll(RATE, late))
    found = find_dwells(run(generator, 0.002, rate, **references(generator)[reference]))
    assert len(found) == len(RATES)
    assert np.sqrt(np.mean(errors(found) ** 2)) < 1.5


@pytest.mark.parametrize('step', [0.0, 0.088, 2.0])
def test_a_table_that_vibrates_and_rings_gives_its_dwells_all_the_same(step, generator):
    keep = math.exp(-0.1 * 2.0 * math.pi * 3.0 * 0.01)
    answer = [1.0, -2.0 * keep * math.cos(2.0 * math.pi * 3.0 * 0.01), keep ** 2]
    rate = (lfilter([sum(answer)], answer, RATE)
            + 20.0 * DEGREE * np.sin(2.0 * math.pi * 7.3 * TIME) * (RATE != 0.0))
    heading = np.concatenate([[0.0], np.cumsum(0.005 * (rate[1:] + rate[:-1]))])
    given = {'reference_heading': encoder(step, generator, heading)} if step else {
        'reference_rate': rate}
    found = find_dwells(run(generator, rate=rate, **given))
    assert np.allclose(found.rate / DEGREE, RATES, atol=0.1)
    assert (np.abs(errors(found)) < 5.0).all()


@pytest.mark.parametrize('reference', ['rate', 'fine encoder'])
def test_a_reference_that_is_slower_than_the_gyro_is_enough_and_only_true_losses_are_reported(
        reference, generator):
    log = run(generator, **references(generator)[reference])
    quantity = 'reference_rate' if reference == 'rate' else 'reference_heading'
    given = np.where(np.arange(len(TIME)) % 5 == 0, getattr(log, quantity), np.nan)
    given[25000:25040] = np.nan
    found = find_dwells(replace(log, **{quantity: given}))
    assert len(found) == len(RATES) and (np.abs(errors(found)) < 5.0).all()
    assert [remark for remark in found.remarks if 'lost' in remark] == [
        'the reference was lost once, for 44 samples, at 249.96 s; they are left out']


@pytest.mark.parametrize('reference', ['rate', 'fine encoder'])
def test_outliers_repeated_and_lost_samples_are_reported_and_left_out(reference, generator):
    log = run(generator, **references(generator)[reference])
    output, given = log.output.copy(), next(iter(references(generator)[reference].values())).copy()
    output[[500, 9000, 9001]] += 500.0 * DEGREE
    output[12000:12080] = output[12000] = SCALE * RATE[12000] + BIAS + 0.4 * DEGREE
    given[25000:25040] = np.nan
    kept = np.ones(len(TIME), dtype=bool)
    kept[30000:30007] = False
    quantity = 'reference_rate' if reference == 'rate' else 'reference_heading'
    found = find_dwells(
        replace(log, **{'output': output[kept], 'time': TIME[kept], quantity: given[kept]}))
    said = ' '.join(found.remarks)
    assert len(found) == len(RATES) and (np.abs(errors(found)) < 5.0).all()
    assert 'outliers, left out: 3, at 5.00 s, 90.00 s, 90.01 s' in said
    assert 'repeated once, at 120.01 s (79 samples)' in said
    assert 'lost once, for 40 samples, at 250.00 s' in said


def test_a_dwell_that_warms_is_divided(generator):
    still = np.zeros(len(TIME))
    warm = find_dwells(run(generator, rate=still, reference_rate=still,
                           temperature=25.0 + TIME / 60.0))
    steady = find_dwells(run(generator, rate=still, reference_rate=still,
                             temperature=25.0 + 0.2 * np.sin(TIME / 60.0)))
    assert len(steady) == 1
    assert (5 <= len(warm) <= 7 and np.ptp(warm.temperature) > 4.0
            and 'divided' in ' '.join(warm.remarks))


@pytest.mark.parametrize('rate', [1.0, 0.3, None])
def test_a_log_that_swings_or_is_noise_is_refused_with_the_other_way(rate, generator):
    if rate is None:
        swing = generator.standard_normal(len(TIME)) * 10.0 * DEGREE
        heading = np.cumsum(swing) / 20.0
    else:
        swing = 45.0 * DEGREE * np.sin(rate * TIME)
        heading = 45.0 * DEGREE / rate * np.cos(rate * TIME)
    for reference in ({'reference_rate': swing}, {'reference_heading': heading},
                      {'reference_heading': encoder(2.0, generator, heading)}):
        with pytest.raises(DataRefused, match='straight line to 0.5 deg.*--method likelihood'):
            find_dwells(run(generator, rate=swing, **reference))


def test_a_limit_that_two_speeds_do_not_distinguish_from_an_effect_is_one_without_noise():
    rates = np.array([0.0, 100.0, 200.0, 0.0, -100.0, -200.0, 0.0]) * DEGREE
    output = np.repeat(1.002 * rates, 1000)
    output += 0.02 * DEGREE * np.random.default_rng(1).standard_normal(len(output))
    found = extract_dwells(Log(
        time=np.arange(len(output)) * 0.01, reference_rate=np.repeat(rates, 1000),
        output=np.clip(output, -185.0 * DEGREE, 185.0 * DEGREE)))
    assert np.abs(found.rate).max() == pytest.approx(100.0 * DEGREE)
    assert 'at the limit' in ' '.join(found.remarks)


@pytest.mark.parametrize('low', [-1000.0, -80.0, -60.0])
def test_a_table_at_a_limit_in_one_sense_or_at_two_that_differ_leaves_those_dwells_out(low):
    sweep = np.array([0.0, *(sign * rate for rate in (20, 40, 60, 90) for sign in (1, -1))])
    rate = np.tile(sweep, 3) * DEGREE
    output = 1.01 * rate + 0.01 * DEGREE * np.random.default_rng(4).standard_normal(len(rate))
    found = extract_dwells(Log(reference_rate=rate, output=np.clip(
        output, low * DEGREE, 70.0 * DEGREE)))
    assert (found.rate.max() / DEGREE, found.rate.min() / DEGREE) == pytest.approx(
        (60.0, {-1000.0: -90.0, -80.0: -60.0, -60.0: -40.0}[low]))
    assert 'at the limit' in found.remarks[0]


def test_the_step_of_rounded_codes_is_that_of_the_output_where_each_dwell_is_on_one_code(
        generator):
    step = 0.1537456 * DEGREE
    log = run(generator, 0.001)
    codes = np.round(log.output / step) * step
    found = find_dwells(replace(log, output=np.round(codes / DEGREE, 5) * DEGREE))
    assert np.median([np.ptp(log.output[rows]) for rows in found.rows]) < step
    assert found.rounding.max() == pytest.approx(step / math.sqrt(12.0), rel=1e-3)
    assert rms(errors(found)) < 1.5


def test_samples_a_few_steps_off_are_no_outliers_beside_a_noisy_reference_rate(generator):
    step, rate = 0.6 * DEGREE, RATE + 0.005 * DEGREE * generator.standard_normal(len(RATE))
    log = run(generator, 0.03, reference_rate=rate)
    found = find_dwells(replace(log, output=step * np.round(log.output / step)))
    assert 'outliers' not in ' '.join(found.remarks)


@pytest.mark.parametrize('count', [3, 6])
def test_the_step_of_a_table_is_not_that_of_the_digits_of_its_rates(count):
    rate = np.round(np.tile(np.linspace(-250.0, 250.0, 2 * count + 1), 8), 4) * DEGREE
    step = 0.6 * DEGREE
    found = dwells_from_table(Log(reference_rate=rate, output=step * np.round(
        (1.0062 * rate + 0.14 * DEGREE) / step)))
    assert found.rounding == pytest.approx(step / math.sqrt(12.0))


def test_a_turntable_that_swings_at_one_speed_gives_dwells_of_both_signs(data):
    found = find_dwells(read_log(data / 'mems_encoder_turntable' / 'yaw_slow.csv.gz'))
    assert len(found) > 350 and abs(np.sign(found.rate).sum()) < 10
    scale, _ = np.polyfit(found.rate, found.output, 1)
    assert scale == pytest.approx(-1.006, abs=0.002)
