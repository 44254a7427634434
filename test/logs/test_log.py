# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Logs as files: columns and units, also of other programs; what is refused; stamps."""

import gzip
import json
import math
import re
import sys

from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.logs.log import (
    DataRefused, DEGREE, Log, log_from_table, LogError, QUANTITIES, read_log, select_rows,
    unwrap_heading, write_log)
from gyro_calibration.logs.quality import (
    quantization_step, refuse_saturated, white_noise_deviation)
from gyro_calibration.logs.stamps import fit_stamp_grid
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def written(folder, text):
    path = folder / 'log.csv'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize('names', [
    'gyro_dps,reference_rate_rad_s,reference_heading_deg,temperature_degc,supply_v,time_s',
    'gyro_rad_s,reference_rate_dps,reference_heading_rad,acceleration_mps2,moving,time_s',
    'gyro_counts,time_s'])
def test_every_column_is_converted_to_si(tmp_path, names):
    attributes = {'gyro': 'output', 'gyro_counts': 'counts', 'acceleration': 'specific_force'}
    values = [1.0, 1.5, 3.0]
    log = read_log(written(tmp_path, f'{names}\n' + ''.join(
        f'{",".join([str(value)] * len(names.split(",")))}\n' for value in values)))
    for name in names.split(','):
        short = re.sub('_(dps|rad_s|deg|rad|degc|mps2|v|s)$', '', name)
        factor = DEGREE if name.endswith(('_dps', '_deg')) else 1.0
        assert getattr(log, attributes.get(short, short)).tolist() == [
            value * factor for value in values], name
    assert len(log) == 3


REFUSED = {
    'empty': ('', 'has no line with the names'),
    'no header': ('# note\n0.0,1.0\n0.1,1.0\n', 'no gyro column among 0.0,1.0; wanted gyro_dps'),
    'no gyro': ('time_s,temperature_degc\n0,1\n1,1\n',
                'no gyro column among time_s,temperature_degc'),
    'two columns': ('gyro_dps,gyro_rad_s\n0,1\n1,1\n',
                    'columns gyro_dps and gyro_rad_s both give the output'),
    'text': ('# note\ntime_s,gyro_dps\n0,1\n1,fast\n',
             "line 4, column gyro_dps: 'fast' is not a number; leave the cell empty"),
    'an underscore': ('time_s,gyro_dps\n0,1\n1,1_0\n', "column gyro_dps: '1_0' is not a number"),
    'no time': ('time_s,gyro_dps\n0,1\n,1\n',
                "line 3, column time_s: '' is not a number; give seconds, or"),
    'stands': ('time_s,gyro_dps\n0,1\n1,1\n1,1\n',
               'line 4, column time_s: 1 s is not later than 1 s'),
    'time in ns': ('time_s,gyro_dps\n1.7e18,1\n1.8e18,1\n',
                   'line 2, column time_s: 1.7e+18 s is beyond 1e+12 s; give'),
    'lost time': ('time_s,gyro_dps\n0,1\nnan,1\n2,1\n',
                  'line 3, column time_s: nan is not a finite number'),
    'one row': ('gyro_dps\n0\n', '1 of the 2 rows of data'),
    'short row': ('time_s,gyro_dps\n0,1\n1\n', 'line 3 has 1 values, and the header 2'),
    'text after a text': ('gyro_dps,place\n0,"a\nb"\n1,c\nfast,d\n',
                          "line 5, column gyro_dps: 'fast' is not a number"),
    'a text without end': ('gyro_dps,place\n0,a\n1,"b\n2,c\n' + '3,d\n' * 50000,
                           'cannot be read as a log'),
    'binary': (bytes(range(256)), 'is not text in UTF-8'),
    'a zero byte': ('time_s,gyro_dps\n0,1\0\n1,1\n', "'1\\x00' is not a number"
                    if sys.version_info >= (3, 11) else 'line contains NUL'),
    'not packed': (b'\x1f\x8b\x08abc', 'not text'),
    'Latin-1': ('Zeit;Drehrate [°/s]\n0;1\n'.encode('latin-1'), 'iconv -f WINDOWS-1252 -t UTF-8'),
    'UTF-16': ('time_s,gyro_dps\n0,1\n'.encode('utf-16'), 'iconv -f UTF-16 -t UTF-8'),
    'beyond a gyro': (
        'time_s,gyro_dps\n0,1\n1,1e300\n',
        'line 3, column gyro_dps: 1e300 is beyond the limit of 1e+20; remove the'),
    'a header of lines': ('"a\nb",time_s\n1,1\n2,2\n', 'no gyro column among a\\nb,time_s;'),
    'an endless line': ('gyro_dps\n' + '1,' * 40000 + '\n1\n',
                        'a line has more than 65536 characters'),
}


