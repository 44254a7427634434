# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Logs of other programs: their names, units, delimiters, axes and wrapped headings."""

import json
import math

from gyro_calibration.logs.log import (
    log_from_table,
    LogError,
    read_log,
    read_log_blocks,
    select_rows,
    unwrap_heading,
)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

DEGREE = math.pi / 180.0


def written(folder, text):
    path = folder / 'log.csv'
    path.write_text(text)
    return path


@pytest.mark.parametrize(('column', 'attribute', 'value'), [
    ('time=x:ms', 'time', 2e-3), ('time=x:us', 'time', 2e-6), ('time=x:ns', 'time', 2e-9),
    ('time=x:min', 'time', 120.0), ('time=x', 'time', 2.0), ('rate=x:deg/h', 'reference_rate',
                                                             2.0 * DEGREE / 3600.0),
    ('rate=x:dps', 'reference_rate', 2.0 * DEGREE), ('heading=x:deg', 'reference_heading',
                                                     2.0 * DEGREE),
    ('heading=x:turn', 'reference_heading', 4.0 * math.pi), ('temperature=x:K', 'temperature',
                                                             -271.15),
    ('temperature=x:degF', 'temperature', -150.0 / 9.0), ('acceleration=x:g', 'specific_force',
                                                          19.6133),
    ('supply=x:mV', 'supply', 2e-3), ('moving=x', 'moving', 2.0), ('counts=x', 'counts', 2.0)])
def test_a_column_is_converted_from_the_unit_that_the_user_names(
        tmp_path, column, attribute, value):
    name, _, text = column.partition('=')
    log = read_log(written(tmp_path, 'wz,x\n1,1\n2,2\n'), columns={name: text, 'gyro': 'wz:deg/s'})
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
    'time_s\tgyro_dps\n0.0\t1.5\n0.5\t-2.5\n', 'time_s;gyro_dps\n0.0;1.5\n0.5;-2.5\n'])
def test_semicolons_tabs_and_decimal_commas_are_understood(tmp_path, text):
    log = read_log(written(tmp_path, text))
    assert log.time.tolist() == [0.0, 0.5]
    np.testing.assert_allclose(log.output, [1.5 * DEGREE, -2.5 * DEGREE])
    assert log.others in ({}, {'place': ('a,b', 'c')})


@pytest.mark.parametrize(('axis', 'rate', 'force'),
                         [('x', 1.0, 7.0), ('y', 2.0, 8.0), ('z', 3.0, 9.0)])
def test_the_axis_of_three_is_taken(tmp_path, axis, rate, force):
    names = [f'{name}_{each}' for name in ('gyro', 'acceleration') for each in 'xyz']
    names = [f'{name}_{"rad_s" if name.startswith("gyro") else "mps2"}' for name in names]
    log = read_log(written(tmp_path, f'{",".join(names)}\n' + 2 * '1,2,3,7,8,9\n'), axis=axis)
    assert log.output[0] == rate and log.specific_force[0] == force


@pytest.mark.parametrize(('header', 'columns', 'wanted'), [
    ('t,wz,yaw', {}, '--columns time=t:UNIT,gyro=wz:UNIT,heading=yaw:UNIT is meant, with a unit'),
    ('timestamp_ms,gyro_z_degs,yaw_deg,temp', {}, '--columns time=timestamp_ms:ms,'
     'gyro=gyro_z_degs:deg/s,temperature=temp:UNIT,heading=yaw_deg:deg'),
    ('Time (ms);gyro_z [°/s];temp [°C];Yaw [°]', {}, "--columns 'time=Time (ms):ms,"
     "gyro=gyro_z [°/s]:deg/s,temperature=temp [°C]:degC,heading=Yaw [°]:deg' is meant"),
    ('%time,field.angular_velocity.z', {},
     '--columns time=%time:UNIT,gyro=field.angular_velocity.z:UNIT is meant'),
    ('time_s,gyro_dsp', {}, 'gyro_dps is meant by gyro_dsp'),
    ('time_s,wz', {}, '--columns gyro=wz:UNIT is meant, with a unit in place of each'),
    ('time_s,wz', {'gyro': 'wzz'}, 'there is no column wzz among time_s,wz; perhaps wz is meant'),
    ('time_s,wz', {'gyro': 'wz:deg/min'}, 'deg/min is no unit of it; wanted one of rad/s, deg/s'),
    ('time_s,wz', {'giro': 'wz'}, 'giro is no quantity of a log; wanted one of time, gyro'),
    ('a,b', {}, 'is no header')])
