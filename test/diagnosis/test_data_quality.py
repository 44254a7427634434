# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Quality of data: faults of stated sizes are found, good records pass, useless are refused."""

from dataclasses import replace
import math
import re

from chance import fewest, most, seeded
from diagnosed import log_of
from gyro_calibration.diagnosis.data_quality import FALSE_ALARM_CHANCE, inspect_record
from gyro_calibration.diagnosis.gates import (
    check_gates, examine_log, identify_unit_factor, refuse_unusable, UNIT_FACTORS)
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log
from gyro_calibration.logs.quality import encoder_step
from gyro_calibration.logs.stamps import fit_stamp_grid
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration_bench.hidden.log import hide
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

INTERVAL = 0.01
WHITE = Noise(1e-4)
SIGMA = 1e-4 / math.sqrt(INTERVAL)


@pytest.fixture
def generator(request):
    return seeded(request.node.name)


@pytest.fixture(params=['', pytest.param('another seed', marks=pytest.mark.evidence)])
def any_generator(request):
    """Return the same random numbers in each run, or, as evidence, others."""
    return seeded(request.node.name, bool(request.param))


def swing(generator, count=6000, noise=WHITE, scale=1.01, offset=2e-3):
    """Return a log of a gyro that swings and rests, 100 samples a second."""
    time = np.arange(count) * INTERVAL
    rate = np.sin(
        0.9 * time + generator.uniform(0.0, 6.0)) * np.clip(3.0 * np.sin(0.11 * time), 0.0, 1.0)
    return Log(output=scale * rate + offset + simulate_noise(noise, count, INTERVAL, generator),
               time=time, reference_rate=rate)


def found(log, model=None):
    return {finding.effect: finding for finding in inspect_record(log, model).findings}


def value(finding):
    return finding.parameters[finding.effect].estimate


def printed(values, decimals):
    """Return what is left of values that were written in deg and read again."""
    return np.round(values / DEGREE, decimals) * DEGREE


def in_print(log):
    return replace(log, output=printed(log.output, 5))


def coarse(log, step):
    return replace(log, output=np.round(log.output / step) * step)


def zeroed(log, within):
    """Return the log of a driver that gives zero for small rates."""
    return replace(log, output=np.where(np.abs(log.output) < within, 0.0, log.output))


def late(log, generator):
    """Return a log with stamps that a host gave when it got to it."""
    stamps = log.time + generator.exponential(0.1 * INTERVAL, len(log))
    return replace(log, time=np.sort(stamps))  # none is given before an earlier one


CLEAN = {'white': lambda generator: swing(generator),
         'walk and flicker': lambda generator: swing(generator, noise=Noise(1e-4, 3e-5, 1e-5)),
         'in print': lambda generator: in_print(swing(generator)),
         'fine codes': lambda generator: coarse(swing(generator), 0.1 * SIGMA),
         'at rest': lambda generator: replace(swing(generator, scale=0.0), reference_rate=None,
                                              moving=np.zeros(6000)),
         'late stamps': lambda generator: late(swing(generator), generator)}


#: Rate of false alarms that is stated for a log, by five checks.
STATED = 5 * FALSE_ALARM_CHANCE


@pytest.mark.parametrize('logs', [30, pytest.param(300, marks=pytest.mark.evidence)])
@pytest.mark.parametrize('kind', CLEAN)
def test_a_clean_log_has_false_alarms_as_seldom_as_stated(kind, logs, any_generator):
    assert STATED <= 1e-3
    alarms = [name for _ in range(logs) for name in found(CLEAN[kind](any_generator))]
    assert len(alarms) <= most(logs, STATED), alarms


@pytest.mark.parametrize('name', ['bandwidth', 'time_offset', 'cubic_nonlinearity',
                                  'interference_tone', 'reference_slip', 'bias_step'])