@pytest.mark.parametrize('text, message', REFUSED.values(), ids=REFUSED)
def test_what_is_no_log_is_refused_with_file_row_and_column(tmp_path, monkeypatch, text, message):
    path = written(tmp_path, text)
    monkeypatch.setattr('gyro_calibration.logs.log.CACHE_BLOCK_SAMPLES', 2)
    with pytest.raises(LogError) as refused:
        read_log(path)
    assert str(refused.value).startswith(f'{path}: ') and message in str(refused.value)


def test_a_compressed_file_that_unfolds_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr('gyro_calibration.logs.log.MIN_EXPANSION_BYTES', 1 << 16)
    path = tmp_path / 'log.csv.gz'
    with gzip.open(path, 'wb') as file:
        file.write(b'gyro_dps\n')
        file.write(b'0\n' * 1_000_000)
    with pytest.raises(LogError, match='decompresses to more than 100 times .*; decompress it'):
        read_log(path)


def test_a_log_that_is_too_large_for_the_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr('gyro_calibration.logs.log._MAX_LOG_VALUES', 100)
    path = written(tmp_path,
                   'time_s,gyro_dps\n' + ''.join(f'{second},0\n' for second in range(51)))
    with pytest.raises(LogError, match='more than 100 numbers.*; split it'):
        read_log(path)


def test_a_lost_value_is_nan_or_an_empty_cell(tmp_path):
    text = '\ufeffgyro_dps,reference_rate_dps,reference_heading_deg\r\n1,nan,\r\n,180,NaN\r\n\r\n'
    log = read_log(written(tmp_path, text))  # neither the mark nor the empty line is part of it
    assert np.isnan(log.output).tolist() == [False, True]
    assert (np.isnan(log.reference_rate).tolist() == [True, False]
            and np.isnan(log.reference_heading).all())


@pytest.mark.parametrize('name', ['log.csv', 'log.csv.gz'])
def test_a_log_is_read_back_as_it_was_written(tmp_path, name):
    generator = np.random.default_rng(0)
    log = Log(**{quantity: np.cumsum(generator.random(50)) for quantity in QUANTITIES},
              notes=('a', 'b, c'))
    write_log(tmp_path / name, log)
    again = read_log(tmp_path / name)
    assert again.notes == log.notes
    for quantity in QUANTITIES:
        np.testing.assert_array_equal(getattr(again, quantity), getattr(log, quantity), quantity)
    write_log(tmp_path / f'again_{name}', log)
    assert (tmp_path / f'again_{name}').read_bytes() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize('text', [
    ''.join(f'{second},"lap, {second}\n of many"\n' for second in range(11)) + '\n\n',
    '1,"a\n\n\n\n\nb"\n2,c\n3,"d\n\n\n\n"\n'])
def test_a_log_is_the_same_in_blocks_of_any_length(tmp_path, monkeypatch, text):
    """Also where a row is longer than a block; at a rate the time goes on from block to block."""
    path = written(tmp_path, f'# note\ngyro_counts,lap\n{text}')
    whole = read_log(path, sensitivity=0.5, rate=100.0)
    for rows in (2, 3):
        monkeypatch.setattr('gyro_calibration.logs.log.CACHE_BLOCK_SAMPLES', rows)
        log = read_log(path, sensitivity=0.5, rate=100.0)
        assert (log.output.tolist(), log.time.tolist(), log.others, log.notes) == (
            whole.output.tolist(), whole.time.tolist(), whole.others, ('note',))


