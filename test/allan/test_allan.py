# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Allan deviation and its noise figures, against definitions, simulated truth and recordings."""

import json
import math
import re

from chance import evidence, fewest, mean_bound, most, rms_bounds
from gyro_calibration.allan.deviation import allan_deviation, build_rest_record
from gyro_calibration.allan.noise_fit import fit_noise
from gyro_calibration.cli.allan import find_noise_figures
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log, write_log
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.noise import ALLAN_FLOOR_RATIO, Noise, NOISE_TERMS, simulate_noise
import numpy as np
import pytest
from scipy.signal import lfilter

INTERVAL = 0.01
WHITE = Noise(1e-3)
FLICKER = Noise(1e-3, 1e-3)
WALK = Noise(1e-3, 0.0, 5e-4)


def textbook(rate, size):
    """Return the overlapping Allan deviation by the definition of IEEE Std 952."""
    means = np.array([rate[start:start + size].mean() for start in range(len(rate) - size + 1)])
    return math.sqrt(0.5 * np.mean((means[size:] - means[:-size]) ** 2))


@pytest.mark.parametrize('samples', [100, 1001, 40000])
def test_the_deviation_is_the_textbooks(samples):
    generator = np.random.default_rng(952)
    rate = (3.0 + np.cumsum(generator.standard_normal(samples))
            + 30.0 * generator.standard_normal(samples))
    chart = allan_deviation(rate, INTERVAL)
    chosen = slice(None) if samples < 2000 else slice(None, None, 9)
    np.testing.assert_allclose(chart.deviation[chosen],
                               [textbook(rate, size) for size in chart.size[chosen]], rtol=1e-9)
    assert chart.time[-1] == pytest.approx(samples // 3 * INTERVAL) and len(chart.size) >= 13
    assert allan_deviation(rate, INTERVAL, [0.5, 0.01]).time.tolist() == [0.01, 0.5]
    assert (chart.difference_count == samples + 1 - 2 * chart.size).all()


def test_the_bounds_of_the_deviation_hold_in_95_of_100_records():
    generator, runs, times = np.random.default_rng(3), 400, [0.01, 0.04, 0.16, 0.64, 2.56]
    charts = [allan_deviation(simulate_noise(WHITE, 2000, INTERVAL, generator), INTERVAL, times)
              for _ in range(runs)]
    true = WHITE.angle_random_walk / np.sqrt(times)
    held = np.sum([(chart.lower <= true) & (true <= chart.upper) for chart in charts], axis=0)
    # at the longest time one in three records shows a wrong slope
    assert ((fewest(runs, 0.95) <= held[:4]) & (held[:4] <= most(runs, 0.95))).all(), held
    assert fewest(runs, 0.9) <= held[4] <= most(runs, 0.97), held


def figures(noise, runs, seed, samples=20_000, quantization=0.0, ramp=0.0):
    """Return the figures of simulated records, by symbol."""
    generator = np.random.default_rng(seed)
    fits = []
    for _ in range(runs):
        rate = (simulate_noise(noise, samples, INTERVAL, generator)
                + ramp * INTERVAL * np.arange(samples))
        fits.append(fit_noise(rate + np.diff(generator.standard_normal(samples + 1)) * quantization
                              / INTERVAL, INTERVAL).figures)
    return {part.symbol: [fit[part.symbol] for fit in fits] for part in NOISE_TERMS}


@pytest.mark.parametrize('walk, runs', [(2e-4, 12), evidence(3e-5, 200), evidence(2e-4, 200)])
def test_the_bounds_hold_where_flicker_and_random_walk_hide_each_other(walk, runs):
    truth = Noise(1e-3, 3e-4, walk)
    found = figures(truth, runs, 11, samples=200_000)
    for symbol, true in zip('NBK', vars(truth).values()):
        held = sum(figure.lower <= true <= figure.upper for figure in found[symbol])
        assert held >= fewest(runs, 0.95), (symbol, held)


@pytest.mark.parametrize('noise, quantization, ramp', [
    (WHITE, 0.0, 0.0), (WALK, 0.0, 0.0), (WHITE, 3e-5, 0.0), evidence(FLICKER, 0.0, 0.0),
    evidence(WHITE, 0.0, 1e-4)], ids=['white', 'walk', 'quantization', 'flicker', 'ramp'])
def test_what_is_there_is_seen_within_its_bounds_and_its_standard_deviation(
        noise, quantization, ramp):
    runs, found = 30, figures(noise, 30, 4, quantization=quantization, ramp=ramp)
    truths = dict(zip('NBKQR', (noise.angle_random_walk, noise.bias_instability,
                                noise.rate_random_walk, quantization, ramp)))
    for symbol, truth in truths.items():
        seen = [figure for figure in found[symbol] if figure.value > 0.0]
        assert (len(seen) >= fewest(runs, 0.95) if truth
                else len(seen) <= most(runs, 0.05)), (symbol, len(seen))
        held = sum(figure.lower <= truth <= figure.upper for figure in found[symbol])
        assert held >= fewest(runs, 0.95), (symbol, held)
        # One record has one ramp: it scatters by white noise alone, far less than its bounds.
        if truth and symbol != 'R':
            ratio = (np.std([figure.value for figure in seen])
                     / np.median([figure.standard_deviation for figure in seen]))
            low, high = rms_bounds(len(seen) - 1)
            assert 0.9 * low < ratio < 1.1 * high, (symbol, ratio)


def test_a_gauss_markov_process_is_found_and_a_flicker_or_random_walk_is_not_taken_for_one():
    generator, kept, found = np.random.default_rng(8), math.exp(-0.01 / 20.0), []
    for _ in range(5):
        shocks = 1e-3 * math.sqrt(1.0 - kept ** 2) * generator.standard_normal(200_000)
        fit = fit_noise(simulate_noise(WHITE, 200_000, 0.01, generator)
                        + lfilter([1.0], [1.0, -kept], shocks), 0.01)
        found.append((fit.process.standard_deviation, fit.process.correlation_time))
        assert fit.figures['K'].lower == 0.0
        assert fit.figures['N'].value == pytest.approx(1e-3, rel=0.02)
    assert np.median(found, axis=0) == pytest.approx((1e-3, 20.0), rel=0.5)
    for noise in (Noise(1e-3, 3e-4), Noise(1e-3, 0.0, 1e-4)):
        assert fit_noise(simulate_noise(noise, 200_000, 0.01, generator), 0.01).process is None


@pytest.mark.parametrize('numerator, denominator',
                         [([0.25, 0.5, 0.25], [1.0]), ([0.3], [1.0, -0.7])],
                         ids=['mean of three', 'lag'])
def test_a_filter_of_the_output_does_not_bias_the_angle_random_walk(numerator, denominator):
    generator = np.random.default_rng(7)
    fits = [fit_noise(lfilter(numerator, denominator,
                              simulate_noise(WHITE, 50_000, INTERVAL, generator)), INTERVAL)
            for _ in range(10)]
    walks = [fit.figures['N'].value for fit in fits]
    off = np.array(walks) - 1e-3
    assert abs(np.mean(off)) < mean_bound(off) < 1e-4
    false = sum(any(fit.figures[symbol].value for symbol in 'BKQR') for fit in fits)
    assert false <= most(10, 0.05)


def test_a_record_that_is_too_short_for_the_floor_says_so_and_bounds_the_bias_instability():
    generator = np.random.default_rng(9)
    short, long = (fit_noise(simulate_noise(Noise(1e-3, 3e-4), count, INTERVAL, generator),
                             INTERVAL) for count in (2000, 200_000))
    assert (not short.is_floor_reached and not short.figures['B'].value
            and short.figures['B'].upper > 3e-4)
    assert (long.is_floor_reached
            and long.chart.floor['deviation'] == pytest.approx(ALLAN_FLOOR_RATIO * 3e-4, rel=0.4))


def stamps(count):
    return INTERVAL * np.arange(count)


@pytest.mark.parametrize('gap, longest', [(0, 50.0), (1000, 5.0)])
def test_lost_samples_are_counted_and_do_not_change_the_figures(gap, longest):
    generator = np.random.default_rng(10)
    rate = simulate_noise(WHITE, 100_000, INTERVAL, generator)
    kept = generator.random(100_000) > 0.001
    kept[50_000:50_500] = False
    kept[np.abs(np.arange(100_000) % 2500 - 1200) < 0.5 * gap] = False
    kept[[0, -1]] = True
    record = build_rest_record(
        stamps(100_000)[kept] + 0.0005 * generator.random(kept.sum()), rate[kept])
    assert (np.isnan(record.rate).sum() == (~kept).sum()
            and f'{(~kept).sum()} samples are lost' in record.remarks[0])
    np.testing.assert_array_equal(record.rate[kept], rate[kept])
    assert record.interval == pytest.approx(INTERVAL, rel=1e-6)
    assert fit_noise(record.rate, record.interval).figures['N'].value == pytest.approx(
        1e-3, rel=0.02)
    times = [0.01, 0.1, 1.0, longest]
    np.testing.assert_allclose(*(allan_deviation(each, INTERVAL, times).deviation
                                 for each in (record.rate, rate)), rtol=0.05)


def bursts(count):
    """Return stamps of packets of five that come when the host gets to it, up to 0.2 s late."""
    generator = np.random.default_rng(12)
    late = np.repeat(
        0.05 * generator.random(count // 5) + 0.15 * (generator.random(count // 5) < 0.002), 5)
    arrival = np.maximum.accumulate(np.repeat(stamps(count)[4::5], 5) + late)
    return arrival + 0.0002 * np.arange(count) / 5 % 0.001 + 1e-9 * np.arange(count)


def test_stamps_in_bursts_give_the_interval_of_the_gyro():
    time = np.sort(bursts(50_000))
    rate = simulate_noise(WHITE, 50_000, INTERVAL, np.random.default_rng(13))
    record = build_rest_record(time, rate)
    assert record.interval == pytest.approx(INTERVAL, rel=1e-4) and 'bursts' in record.remarks[0]
    np.testing.assert_array_equal(record.rate, rate)
    gap = np.delete(np.arange(50_000), np.s_[20_000:20_500])
    assert abs(np.isnan(build_rest_record(time[gap], rate[gap]).rate).sum() - 500) <= 10


def moved(kind):
    rate = simulate_noise(WHITE, 50_000, INTERVAL, np.random.default_rng(14))
    generator = np.random.default_rng(15)
    time = stamps(50_000)
    return {'turn': (time, rate + 0.02 * ((time > 200.0) & (time < 230.0))),
            'jolt': (time, rate + 0.2 * np.sin(40.0 * time) * ((time > 200.0) & (time < 200.5))),
            'swing': (time[:6000], (rate + np.sin(time))[:6000]),
            'dead': (time, np.full(50_000, 0.01)),
            'dies': (time, np.where(time > 400.0, 0.01, rate)),
            'few': (time[:99], rate[:99]),
            'lost': (time, np.where(generator.random(50_000) < 0.5, np.nan, rate)),
            'tatters': (time + 5.0 * np.cumsum(generator.random(50_000) < 0.015), rate),
            'uneven': (np.cumsum(0.006 + 0.008 * generator.random(50_000)
                                 + 0.05 * np.sin(time / 80.0) ** 2), rate)}[kind]


@pytest.mark.parametrize(
    'kind, said',
    [('turn', r'moved.*from (19|20)\d\.\d+ s on.*at rest, from 2[23]\d.*to 499.9'),
     ('jolt', r'moved.*from (199|200)\.\d+ s on'), ('swing', 'the record contains something'),
     ('dead', 'same value 50000 times'), ('dies', 'same value 9999 times'),
     ('tatters', r'10 ms apart.*--rate'), ('few', '99 samples.*at least 100'),
     ('lost', 'wanted 4 octaves.*without losses'), ('uneven', 'no even interval.*--rate')])
def test_what_is_no_record_at_rest_is_refused_with_the_reason(kind, said):
    with pytest.raises(DataRefused, match=said):
        record = build_rest_record(*moved(kind))
        fit_noise(record.rate, record.interval)


@pytest.mark.parametrize('step', [1.0, 2.07, 4.0])
def test_steps_of_the_output_are_no_motion(step):
    """The steps are given in standard deviations of a sample."""
    time, noise = stamps(300_000), np.random.default_rng(27).standard_normal(300_000)
    coarse = step * np.round(noise / step)
    assert build_rest_record(time, coarse).rate.std() > 0.0
    with pytest.raises(DataRefused, match='moved'):
        build_rest_record(time, coarse + 3.0 * step * (time > 700.0))


def test_the_part_at_rest_that_is_proposed_is_accepted(tmp_path, run):
    time, rate = stamps(20_000), simulate_noise(WHITE, 20_000, INTERVAL,
                                                np.random.default_rng(24))
    rate += np.where((time > 20.0) & (time < 30.0), np.sin(time), 0.0)
    write_log(log := tmp_path / 'log.csv', Log(time=1000.0 + time, output=rate))
    refusal = run('allan', log)[2].replace('\n', ' ')
    begin, end = re.search(r'at rest, from ([\d.]+) to ([\d.]+) s, or', refusal).groups()
    assert 30.0 <= float(begin) < 35.0 and float(end) == pytest.approx(199.9, abs=0.11)
    assert run('allan', log, '--from', begin, '--to', end)[0] == 0


def test_a_fit_without_noise_is_refused():
    with pytest.raises(DataRefused, match='lowest Allan deviation 0 rad/s'):
        fit_noise(np.ones(1000), INTERVAL)


def test_an_outlier_is_left_out_and_a_random_walk_of_the_bias_is_no_motion():
    rate = simulate_noise(Noise(1e-3, 3e-4, 3e-4), 50_000, INTERVAL, np.random.default_rng(16))
    rate[[700, 30_000]] += 0.5, -2.0
    record = build_rest_record(stamps(50_000), rate)
    assert (np.nonzero(np.isnan(record.rate))[0].tolist() == [700, 30_000]
            and 'left out: 2 single samples' in record.remarks[0])
    assert not build_rest_record(
        stamps(50_000),
        simulate_noise(Noise(0.0, 0.0, 1e-3), 50_000, INTERVAL, np.random.default_rng(20))).remarks


def test_a_reference_that_turns_with_the_output_shows_motion_and_one_that_wanders_does_not():
    """A record that moves all the time sets its own scale, as a car on a straight road does."""
    generator = np.random.default_rng(23)
    time, count = stamps(10_000), 10_000
    turns = lfilter([0.02 * math.sqrt(2e-2)], [1.0, -0.99], generator.standard_normal(count))
    rate = simulate_noise(WALK, count, INTERVAL, generator) + turns
    assert len(build_rest_record(time, rate).rate) == count
    course = INTERVAL * np.cumsum(turns) + 0.5 * DEGREE * generator.standard_normal(count)
    with pytest.raises(DataRefused, match='the reference heading turns with the output'):
        build_rest_record(time, rate, heading=course)
    for _ in range(20):
        rate = simulate_noise(WALK, count, INTERVAL, generator)
        wandering = np.cumsum(1e-3 * generator.standard_normal(count))
        assert len(build_rest_record(time, rate, heading=wandering).rate) == count


@pytest.mark.parametrize('number', [1, evidence(2), evidence(3)])
def test_recordings_of_one_kind_of_gyro_agree(data, number):
    """ADIS16405, data sheet: 2 deg/√h and 0.007 deg/s, typical; 0.01 to 0.1 s are filtered."""
    log = read_log(data / f'mems_static/adis16405_{number}.csv.gz', rate=100.0)
    record = build_rest_record(log.time, log.output)
    assert not record.remarks and record.interval == pytest.approx(0.01)
    fit = fit_noise(record.rate, record.interval)
    assert fit.figures['N'].value / DEGREE * 60.0 == pytest.approx(2.3, abs=0.1)
    assert 0.006 < fit.chart.floor['deviation'] / DEGREE < 0.012
    assert fit.is_floor_reached and not fit.misfit
    assert fit.figures['B'].value / DEGREE == pytest.approx(0.008, rel=0.4)
    assert not any(fit.figures[symbol].value for symbol in 'QR')


def test_the_verb_says_the_figures_and_puts_them_into_a_model_that_loses_nothing_else(
        tmp_path, run):
    """The bias instability is that of the fit, which has no N and K: a model adds them itself."""
    log, old, new = (tmp_path / name for name in ('rest.csv', 'old.yaml', 'new.yaml'))
    write_log(log, Log(stamps(20_000), simulate_noise(FLICKER, 20_000, INTERVAL,
                                                      np.random.default_rng(18))))
    old.write_text(
        'effects: {bias: {bias: 0.01}, scale_factor_error: {scale_factor_error: -0.1}}\n'
        'covariance: [[1, 0], [0, 2]]\n'
        'valid: {rate: [-2, 2], temperature: [10, 50]}\nnoise: {rate_random_walk: 1.0}\n'
        'gyro: {name: x}\norigin: {files: [a]}\n'
        'self_calibration: {scale_factor_error: 0.01, bias: 0.02}\n')
    code, text, _ = run('allan', log)
    # 1e-3 rad/√s is 3.44 deg/√h
    assert (code == 0 and 'Angle random walk N: 3.4' in text and 'deg/√h, 95 %:' in text
            and 'rad/√s' in text and 'Rate random walk K: ' in text and 'deg/h/√h' in text)
    answer = json.loads(run('allan', log, '--model', old, '--out', new, '--json')[1])
    walk = answer['angle_random_walk']
    assert walk['lower'] < walk['value'] < walk['upper'] and answer['samples'] == 20_000
    assert walk['value'] == pytest.approx(1e-3, rel=0.05)
    assert all((answer[name]['value'] == 0.0) == (answer[name]['standard_deviation'] is None)
               for name in ('angle_random_walk', 'rate_random_walk', 'rate_ramp'))
    assert (len({len(values) for values in answer['chart'].values()}) == 1
            and answer['interval_s'] == pytest.approx(INTERVAL))
    value = answer['bias_instability']['value']
    assert value != pytest.approx(answer['floor']['deviation'] / ALLAN_FLOOR_RATIO, rel=0.05)
    assert f'Bias instability B: {value / DEGREE * 3600.0:.4g} deg/h,' in text
    legend = find_noise_figures(read_log(log)).plot().axes[0].get_legend().get_texts()
    assert any(f'B = {value / DEGREE * 3600.0:.3g} deg/h' in each.get_text() for each in legend)
    before, after = read_model(old), read_model(new)
    assert vars(after.noise) == {name: answer[name]['value'] for name in vars(after.noise)}
    assert after.noise_bounds['angle_random_walk'] == (walk['lower'], walk['upper'])
    other = {'noise': 0, 'covariance': 0, 'noise_bounds': 0}
    assert {**vars(after), **other} == {**vars(before), **other}
    assert (after.covariance == before.covariance).all()
