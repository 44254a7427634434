# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A fleet: the unit of each log, workers that are killed, the verb on good and bad input."""

from concurrent.futures import BrokenExecutor
from dataclasses import replace
from datetime import date, timedelta
import json
import os
from pathlib import Path
import subprocess
import sys

import fatal_tasks
from fatal_tasks import KILLS, TAKES_ALL_MEMORY, task
from gyro_calibration.cli.main import main
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.files import InputError
from gyro_calibration.fleet.logs import (
    compile_file_pattern, describe_log, find_logs, FleetLog, LogTask, process_log)
from gyro_calibration.fleet.pooling import (
    find_changes, find_outlying_groups, Observations, PooledValue)
from gyro_calibration.fleet.run import process_executor, run_tasks
from gyro_calibration.fleet.summary import (
    build_models, count_effects, data, describe_type, summarize_types)
from gyro_calibration.logs.log import Log, write_log
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.model_file import read_model, write_model
import numpy as np
import pytest

DEGREE = np.pi / 180.0


def drive(bias, seed):
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 45.0, 0.05)
    heading = 2.0 * np.sin(2.0 * np.pi * time / 15.0)
    output = np.gradient(heading, time) * 1.01 + bias + 2e-3 * generator.standard_normal(len(time))
    return Log(time=time, output=output, reference_heading=heading)


def run(*arguments):
    return main(['fleet', *map(str, arguments), '--no-diagnosis', '--workers', '1', '--json'])


@pytest.fixture
def pool(tmp_path, capsys):
    """Return a function that runs the verb and gives its answer, and the reasons by file."""
    def pool(logs, *words):
        assert run(logs, '--out', tmp_path / 'out', *words) == 0
        found = json.loads(capsys.readouterr().out)
        return found, {os.path.basename(each['log']): each['reason']
                       for each in found['no_evidence']}
    return pool


def test_a_table_says_of_which_unit_and_drive_a_log_is(tmp_path):
    (tmp_path / 'fleet.csv').write_text('log,unit,drive,date,temperature\n'
                                        'a.csv,7,n,2026-03-01,21\nb.csv,8,n,,\n')
    (tmp_path / 'a.csv').touch()
    assert find_logs([str(tmp_path / 'fleet.csv')]) == [
        FleetLog(str(tmp_path / 'a.csv'), '7', '', 'n', '2026-03-01', 21.0),
        FleetLog(str(tmp_path / 'b.csv'), '8', '', 'n')]


@pytest.mark.parametrize(('text', 'wanted'), [
    ('log,unit,colour\na.csv,1,red\n', 'its columns are log, unit, colour'),
    ('log,unit\na.csv\n', 'line 2: holds 1 values, wanted 2'),
    ('log,unit\n,3\n', 'line 2: names no log'),
    ('unit,drive\n1,h\n', 'its columns are unit, drive; wanted log'),
    ('log;unit\na.csv;1\na.csv;2\n', 'a.csv: is listed twice, with unit 1 and 2'),
    ('log,date\na.csv,March\n', "its date is given as 'March'"),
    ('log,temperature\na.csv,hot\n', "its temperature is given as 'hot'"),
    (b'log,unit\nb\xff.csv,1\n', 'fleet.csv: ')])
def test_a_table_that_is_wrong_is_refused_in_one_sentence(tmp_path, text, wanted):
    (tmp_path / 'fleet.csv').write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=wanted):
        find_logs([str(tmp_path / 'fleet.csv')])