def test_a_large_effect_of_the_gyro_brings_no_fault_of_the_record(name, any_generator):
    logs = [log_of(hide([name], 50.0, any_generator, reference=reference, duration=120.0)[0])
            for reference in ('rate', 'heading')]
    assert sum(bool(found(log)) for log in logs) <= most(2, STATED)


FAULTS = ['outliers', 'stuck_samples', 'dropped_samples', 'quantization', 'reference_quantization']


@pytest.mark.parametrize('multiple', [1.2, 5.0])
@pytest.mark.parametrize('name', FAULTS)
def test_a_hidden_fault_is_found_alone(name, multiple, any_generator):
    hidden = [hide([name], multiple, any_generator, reference=reference, duration=200.0)[0]
              for reference in ('rate', 'heading') * 3]
    assert sum(list(found(log_of(each))) == [name] for each in hidden) >= fewest(6, 1.0 - STATED)


@pytest.mark.parametrize('place', [0, 1, 2, -2, -1])
def test_an_outlier_at_an_end_of_the_log_is_found(place, generator):
    log = swing(generator)
    log.output[place] += 90.0
    assert not inspect_record(log).usable[place] and 'outliers' in found(log)


def with_motion(log, rate, reference):
    """Return the log of another motion, with a rate or a heading as its reference."""
    output = log.output + 1.01 * (rate - log.reference_rate)
    heading = (cumulative_trapezoid(rate, log.time, initial=0.0) if reference == 'heading'
               else None)
    return replace(log, output=output, reference_heading=heading,
                   reference_rate=None if heading is not None else rate)


def ending_in_motion(log, generator):
    """Return a log that ends in motion, where the rate of a heading is less well known."""
    return with_motion(log, np.sin(6.0 * (log.time - log.time[-1])), 'heading')


def with_corners(log, generator):
    """Return a log with corners and a step of its rate, which a heading does not resolve."""
    corners = np.cumsum(generator.uniform(2.0, 4.0, 15))
    rate = np.interp(log.time, corners, np.arange(15) % 2 * 3.0)
    return with_motion(log, rate + 4.0 * np.maximum(log.time % 30.0 - 29.5, 0.0), 'heading')


@pytest.mark.parametrize('moved', [ending_in_motion, with_corners])
def test_what_motion_and_its_reference_do_is_no_outlier(moved, any_generator):
    logs = [moved(swing(any_generator), any_generator) for _ in range(8)]
    assert sum('outliers' in found(log) for log in logs) <= most(8, STATED)


def test_an_outlier_of_the_reference_is_not_blamed_on_the_gyro(generator):
    log = swing(generator)
    log.reference_rate[generator.choice(np.arange(20, 5980), 8, replace=False)] += 30.0 * SIGMA
    assert 'outliers' not in found(log)


def test_repeated_samples_of_exact_values_are_found_and_left_out(generator):
    log = swing(generator)
    log.output[1000:1003] = log.output[999]
    quality = inspect_record(log)
    assert ([finding.effect for finding in quality.findings] == ['stuck_samples']
            and value(quality.findings[0]) == 3.0)
    assert not quality.usable[1000:1003].any() and quality.usable[999] and quality.usable[1003]


@pytest.mark.parametrize('step', [0.3, 1.0, 3.0, 30.0])
def test_samples_that_quantization_repeats_are_no_repeated_samples(step, generator):
    assert list(found(coarse(swing(generator), step * SIGMA))) == ['quantization']


@pytest.mark.parametrize('digits', [3, 4])
def test_codes_that_grow_with_their_values_are_no_repeated_samples(digits, generator):
    log = swing(generator, scale=4.0)
    written = np.array([float(f'{each:.{digits}g}') for each in (log.output / DEGREE).tolist()])
    assert 'stuck_samples' not in found(replace(
        log, output=written * DEGREE, reference_rate=4.0 * log.reference_rate))