def test_of_other_columns_with_one_name_none_is_lost(tmp_path):
    log = read_log(written(tmp_path, 'gyro_dps,lap,lap,lap.1,,\n0,a,b,c,d,e\n1,f,g,h,i,j\n'))
    assert log.others == {'lap': ('a', 'f'), 'lap.2': ('b', 'g'), 'lap.1': ('c', 'h'),
                          '': ('d', 'i'), '.1': ('e', 'j')}
    write_log(tmp_path / 'again.csv', log)
    assert read_log(tmp_path / 'again.csv').others == log.others


@pytest.mark.parametrize('stamps', [['nan', 'nan', 'nan'], ['', '', ''],
                                    ['12:01', '12:01', '12:00'], ['2', '1', '0']], ids=','.join)
def test_at_a_rate_the_stamps_may_be_broken(tmp_path, stamps):
    path = written(tmp_path, 'time_s,gyro_rad_s\n' + ''.join(f'{stamp},{row}\n'
                                                             for row, stamp in enumerate(stamps)))
    log = read_log(path, rate=10.0)
    assert (log.time.tolist() == [0.0, 0.1, 0.2] and log.output.tolist() == [0.0, 1.0, 2.0]
            and not log.others)
    with pytest.raises(LogError, match='column time_s'):
        read_log(path)


def test_numbers_are_the_same_with_and_without_other_columns(tmp_path):
    """Columns of text are read by another parser than columns of numbers alone."""
    texts = ['1', '-0.1', '1e-7', ' 2.5 ', '+3', 'nan', '0.1000000000000000055511151231257827',
             '12345678901234567890', '.5', '5.']
    alone = read_log(written(tmp_path, 'gyro_rad_s\n' + ''.join(f'{text}\n' for text in texts)))
    with_others = read_log(written(tmp_path,
                                   'gyro_rad_s,lap\n' + ''.join(f'{text},a\n' for text in texts)))
    assert np.array_equal(alone.output, with_others.output, equal_nan=True)
    assert np.array_equal(alone.output, [float(text) for text in texts], equal_nan=True)


# Logs of other programs

@pytest.mark.parametrize(('name', 'unit', 'attribute', 'value'), [
    ('time', ':ms', 'time', 2e-3), ('time', ':us', 'time', 2e-6), ('time', ':ns', 'time', 2e-9),
    ('time', ':min', 'time', 120.0), ('time', '', 'time', 2.0),
    ('rate', ':deg/h', 'reference_rate', 2.0 * DEGREE / 3600.0),
    ('rate', ':dps', 'reference_rate', 2.0 * DEGREE),
    ('heading', ':deg', 'reference_heading', 2.0 * DEGREE),
    ('heading', ':turn', 'reference_heading', 4.0 * math.pi),
    ('temperature', ':K', 'temperature', -271.15),
    ('temperature', ':degF', 'temperature', -150.0 / 9.0), ('counts', '', 'counts', 2.0),
    ('acceleration', ':g', 'specific_force', 19.6133), ('supply', ':mV', 'supply', 2e-3)])
def test_a_column_is_converted_from_the_unit_that_the_user_names(
        tmp_path, name, unit, attribute, value):
    log = read_log(written(tmp_path, 'wz,x\n1,1\n2,2\n'),
                   columns={name: f'x{unit}', 'gyro': 'wz:deg/s'})
    assert getattr(log, attribute)[1] == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(log.output, [DEGREE, 2.0 * DEGREE])


def test_a_named_column_goes_before_one_of_the_format_and_the_rest_is_kept(tmp_path):
    log = read_log(written(tmp_path, 'time_s,gyro_dps,wz,note\n0,5,1,a\n1,5,2,b\n'),
                   columns={'gyro': 'wz'})
    assert log.output.tolist() == [1.0, 2.0] and log.others == {'note': ('a', 'b')}
    assert log.time.tolist() == [0.0, 1.0]
    part = select_rows(log, log.time > 0.5)
    assert part.output.tolist() == [2.0] and part.others == {'note': ('b',)}
    log = read_log(written(tmp_path, 't;gz;yaw\n0;1;5\n1;1; \n2;1;\n3;1;8\n'),
                   columns={'time': 't', 'gyro': 'gz', 'heading': 'yaw'})
    assert np.isfinite(log.reference_heading).tolist() == [True, False, False, True]