def test_folders_globs_and_lists_are_searched_for_logs_but_not_the_results(tmp_path):
    for name in ('x/b.csv', 'x/y/a.mcap', 'x/out/c.csv', 'x/readme.md', 'x/bag/metadata.yaml'):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / 'list.txt').write_text('# two\nx/b.csv\n')

    def found(path):
        return [os.path.relpath(entry.log, tmp_path)
                for entry in find_logs([str(tmp_path / path)], excluded_folder=tmp_path / 'x/out')]
    assert found('x') == ['x/b.csv', 'x/bag', 'x/y/a.mcap']
    assert found('x/*/*.mcap') == ['x/y/a.mcap']
    assert found('list.txt') == ['x/b.csv']
    with pytest.raises(InputError, match='holds no log'):
        found('x/out')
    (tmp_path / 'x/loop').symlink_to('.')
    (tmp_path / 'x/earlier').mkdir()
    for name in ('fleet.json', 'logs.csv'):
        (tmp_path / 'x/earlier' / name).touch()
    assert found('x') == ['x/b.csv', 'x/bag', 'x/y/a.mcap']
    (tmp_path / 'x/table.csv').write_text('log,unit\nb.csv,7\n')
    assert {entry.log[-5:]: entry.unit for entry in find_logs([str(tmp_path / 'x')])} == {
        'b.csv': '7', 'x/bag': '', 'c.csv': '', '.mcap': ''}


def test_notes_and_names_say_what_a_table_does_not(tmp_path):
    written = {
        'keyed.csv': b'# unit: SN-12, type: DOT\n# date: 2026-03-01, temperature: 21.5 degC\n'
        b'time_s,gyro_dps\n',
        'rc_car_h_unit3.csv': b'time_s,gyro_dps\n', 'aimless.csv': b'# a drive in town\nx\n'}
    for name, content in written.items():
        (tmp_path / name).write_bytes(content)

    def of(name, named=None):
        found = describe_log(FleetLog(str(tmp_path / name)), named)
        return found.unit, found.type, found.drive, found.date, found.temperature
    assert of('keyed.csv') == ('SN-12', 'DOT', '', '2026-03-01', 21.5)
    assert of('rc_car_h_unit3.csv', compile_file_pattern('{type}_{drive}_unit{unit}')) == (
        '3', 'rc', 'car_h', '', None)
    assert of('aimless.csv') == ('', '', '', '', None)
    with pytest.raises(ValueError, match='wanted a file name'):
        compile_file_pattern('rc_car')


def test_a_worker_that_is_killed_ends_the_run_and_one_without_memory_does_not():
    with process_executor(2, 1e9) as executor:
        numbers = [*range(KILLS), *range(KILLS + 1, 10)]
        found = dict(run_tasks(task, numbers, executor))
    assert found.pop(TAKES_ALL_MEMORY) == 'no memory'
    assert found == {number: number for number in {*numbers} - {TAKES_ALL_MEMORY}}
    with process_executor(2) as executor, pytest.raises(BrokenExecutor):
        list(run_tasks(task, [KILLS], executor))


def test_workers_end_with_the_program_that_is_killed(tmp_path, wait_until):
    begun = subprocess.Popen([sys.executable, fatal_tasks.__file__, tmp_path])
    try:
        worker = wait_until(lambda: [each.name for each in tmp_path.iterdir()])[0]
    finally:
        begun.kill()
        begun.wait()
    wait_until(lambda: not Path(f'/proc/{worker}').exists())