def robot(generator, step=0.0):
    """Return a log without a reference of a robot that turns and rests, 20 samples a second."""
    rate = np.repeat(np.where(np.arange(160) % 2, generator.normal(0.0, 0.6, 160), 0.0), 30)
    window = np.hanning(10)[1:-1]
    rate = np.convolve(rate, window / window.sum(), 'same')
    moving = np.convolve(np.abs(rate) > 0.0, np.ones(20) / 20.0, 'same')
    noise = np.hypot(5e-4, 0.01 * moving) * generator.standard_normal(len(rate))
    output = rate + noise + 2e-3
    return Log(output=np.round(output / step) * step if step else output,
               time=0.05 * np.arange(len(rate)))


@pytest.mark.parametrize('step', [0.05 * DEGREE, 0.1 * DEGREE, 0.3 * DEGREE])
def test_a_coarse_output_that_stands_in_rests_is_not_stuck(step, any_generator):
    logs = [robot(any_generator, step) for _ in range(5)]
    assert sum('stuck_samples' in found(log) for log in logs) <= most(5, STATED)


@pytest.mark.parametrize('step', [0.0, 1e-4])
def test_stuck_samples_are_found_without_a_reference_where_noise_shows(step, generator):
    log = robot(generator, step)
    for first in (645, 1120, 3300):
        log.output[first:first + 8] = log.output[first]
    assert value(found(log)['stuck_samples']) == pytest.approx(21.0, abs=1.0)


def test_a_limit_that_two_turns_reach_is_found_without_a_reference(generator):
    log = robot(generator)
    fastest = np.sort(np.abs(log.output[15::30]))[-3:]
    limit = 0.5 * (fastest[0] + fastest[1])
    clipped = found(replace(log, output=np.clip(log.output, -limit, limit)))
    assert value(clipped['saturation']) == limit and 'stuck_samples' not in clipped


@pytest.mark.parametrize('ways', [1, 2])
@pytest.mark.parametrize('within', [1.0, 3.0, 10.0, 50.0])
def test_a_dead_band_is_no_fault_of_the_record(within, ways, any_generator):
    logs = [swing(any_generator) for _ in range(5)]
    logs = logs if ways == 2 else [replace(log, output=np.abs(log.output),
                                           reference_rate=np.abs(log.reference_rate))
                                   for log in logs]
    records = [inspect_record(zeroed(log, within * SIGMA)) for log in logs]
    assert (sum(bool(record.findings) for record in records) <= most(5, STATED)
            and all(record.usable.mean() > 0.99 for record in records))


@pytest.mark.parametrize('low, high', [(-0.8, 0.8), (-math.inf, 0.7), (-0.9, math.inf)])
def test_a_limit_is_found_on_the_sides_that_have_one(low, high, generator):
    log = swing(generator)
    quality = inspect_record(replace(log, output=np.clip(log.output, low, high)))
    assert ([finding.effect for finding in quality.findings] == ['saturation']
            and quality.limit == min(-low, high))
    beyond = (log.output > high) | (log.output < low)
    assert (not quality.usable[beyond].any()
            and quality.usable[np.abs(log.reference_rate) < 0.6].all())


def test_quantization_and_saturation_of_the_model_are_no_findings(generator):
    from gyro_calibration.model.effects import CATALOGUE
    log = swing(generator)
    output = np.clip(np.round(log.output / SIGMA) * SIGMA, -600 * SIGMA, 600 * SIGMA)
    terms = (Term(CATALOGUE['quantization'], (SIGMA,)),
             Term(CATALOGUE['saturation'], (600 * SIGMA,)))
    assert not found(replace(log, output=output), GyroModel(terms))
    assert list(found(replace(log, output=output))) == ['quantization', 'saturation']


@pytest.mark.parametrize('name', [name for name, factor in UNIT_FACTORS.items()
                                  if 1e-2 < abs(factor) < 100.0])
def test_a_wrong_unit_is_named(name, generator):
    log = swing(generator, scale=1.0)
    log = replace(log, output=log.output * UNIT_FACTORS[name])
    (found,) = ([each for each in check_gates(log) if each.passed is False]
                or inspect_record(log).findings)
    assert (f'and {name} is' in found.evidence if name != '-1' else found.name == 'sense')