@pytest.mark.parametrize('text', [
    'time_s;gyro_dps\n0,0;1,5\n0,5;-2,5\n', 'time_s;gyro_dps;place\n0,0;1,5;a,b\n0,5;-2,5;c\n',
    'time_s\tgyro_dps\n0.0\t1.5\n0.5\t-2.5\n', 'time_s;gyro_dps\n0.0;1.5\n0.5;-2.5\n',
    'sep=;\ntime_s;gyro_dps\n0,0;1,5\n0,5;-2,5\n'])
def test_semicolons_tabs_and_decimal_commas_are_understood(tmp_path, text):
    log = read_log(written(tmp_path, text))
    assert log.time.tolist() == [0.0, 0.5]
    np.testing.assert_allclose(log.output, [1.5 * DEGREE, -2.5 * DEGREE])
    assert log.others in ({}, {'place': ('a,b', 'c')})


@pytest.mark.parametrize(('axis', 'rate'), [('x', 1.0), ('y', 2.0), ('z', 3.0)])
def test_the_axis_of_three_is_taken(tmp_path, axis, rate):
    names = ','.join(each.format(axis) for each in ('gyro_{}_rad_s', 'acceleration_{}_mps2')
                     for axis in 'xyz')
    log = read_log(written(tmp_path, f'{names}\n' + 2 * '1,2,3,7,8,9\n'), axis=axis)
    assert log.output[0] == rate and log.specific_force[0] == rate + 6.0


@pytest.mark.parametrize(('header', 'columns', 'wanted'), [
    ('t,wz,yaw', {}, 'as by --columns time=NAME:s,gyro=NAME:deg/s'),
    ('time_s,wz', {'gyro': 'wzz'}, 'there is no column wzz among time_s,wz; perhaps wz is meant'),
    ('time_s,wz', {'gyro': 'wz:deg/min'}, 'deg/min is no unit of it; wanted one of rad/s, deg/s'),
    ('time_s,wz', {'giro': 'wz'}, 'giro is no quantity of a log, which are time, gyro')])
def test_wrong_names_are_answered_with_the_right_ones(tmp_path, header, columns, wanted):
    row = ','.join('1' for _ in header.split(','))
    with pytest.raises(LogError) as found:
        read_log(written(tmp_path, f'{header}\n{row}\n{row}\n'), columns=columns)
    assert wanted in str(found.value) and 'log.csv' in str(found.value)


def test_an_unwrapped_heading_is_the_true_one(run, tmp_path):
    time = np.arange(0.0, 30.0, 0.02)
    rate = 2.0 * np.sin(0.5 * time) + 1.0
    heading = time - 4.0 * np.cos(0.5 * time)
    wrapped = np.angle(np.exp(1j * heading))
    wrapped[::7] = np.nan
    found, _ = unwrap_heading(time, wrapped, time, rate)
    known = np.isfinite(wrapped)
    np.testing.assert_allclose(found[known] - found[1], heading[known] - heading[1], atol=1e-9)
    assert np.isnan(found[~known]).all()
    noisy = rate + np.random.default_rng(1).normal(0.0, 0.01, len(rate))
    rows = '\n'.join(f'{a:.2f},{b:.9f},{math.degrees(c):.9f}'
                     for a, b, c in zip(time, noisy, wrapped))
    path = written(tmp_path, f't,w,yaw\n{rows}\n')
    columns = '--columns', 'time=t,gyro=w,heading=yaw:deg'
    code, text, _ = run('diagnose', path, *columns)
    assert code == 0 and '--unwrap' in text
    effects = json.loads(run('fit', path, *columns, '--unwrap', '--json')[1])['effects']
    assert abs(effects['scale_factor_error']['scale_factor_error']['estimate']) < 0.01