def test_wrong_names_are_answered_with_the_nearest_right_ones(tmp_path, header, columns, wanted):
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
    arguments = ('diagnose', path, '--columns', 'time=t,gyro=w,heading=yaw:deg')
    code, text, _ = run(*arguments)
    assert code == 0 and '--unwrap' in text
    code, text, error = run(*arguments, '--unwrap', '--json')
    assert code == 0, error
    answer = json.loads(text)
    assert answer['verdict'] != 'mismatched'


@pytest.mark.parametrize(('table', 'wanted'), [
    ({'w': [1.0, 2.0]}, 'no gyro column'), ({'gyro_dps': ['a', 'b']}, 'is no log'),
    ({'gyro_dps': [1.0, 2.0], 'time_s': [1.0, 2.0, 3.0]}, 'one shape'),
    ({'gyro_dps': [1.0]}, 'two rows'), ({'gyro_dps': [[1.0], [2.0]]}, 'one shape'),
    ({'gyro_dps': [1.0, 2.0], 'time_s': [1.0, 1.0]}, 'is not later than'),
    ({'gyro_dps': [1.0, math.inf]}, 'remove the row')])
def test_a_table_that_is_no_log_is_refused_in_a_sentence(table, wanted):
    with pytest.raises(LogError, match=wanted):
        log_from_table(table)


def test_an_attitude_gives_the_angle_that_the_gyro_turned_though_its_axis_tilts(tmp_path):
    time = np.arange(0.0, 20.0, 1e-3)
    rates = np.stack([np.cos(1.3 * time), 0.8 * np.sin(time), 1.5 * np.sin(0.7 * time)], axis=1)
    attitudes = [Rotation.from_rotvec([0.2, -0.1, 0.3])]
    for rate in 0.5 * (rates[1:] + rates[:-1]):
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(1e-3 * rate))
    quaternion = np.array([each.as_quat() for each in attitudes])[::20, [3, 0, 1, 2]]
    quaternion[::3] *= -1.0  # both signs are the same attitude
    turned = np.concatenate([[0.0], np.cumsum(0.5e-3 * (rates[1:, 2] + rates[:-1, 2]))])[::20]
    yaw = np.unwrap([each.as_euler('ZYX')[0] for each in attitudes[::20]])
    assert np.ptp(yaw - turned) > 1.0, 'it does not tilt'
    quaternion[400:404] = np.nan
    names = {'gyro': 'w', 'attitude': 'qw/qx/qy/qz'}
    table = dict(zip(('time_s', 'w', 'qw', 'qx', 'qy', 'qz'),
                     (time[::20], rates[::20, 2], *quaternion.T)))
    rows = '\n'.join(','.join(map(repr, map(float, row))) for row in zip(*table.values()))
    path = written(tmp_path, f'{",".join(table)}\n{rows}\n')
    found = [read_log(path, columns=names), log_from_table(table, names)]
    blocks = [each.reference_heading for each in read_log_blocks(path, rows=300, columns=names)]
    known = np.isfinite(quaternion[:, 0])
    for heading in (*(each.reference_heading for each in found), np.concatenate(blocks)):
        assert (np.isfinite(heading) == known).all()
        np.testing.assert_allclose(heading[:400], turned[:400], atol=3e-4)
        # over the gap of 0.1 s, the shortest rotation
        np.testing.assert_allclose(heading[known], turned[known], atol=1e-2)


def test_the_columns_of_an_attitude_are_named_where_a_reference_is_missing(run, tmp_path):
    path = written(tmp_path, 'time_s,gyro_dps,ref_qx,ref_qy,ref_qz,ref_qw\n'
                   '0,1,0,0,0,1\n1,2,0,0,0,1\n')
    code, text, error = run('diagnose', path)
    attitude = 'attitude=ref_qw/ref_qx/ref_qy/ref_qz'
    assert (code, text) == (1, '') and f'add {attitude} to --columns\n' in error
    path.write_text(path.read_text().replace('time_s,gyro_dps', 't,wz'))
    assert f'--columns time=t:UNIT,gyro=wz:UNIT,{attitude} is meant' in run('diagnose', path)[2]


@pytest.mark.parametrize('names, said', [
    ({'attitude': 'qw'}, 'the four columns of a quaternion'),
    ({'attitude': 'w/w/w/v'}, 'no column v among'),
    ({'attitude': 'w/w/w/w', 'heading': 'w'}, 'heading and attitude both')])
def test_an_attitude_is_named_by_four_columns_and_is_the_only_heading(tmp_path, names, said):
    with pytest.raises(LogError, match=said):
        read_log(written(tmp_path, 'gyro_dps,w\n1,1\n2,2\n'), columns=names)


def test_a_data_frame_is_a_log():
    pandas = pytest.importorskip('pandas')
    log = log_from_table(pandas.DataFrame({'time_s': [0.0, 1.0], 'gyro_rad_s': [1.0, 2.0]}))
    assert log.output.tolist() == [1.0, 2.0]