@pytest.mark.parametrize('factor, deviation, name', [
    (0.017, 1e-4, 'pi/180'), (59.0, 0.1, '180/pi'), (-1.03, 1e-3, '-1'), (2.05, 1e-3, '2048/1000'),
    (2.1, 1e-3, '2'), (1.0239, 1e-4, '1024/1000'), (1.0235, 1e-5, None), (1.0239, 5e-3, None),
    (1.03, 1e-4, None), (0.98, 1e-4, None), (3.0, 1e-3, None)])
def test_a_factor_is_a_unit_only_where_it_is_known_to_be_one(factor, deviation, name):
    assert identify_unit_factor(factor, deviation) == name


def test_a_scale_factor_error_that_the_model_has_is_no_unit(generator):
    log = swing(generator, scale=1.024)
    assert (list(found(log)) == ['unit_error']
            and found(log)['unit_error'].ambiguous_with == ('scale_factor_error',))
    assert not found(log, GyroModel((Term(SCALE_FACTOR_ERROR, (0.024,)),)))


def test_a_calculated_motion_has_no_encoder():
    """Stretches of constant rate and ramps have headings on a lattice, and rests one value."""
    time = np.arange(6000) * INTERVAL
    rate = np.repeat([0.0, 0.5, 0.0, -0.25, 0.0, 0.3], 1000)
    ramps = np.convolve(np.repeat([0.0, 20.0, -40.0, 0.0, 40.0, -20.0], 100) * DEGREE,
                        np.full(20, 0.05))
    assert (not encoder_step(np.cumsum(rate) * INTERVAL) and not encoder_step(np.sin(time))
            and not encoder_step(np.cumsum(ramps) * 0.05))
    # an encoder whose steps pass in whole numbers at most rates, or in even patterns
    for rates in ([0.0, 100.0, 200.0], [0.0, 60.0, -40.0, 10.0]):
        swept = np.cumsum(np.convolve(np.repeat(rates, 2000), np.full(40, 0.025))) * INTERVAL
        assert encoder_step(np.round(swept / 0.5) * 0.5) == pytest.approx(0.5)
    read = np.round(np.cumsum(ramps) * 0.05 / (0.03 * DEGREE)) * 0.03 * DEGREE
    assert encoder_step(read) == pytest.approx(0.03 * DEGREE)


GOOD = swing(np.random.default_rng(1))
NAN = np.where(np.arange(6000) < 5950, np.nan, 1.0)
OTHER_UNITS = GyroModel((Term(SCALE_FACTOR_ERROR, (1.0 / DEGREE - 1.0,)),))
REFUSED = {
    'counts alone': (replace(GOOD, output=None, counts=GOOD.output),
                     'no gyro output in rad/s; with'),
    'no reference': (replace(GOOD, reference_rate=None),
                     'no reference, and the gyro is not at rest'),
    'few': (Log(output=GOOD.output[:90], time=GOOD.time[:90],
                reference_rate=GOOD.reference_rate[:90]), '90 of 90 samples'),
    'short': (Log(output=GOOD.output[:900], time=GOOD.time[:900],
                  reference_rate=GOOD.reference_rate[:900]), 'lasts 8.99 s'),
    'constant': (replace(GOOD, output=0.0 * GOOD.output + 0.1),
                 'in 100 % of the samples: it is dead'),
    'same': (replace(GOOD, reference_rate=GOOD.output), '1 times the reference plus'),
    'affine': (replace(GOOD, reference_rate=(GOOD.output - 0.1) / 1.3),
               '1.3 times the reference plus 5.73 deg/s'),
    'summed up': (Log(output=GOOD.output, time=GOOD.time,
                      reference_heading=np.cumsum(GOOD.output) * INTERVAL),
                  '1 times the reference'),
    'lost gyro': (replace(GOOD, output=GOOD.output * NAN), 'the gyro has a value in 50 of 6000'),
    'lost reference': (replace(GOOD, reference_rate=GOOD.reference_rate * NAN),
                       'the reference has a value in 50 of 6000 samples; at least 100, and a '
                       'tenth or at even intervals, are needed: repair its line'),
    'few fixes': (Log(output=GOOD.output, time=GOOD.time, reference_heading=np.where(
        np.arange(6000) % 100, np.nan, np.cumsum(GOOD.reference_rate) * INTERVAL)),
        'in 60 of 6000 samples; at least 100 are needed: record longer, 99 s'),
    'few rows': (Log(output=GOOD.output[:5], reference_rate=GOOD.reference_rate[:5]), '5 rows')}