@pytest.mark.parametrize(('make', 'given', 'wanted'), [
    (log_from_table, {'w': [1.0, 2.0]}, 'no gyro column'),
    (log_from_table, {'gyro_dps': ['a', 'b']}, 'numbers'),
    (log_from_table, {'gyro_dps': [1.0, 2.0], 'time_s': [1.0, 2.0, 3.0]}, 'one shape'),
    (log_from_table, {'gyro_dps': [1.0]}, '2 rows'),
    (log_from_table, {'gyro_dps': [[1.0], [2.0]]}, 'one shape'),
    (log_from_table, {'gyro_dps': [1.0, math.inf]}, 'remove the row'),
    *((lambda given: Log(**{'output': [1.0, 2.0]} | given), given, wanted) for given, wanted in [
        ({'time': [0.0, 1.0, 2.0]}, r'time \(3,\), output \(2,\); wanted one shape'),
        ({'time': [1.0, 0.0]}, 'row 1, column time_s: 0 s is not later than 1 s'),
        ({'time': [0.0, math.nan]}, 'row 1, column time_s: nan s is not later than 0 s'),
        ({'time': np.array(['2026-01-01', '2026-01-02'], 'M8[ns]')}, 'time is no column of num'),
        ({'output': [1j, 2.0]}, 'output is no column of numbers'),
        ({'temperature': [20.0, math.nan]}, 'row 1 of temperature is nan')])])
def test_a_table_or_arrays_that_are_no_log_are_refused_in_a_sentence(make, given, wanted):
    with pytest.raises(LogError, match=wanted):
        make(given)


def test_masked_values_are_lost_ones():
    log = Log([0.0, 1.0, 2.0], np.ma.masked_greater([0.1, 9.0, 0.2], 5.0))
    assert np.isnan(log.output).tolist() == [False, True, False]


FINE = np.arange(0.0, 20.0, 1e-3)


def rotated(*rates, begin=(0.0, 0.0, 0.0)):
    """Return the attitudes and, shape (n, 3), the turned angles of rates at the times FINE."""
    steps = 0.5e-3 * (np.array(rates)[:, 1:] + np.array(rates)[:, :-1])
    attitudes = [Rotation.from_rotvec(begin)]
    for step in steps.T:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(step))
    return attitudes, np.hstack([np.zeros((3, 1)), np.cumsum(steps, axis=1)]).T


def test_an_attitude_gives_the_angle_that_the_gyro_turned_though_its_axis_tilts(tmp_path):
    rate = 1.5 * np.sin(0.7 * FINE)
    attitudes, angles = rotated(np.cos(1.3 * FINE), 0.8 * np.sin(FINE), rate,
                                begin=(0.2, -0.1, 0.3))
    attitudes, angles = attitudes[::20], angles[::20]
    quaternion = np.array([each.as_quat() for each in attitudes])[:, [3, 0, 1, 2]]
    quaternion[::3] *= -1.0  # both signs are the same attitude
    turned = angles[:, 2]
    yaw = np.unwrap([each.as_euler('ZYX')[0] for each in attitudes])
    assert np.ptp(yaw - turned) > 1.0, 'it does not tilt'
    quaternion[400:404] = np.nan
    names = {'gyro': 'w', 'attitude': 'qw/qx/qy/qz'}
    table = dict(zip(('time_s', 'w', 'qw', 'qx', 'qy', 'qz'),
                     (FINE[::20], rate[::20], *quaternion.T)))
    rows = '\n'.join(','.join(map(repr, map(float, row))) for row in zip(*table.values()))
    path = written(tmp_path, f'{",".join(table)}\n{rows}\n')
    found = [read_log(path, columns=names), log_from_table(table, names)]
    known = np.isfinite(quaternion[:, 0])
    for heading in (each.reference_heading for each in found):
        assert (np.isfinite(heading) == known).all()
        np.testing.assert_allclose(heading[:400], turned[:400], atol=2e-5)
        # over the gap of 0.1 s, the angle by an output without errors
        np.testing.assert_allclose(heading[known], turned[known], atol=5e-5)
    for log in found:
        np.testing.assert_allclose(np.stack([log.cross_axis_1, log.cross_axis_2], axis=1)[:400],
                                   angles[:400, :2], atol=2e-5)
    np.testing.assert_array_equal(read_log(path, columns=names, axis='y').cross_axis_2[:400],
                                  found[0].cross_axis_1[:400], 'the order is x, y, z, x, y')
    write_log(tmp_path / 'again.csv', found[0])
    np.testing.assert_array_equal(read_log(tmp_path / 'again.csv').cross_axis_2,
                                  found[0].cross_axis_2)