def test_logs_that_are_no_evidence_are_reported_and_the_others_done(tmp_path, pool):
    """Of equal logs of different units neither is sure; types are pooled apart."""
    logs = tmp_path / 'logs'
    for unit in (1, 2, 4):
        write_log(logs / f'a_unit{unit}.csv', drive(0.01 * unit, unit))
    (logs / 'b_unit5.csv').write_bytes((logs / 'a_unit4.csv').read_bytes())
    (logs / 'b_unit1.csv').write_text(  # a double
        '# again\n' + (logs / 'a_unit1.csv').read_text())
    (logs / 'copy.csv').write_bytes((logs / 'a_unit2.csv').read_bytes())
    (logs / 'c_unit1.csv').write_text('time_s,gyro_dps\n0,x\n1,2\n')
    write_log(logs / 'nobody.csv', drive(0.01, 3))
    rates = drive(0.01, 4)
    write_log(logs / 'd_unit1.csv', replace(rates, output=rates.output / DEGREE))
    write_log(logs / 'd_unit2.csv', replace(rates, time=1000.0 * rates.time))
    write_log(logs / 'e_unit3.csv', drive(0.01, 5))
    (logs / 'd_unit3.csv').write_text('# unit: 3, type: FOG\n'
                                      + (logs / 'e_unit3.csv').read_text())
    (logs / 'e_unit3.csv').unlink()
    found, reasons = pool(logs, '--pattern', '{drive}_unit{unit}')
    assert found['logs'] == 11 and 'is a copy of' in reasons['b_unit1.csv']
    assert 'of unit 4' in reasons.pop('b_unit5.csv') and 'of unit 5' in reasons.pop('a_unit4.csv')
    assert 'a_unit2.csv' in reasons.pop('copy.csv')
    assert 'x' in reasons['c_unit1.csv'] and 'unit' in reasons['nobody.csv']
    assert 'gyro_rad_s' in reasons['d_unit1.csv'] and 'in ms' in reasons['d_unit2.csv']
    assert set(reasons) == {'b_unit1.csv', 'c_unit1.csv', 'nobody.csv', 'd_unit1.csv',
                            'd_unit2.csv'}
    assert not any('\n' in each for each in reasons.values())
    assert {each['type']: each['units'] for each in found['types']} == {
        '': ['1', '2'], 'FOG': ['3']}


def test_gyros_of_a_laboratory_need_no_drives_and_show_wrong_units(tmp_path, pool):
    """At rest, and on rate tables; deg/s in place of rad/s, and a sign."""
    generator = np.random.default_rng(1)
    rate = np.tile(np.linspace(-1.0, 1.0, 11), 2)
    for unit in range(5):
        factor = 1.0 / DEGREE if unit == 3 else 1.0
        rest = 1e-3 + 1e-4 * generator.standard_normal(1300)
        table = 1.01 * rate + 1e-4 * generator.standard_normal(len(rate))
        write_log(tmp_path / f'logs/rest_unit{unit}.csv',
                  Log(time=0.05 * np.arange(1300), output=factor * rest))
        write_log(tmp_path / f'logs/type_2_unit{unit}.csv',
                  Log(output=(factor if unit else -1.0) * table, reference_rate=rate))
    (tmp_path / 'logs.csv').write_text(
        'log,unit,type\n' + ''.join(f'logs/{kind}_unit{unit}.csv,{unit},{kind}\n'
                                    for kind in ('rest', 'type_2') for unit in range(5)))
    found, reasons = pool(tmp_path / 'logs.csv')
    assert set(reasons) == {f'{name}.csv'
                            for name in ('rest_unit3', 'type_2_unit0', 'type_2_unit3')}
    assert 'its white noise is 5' in reasons['rest_unit3.csv']
    assert 'opposite senses' in reasons['type_2_unit0.csv']
    assert '180/pi' in reasons['type_2_unit3.csv']
    assert [each['units'] for each in found['types']] == [list('0124'), list('124')]


def test_names_may_hold_any_characters(tmp_path):
    names = {'ä': 'lauf ä', 'ö': os.fsdecode(b'b\xff'), 'a/b': '名', 'a_b': 'x'}
    for seed, (unit, name) in enumerate(names.items()):
        write_log(tmp_path / f'{name}.csv',
                  replace(drive(0.01, seed), notes=(f'unit: {unit}, type: T',)))
    assert run(tmp_path, '--out', tmp_path / 'out') == 0
    assert {each.name for each in (tmp_path / 'out/models').iterdir()} == {
        'T.yaml', 'T-unit-ä.yaml', 'T-unit-ö.yaml', 'T-unit-a_b.yaml', 'T-unit-a_b_.yaml'}


@pytest.mark.parametrize('error, words', [
    (KeyboardInterrupt, 'interrupted after 0 of 1 logs; run the same command'),
    (BrokenExecutor, 'a worker was killed')])