@pytest.mark.parametrize('log, reason', REFUSED.values(), ids=REFUSED)
def test_a_log_that_allows_no_diagnosis_is_refused_in_one_sentence(log, reason):
    with pytest.raises(DataRefused) as refused:
        refuse_unusable(log)
    assert (reason in str(refused.value) and '\n' not in str(refused.value)
            and re.search('[:;]', str(refused.value)))


@pytest.mark.parametrize('log, model, evidence', [
    (GOOD, OTHER_UNITS, 'which is not plausible'),
    (GOOD, GyroModel(rate_range=(-0.01, 0.01)), 'the model is for rates up to'),
    (replace(GOOD, output=GOOD.output - 1.01 * GOOD.reference_rate, reference_rate=None),
     GyroModel(noise=Noise(1e-4 / DEGREE)), 'times the angle random walk'),
    (Log(output=GOOD.output[::100], reference_rate=GOOD.reference_rate[::100]), OTHER_UNITS,
     'which is not plausible')], ids=['in deg/s', 'range', 'noise in deg', 'table'])
def test_a_model_of_other_units_fails_a_gate(log, model, evidence):
    gate = examine_log(log, model)[-1]
    assert gate.name == 'model' and gate.passed is False
    assert evidence in gate.evidence and 'rad/' in gate.remedy


def test_a_log_that_allows_a_diagnosis_is_accepted():
    own = GyroModel((Term(BIAS, (2e-3,)), Term(SCALE_FACTOR_ERROR, (0.01,))),
                    rate_range=(-1.0, 1.0), noise=WHITE)
    half = np.where(np.arange(6000) % 1000 < 300, np.nan, 1.0)
    for log in (GOOD, Log(output=GOOD.output[::100], reference_rate=GOOD.reference_rate[::100])):
        assert all(gate.passed for gate in examine_log(log, own))
    refuse_unusable(replace(GOOD, output=GOOD.output * half,
                            reference_rate=GOOD.reference_rate * half[::-1]))
    refuse_unusable(replace(GOOD, output=GOOD.output / DEGREE))


RECORDINGS = {
    'mems_encoder_turntable/yaw_slow.csv.gz': ['sense', 'dropped_samples',
                                               'reference_quantization'],
    'mems_encoder_turntable/pitch_slow.csv.gz': ['dropped_samples', 'reference_quantization'],
    'mems_static/mpu6050_host_clock.csv.gz': [], 'mems_motion_capture/fast.csv.gz': [],
    'fog_rate_table/table.csv': []}


@pytest.mark.parametrize('name', RECORDINGS)
def test_measured_records_show_what_is_known_of_them(name, data):
    log = read_log(data / name)
    refuse_unusable(log)
    quality = inspect_record(log)
    failed = [gate.name for gate in check_gates(log) if gate.passed is False]
    assert failed + [finding.effect for finding in quality.findings] == RECORDINGS[name]
    if 'turntable' in name:
        assert quality.heading_step == pytest.approx(360.0 / 4096 * DEGREE * 351 / 360, rel=0.03)
        lost = {finding.effect: finding for finding in quality.findings}['dropped_samples']
        assert value(lost) == fit_stamp_grid(log.time).lost_after.sum() > 15