@pytest.mark.parametrize('tumbles', [True, False])
def test_a_gap_of_an_attitude_is_bridged_by_what_errs_least(tumbles):
    rate = 5.0 + 2.0 * np.sin(FINE)
    attitudes, angles = rotated(tumbles * 4.0 * np.cos(3.0 * FINE),
                                tumbles * 4.0 * np.sin(2.0 * FINE), rate)
    quaternion = np.array([each.as_quat() for each in attitudes])[::10]
    quaternion[600:700] = np.nan  # 1 s, in which the gyro turns by about a turn
    log = log_from_table({'time_s': FINE[::10], 'gyro_rad_s': rate[::10] + 0.02,
                          **dict(zip(('qx', 'qy', 'qz', 'qw'), quaternion.T))},
                         {'attitude': 'qw/qx/qy/qz'})
    off = np.asarray(log.reference_heading) - angles[::10, 2]
    # 1 s of the bias of the gyro, or nothing where the axis of the rotation is the same
    np.testing.assert_allclose(off[700:], 0.02 if tumbles else 0.0, atol=1e-3 if tumbles else 1e-9)
    np.testing.assert_allclose(off[:600], 0.0, atol=1e-3)


@pytest.mark.parametrize('names, said', [
    ({'attitude': 'qw'}, 'the four columns of a quaternion'),
    ({'attitude': 'w/w/w/v'}, 'no column v among'),
    ({'attitude': 'w/w/w/w', 'heading': 'w'}, 'heading and attitude both')])
def test_an_attitude_is_named_by_four_columns_and_is_the_only_heading(tmp_path, names, said):
    with pytest.raises(LogError, match=said):
        read_log(written(tmp_path, 'gyro_dps,w\n1,1\n2,2\n'), columns=names)


# Stamps that a host gives on arrival

def stalled(seconds):
    """Return stamps at 100 Hz of a host that stalls for some seconds, then takes 5 kHz."""
    due = np.arange(6000) / 100.0
    return np.concatenate([due[:2000], np.maximum(due[2000:], 20.0 + seconds + due[:4000] / 50.0)])


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
    *((np.delete(0.01 * np.arange(10_000), np.s_[1::every]), len(range(1, 10_000, every)))
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


# Steps and limits of outputs whose truth is known

each_sense = pytest.mark.parametrize('senses', [[1.0], [-1.0], [1.0, -1.0]])


def coarse_turns(generator, senses, noise):
    """Return an output at 25 Hz of constant turns between rests, with ramps of 1 s, rad/s."""
    rest, ramp = np.zeros(100), np.linspace(0.0, 1.0, 26)
    parts = [np.concatenate([rest, rate * ramp, np.full(250, rate), rate * ramp[::-1]])
             for rate in generator.uniform(40.0, 90.0) * np.array(senses)]
    rate = np.concatenate([*parts, rest]) + generator.normal(0.0, 0.5)
    return DEGREE * (rate + noise * generator.standard_normal(len(rate)))


def test_the_white_noise_of_samples_that_have_no_neighbours_is_known():
    values = np.full(3000, np.nan)
    values[::3] = np.random.default_rng(0).standard_normal(1000)
    assert white_noise_deviation(values) == pytest.approx(1.0, rel=0.1)


@each_sense
@pytest.mark.parametrize('step', [0.06, 0.5, 1.0])
def test_ramps_and_rests_do_not_hide_the_step_of_an_output(senses, step):
    """Ramps advance by nearly equal amounts, and most samples have one of a few codes."""
    for seed in range(20):
        generator = np.random.default_rng(seed)
        output = coarse_turns(generator, senses, generator.uniform(0.0, 0.5) * step)
        rounded = step * DEGREE * np.round(output / (step * DEGREE))
        assert quantization_step(rounded) / DEGREE == pytest.approx(step, rel=1e-6)


@each_sense
def test_a_coarse_turn_is_not_saturated_and_a_clipped_one_is(senses):
    for seed in range(20):
        generator = np.random.default_rng(seed)
        output = coarse_turns(generator, senses, 0.05)
        for step in (0.5 * DEGREE, DEGREE):
            refuse_saturated(step * np.round(output / step))
        limit = generator.uniform(0.5, 0.95) * np.abs(output).max()
        with pytest.raises(DataRefused, match=f'limit of -?{limit / DEGREE:.4g}'):
            refuse_saturated(np.clip(output, -limit, limit))