def test_who_interrupts_is_told_how_to_continue(tmp_path, capsys, monkeypatch, error, words):
    def interrupted(*_):
        raise error
    monkeypatch.setattr('gyro_calibration.cli.fleet.run_tasks', interrupted)
    (tmp_path / 'a.csv').touch()
    assert run(tmp_path, '--out', tmp_path / 'out') == 1
    assert words in capsys.readouterr().err


def test_what_was_done_is_not_done_again_and_is_the_same_to_the_bit(tmp_path):
    write_log(tmp_path / 'a_unit1.csv', drive(0.01, 0))
    one = LogTask(FleetLog(str(tmp_path / 'a_unit1.csv')), str(tmp_path / 'out'),
                  file_pattern=compile_file_pattern('{drive}_unit{unit}'))
    first, stamp, kept = (process_log(one), one.record_path.stat().st_mtime_ns,
                          one.record_path.read_bytes())
    assert first == process_log(one) and one.record_path.stat().st_mtime_ns == stamp
    assert first['unit'] == '1' and first['values']['bias']['value'] == pytest.approx(
        0.01, abs=4.0 * first['values']['bias']['deviation'])
    renamed = process_log(replace(one, entry=FleetLog(one.entry.log, unit='7', temperature=21.0)))
    assert renamed == {**first, 'unit': '7', 'temperature': 21.0}
    assert one.record_path.stat().st_mtime_ns == stamp
    one.record_path.write_text('{"key": "of another version"}')
    assert process_log(one) == first and one.record_path.read_bytes() == kept


@pytest.mark.parametrize(('make', 'code', 'wanted'), [
    (lambda path: path.mkdir(), 2, 'holds no log'),
    (lambda path: path.mkdir() or (path / 'a.csv').write_text('?'), 1, 'none of 1 logs')])
def test_where_nothing_can_be_done_one_sentence_says_why(tmp_path, capsys, make, code, wanted):
    make(tmp_path / 'logs')
    assert run(tmp_path / 'logs', '--out', tmp_path / 'out') == code
    out, error = capsys.readouterr()
    assert not out and wanted in error and error.count('\n') == 1


def crossed(values):
    """Return values of units by drives, each with a small error of its own."""
    unit, drive = np.indices(values.shape).reshape(2, -1)
    return Observations(values.ravel(), np.full(values.size, 1e-6), unit, drive)


def test_balanced_data_give_the_variances_of_an_analysis_of_variance():
    values = np.random.default_rng(5).standard_normal((6, 5))
    values += 3.0 * np.arange(6)[:, None] + 2.0 * np.arange(5)
    found = PooledValue(crossed(values)).components
    units, drives = values.mean(axis=1), values.mean(axis=0)
    rest = np.sum((values - units[:, None] - drives + values.mean()) ** 2) / 20.0
    for name, wanted in (('units', np.var(units, ddof=1) - rest / 5.0),
                         ('drives', np.var(drives, ddof=1) - rest / 6.0), ('power_ons', rest)):
        assert found[name].value == pytest.approx(np.sqrt(wanted), rel=2e-3)
        assert found[name].low < found[name].value < found[name].high


def test_what_the_units_of_a_drive_share_does_not_move_a_unit():
    """The error of the reference of one drive is many times the difference between units."""
    values = np.array([[1.0, 1.1, 1.0, 0.9], [2.0, 1.9, 2.0, 2.1], [3.1, 3.0, 3.0, 2.9],
                       [4.0, 4.0, 4.1, 4.0]]) + np.array([0.0, 0.0, 0.0, 40.0])
    pooled = PooledValue(crossed(values))
    rows = np.zeros((4, 1))
    apart = pooled.estimate(unit=np.arange(4), fixed=rows).value
    assert apart - apart[0] == pytest.approx([0.0, 1.0, 2.0, 3.0], abs=0.1)


def test_a_unit_that_stands_out_and_one_that_changes_are_named_and_no_other():
    generator = np.random.default_rng(8)
    values = generator.standard_normal((12, 1)) + 0.2 * generator.standard_normal((12, 6))
    date = np.tile(np.arange(6), 12)
    names = [str(number) for number in range(12)]
    assert find_outlying_groups(PooledValue(crossed(values)), 'units', names, 0.01) == []
    assert find_changes(PooledValue(crossed(values)), date, names, names, 0.01) == []
    values[3] += 12.0
    values[7, 4:] += 3.0
    pooled = PooledValue(crossed(values))
    assert [each.name for each in find_outlying_groups(pooled, 'units', names, 0.01)] == ['3']
    (change,) = find_changes(pooled, date, names, names, 0.01)
    assert ((change.name, change.since) == ('7', '4')
            and change.size == pytest.approx(3.0, abs=0.5))


def records():
    """Return records of five units on four drives."""
    generator = np.random.default_rng(9)
    off = 0.1 * np.arange(4)

    def of(value, deviation, unit):
        return {'value': value, 'deviation': deviation, 'unit': unit}
    return [
        {'log': f'{drive}{unit}', 'unit': str(unit), 'type': 'DOT', 'drive': 'hijk'[drive],
         'date': '', 'temperature': None, 'diagnosis': None, 'page': '',
         'noise': {'angle_random_walk': 1e-4},
         'values': {'bias': of(unit + 1e-3 * generator.standard_normal(), 1e-3, 'rad/s'),
                    'time_offset': of(off[drive] + 1e-3 * generator.standard_normal(), 1e-3, 's')}}
        for unit in range(5) for drive in range(4)]


def test_each_value_is_laid_to_the_unit_or_the_reference():
    (found,) = summarize_types(records())
    told = '; '.join(describe_type(found))
    assert 'bias is an error of the unit' in told
    assert 'time offset is an error of the reference' in told
    assert 'differs from its type' not in told
    json.dumps(data(found), allow_nan=False)


@pytest.mark.parametrize('unit', ['0', '4'])
def test_a_unit_whose_logs_lack_a_value_is_left_out_of_that_value_only(unit):
    logs = [{**each, 'values': {'bias': each['values']['bias']}}
            if each['unit'] == unit else each for each in records()]
    (found,) = summarize_types(logs)
    assert set(found.values['bias'].units) == {*'01234'}
    assert set(found.values['time_offset'].units) == {*'01234'} - {unit}
    assert set(dict(build_models(found))) == {'', *'01234'}


def test_effects_of_diagnoses_are_laid_to_whose_logs_show_them_too_often():
    shown = {'hysteresis': lambda unit, drive: True, 'reference_scale': lambda unit, drive: True,
             'bandwidth': lambda unit, drive: unit == '2', 'outliers': lambda unit, drive: drive
             == 'j', 'quantization': lambda unit, drive: (unit, drive) in (('1', 'h'), ('3', 'k')),
             'bias': lambda unit, drive: True}
    (found,) = summarize_types([{**each, 'diagnosis': {'findings': [
        {'effect': name, 'status': 'established'} for name, of in shown.items()
        if of(each['unit'], each['drive'])] + [{'effect': 'dead_zone', 'status': 'suspected'}]}}
        for each in records()])
    assert {each.effect: (each.owner, each.name, each.logs) for each in count_effects(found)} == {
        'hysteresis': ('type', '', 20), 'reference_scale': ('type', '', 20),
        'bandwidth': ('unit', '2', 4), 'outliers': ('drive', 'j', 5), 'quantization': ('', '', 2)}
    told = '; '.join(describe_type(found))
    assert 'hysteresis: established in 20 of 20 logs, of 5 of 5 units: the model' in told
    assert 'reference scale: established in 20 of 20 logs, of 5 of 5 units: the ref' in told


def test_units_whose_drift_over_temperature_differs_have_slopes_of_their_own():
    generator, degc, years = np.random.default_rng(21), 5.0 * np.arange(8), 0.125 * np.arange(8)
    slopes = 1e-4 * (2.0 + generator.standard_normal(8))
    logs = [{**records()[0], 'log': f'{unit}-{place}', 'unit': str(unit), 'drive': '',
             'date': str(date(2026, 1, 1) + timedelta(365.25 * age)), 'temperature': temperature,
             'values': {'bias': {'value': unit + slope * temperature + 2e-3 * age
                                 + 1e-4 * generator.standard_normal(), 'deviation': 1e-5,
                                 'unit': 'rad/s'}}}
            for unit, slope in enumerate(slopes)
            for place, (temperature, age) in enumerate(
                zip(generator.permutation(degc).tolist(), years))]
    (found,) = summarize_types(logs)
    shown = data(found)['values']['bias']
    low, high = shown['between_units_over_temperature']['ci95']
    assert 0.0 < low < np.std(slopes, ddof=1) < high
    assert shown['between_units_over_age']['ci95'][0] == 0.0
    assert shown['slopes']['age']['ci95'][0] < 2e-3 < shown['slopes']['age']['ci95'][1]
    ends = np.array([shown['units'][str(unit)]['slopes']['temperature']['ci95']
                     for unit in range(8)])
    assert np.sum((ends[:, 0] < slopes) & (slopes < ends[:, 1])) >= 6


def test_the_prior_of_a_type_and_of_a_unit_is_what_the_fleet_shows(tmp_path):
    (found,) = summarize_types(records())
    said = dict(build_models(found))
    assert set(said) == {'', *'01234'}
    bias = found.values['bias']
    for name, interval in (('', bias.new_unit), ('3', bias.next_power_on['3'])):
        write_model(tmp_path / 'model.yaml', said[name])
        model = read_model(tmp_path / 'model.yaml')
        values = {term.effect.name: term.values[0] for term in model.terms}
        assert np.isinf(model.prior_deviations[0])  # the logs do not determine the scale
        spread = model.prior_deviations[1]
        assert set(values) == {'bias'} and model.gyro['name'] == 'DOT'
        assert values['bias'] - 1.96 * spread == pytest.approx(interval.low)
        assert values['bias'] + 1.96 * spread == pytest.approx(interval.high)
    assert GyroModel(tolerance=Tolerance(bias=1.0)).prior_deviations is None


def test_a_diagnosis_by_a_course_takes_what_is_usual_of_a_fleet_as_its_prior():
    """20 s with a course error of 2 deg determine the bias less well than the type does."""
    generator = np.random.default_rng(4)
    time = np.arange(0.0, 20.1, 0.05)
    course = np.sin(2.0 * np.pi * time / 10.0)
    output = np.gradient(course, time) + 0.0105 + 1e-3 * generator.standard_normal(len(time))
    seen: np.ndarray = np.full(len(time), np.nan)
    seen[::3] = course[::3] + 2.0 * DEGREE * generator.standard_normal(len(time[::3]))
    log = Log(time=time, output=output, reference_heading=seen)
    given = GyroModel((Term(CATALOGUE['bias'], (0.01,)),), np.zeros((1, 1)),
                      tolerance=Tolerance(bias=5e-4), origin={'fleet': {'logs': 5}})
    alone, drawn, kept = (diagnose([log], generator, model, reference_kind='course').model
                          for model in (None, given, replace(given, origin={})))
    values, deviations = zip(*(_bias(model) for model in (alone, drawn)))
    assert deviations[1] < 5.01e-4 < deviations[0]  # hardly more than that of the type
    assert abs(values[1] - 0.0105) < 3.0 * deviations[1]
    assert drawn.prior_deviations is None and drawn.tolerance == Tolerance()
    assert kept.terms == given.terms  # the tolerance of a laboratory is no prior


def _bias(model):
    (place,) = [place for place, each in enumerate(model.terms) if each.effect.name == 'bias']
    return model.terms[place].values[0], np.sqrt(model.covariance[place, place])
