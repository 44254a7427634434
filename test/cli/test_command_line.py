# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The program as people and other programs call it."""

from dataclasses import replace
import hashlib
import io
import json
import math
import os
import re
import shlex
import subprocess
import sys

from gyro_calibration.cli import verb
from gyro_calibration.cli.main import find_verbs
from gyro_calibration.driver.protocols import find_protocol
from gyro_calibration.logs.log import DEGREE, Log, read_log, write_log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.motion import ROBOT_MOTION
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

GYRO = 'effects: {bias: {bias: 0.002}, scale_factor_error: {scale_factor_error: -0.1}}'
NOISY_GYRO = GYRO + '\nnoise: {angle_random_walk: 7.3e-4}'


@pytest.fixture
def model(tmp_path):
    path = tmp_path / 'model.yaml'
    path.write_text(GYRO)
    return path


@pytest.fixture
def log(run, model, tmp_path):
    path = tmp_path / 'log.csv'
    assert run('simulate', '--model', model, '--motion', 'calibration', '--out', path,
               '--seed', 1)[0] == 0
    return path


@pytest.mark.parametrize('verb', find_verbs())
def test_a_verb_has_help_with_an_example_and_follows_the_technology_or_says_why_not(run, verb):
    code, text, _ = run(verb, '--help')
    assert (code == 0 and f'example: gyro_calibration {verb}' in ' '.join(text.split())
            and '--json' in text)
    follows = '--technology' in text
    assert follows == (verb in ('fit', 'turn', 'fleet'))
    if verb in ('allan', 'diagnose', 'turn'):
        code, _, error = run(verb, 'log.csv', '--model', 'model.yaml', '--technology', 'mems')
        assert code == 2 and ('give one of the two' if follows else '--technology') in error


#: A command line, and what its answer says; an unset variable of the shell is an empty argument.
WRONG = {
    **{words: f'perhaps {near} is meant' for words, near in {
        'fit log.csv --effects bais': 'bias',
        'allan log.csv --columns tim=t': 'time', 'allan log.csv --columns gyro=w:deg/sec': 'deg/s',
        'allan log.csv --columns gyro=gyro_dsp': 'gyro_dps',
        'compensate log.csv --model bais.yaml --out x.csv': 'bias',
        'simulate --model model.yaml --motion robt --out x.csv': 'robot',
        'emulate --protocol kvh_dsp300 --model model.yaml': 'kvh_dsp3000',
        'plan --limits limits.yaml': 'maximum_rate_dps'}.items()},
    'diagnose log.csv --seed x': "'x' is no number", 'allan log.csv --rate 0': 'a number above 0',
    'diagnose log.csv --out log.csv': 'log.csv: is a file, but must be a folder',
    'fleet log.csv --out log.csv': 'log.csv: is a file, but must be a folder',
    'compensate missing.csv --model model.yaml --out x.csv': 'missing.csv: cannot be read',
    'compensate log.csv --model missing.yaml --out x.csv': 'missing.yaml: there is no such file',
    'compensate log.csv --model model.yaml --out ""': 'is empty; give a value or omit it',
    'fit ""': 'is empty; give a value or omit it',
    'compensate log.csv --model silent.yaml --out x.csv --rest': 'run allan to add it',
    'emulate --protocol morse --model model.yaml': "protocol 'morse' is not known",
    'emulate --protocol fizoptika --model model.yaml': 'sensitivity is not set',
    'reproduce ojeda --seed -1': '-1 is out of range', 'dance': 'invalid choice', '': 'required',
    'reproduce newton': 'hong_park',
    'self-calibrate log.csv --turns 3 --profile p.csv': 'give one of them',
    'self-calibrate log.csv --marking 2': 'both or none', 'export --to unity model.yaml': 'unity',
    'export --to sdf model.yaml --span 0.001': 'is shorter than two samples',
    'export --to sdf model.yaml --sample-rate 0': 'is out of range',
    'simulate --model model.yaml --motion waltz --out x.csv': 'waltz: there is no such motion',
    'compensate log.csv --model model.yaml --out x.csv --threshold -1': 'a number of 0 or more',
    **{f'simulate --model model.yaml --motion rest --out x.csv {option}': said
       for option, said in {
           '--sample-rate 1e-300': '', '--sample-rate 1e300': '', '--sample-rate 1e9': '',
           '--temperature nan': '', '--temperature 1e9': '',
           '--sample-rate 0.001': 'fewer than two samples'}.items()}}


@pytest.mark.parametrize('words, said', WRONG.items(), ids=WRONG)
def test_wrong_use_is_answered_in_one_line_with_what_is_right_and_writes_nothing(
        run, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    for name, text in {'log.csv': 'time_s,gyro_dps,w\n0,1,1\n1,2,2\n', 'model.yaml': NOISY_GYRO,
                       'silent.yaml': GYRO, 'bais.yaml': 'effects: {bais: {bias: 0.1}}',
                       'limits.yaml': 'maximum_rat_dps: 1'}.items():
        (tmp_path / name).write_text(text)
    before = os.listdir()
    code, text, error = run(*shlex.split(words))
    assert (code, text, error.count('\n')) == (2, '', 1) and said in error, error
    assert os.listdir() == before


def test_simulate_then_compensate_gives_the_true_heading_back(compensate, model, log):
    done = compensate(log, model, '--json')
    answer = json.loads(done.text)
    assert answer['rows'] == 2001 and abs(answer['heading_rad']) < 1e-9
    assert answer['mean_heading_error_rad'] < 1e-9 and 'errors' not in answer
    assert answer['heading_std_rad'] is None  # the model has neither noise nor covariance
    np.testing.assert_allclose(done.columns['heading_rad'], done.log.reference_heading, atol=1e-9)
    np.testing.assert_allclose(done.columns['rate_rad_s'], done.log.reference_rate, atol=1e-12)


def test_compensate_measures_the_error_against_the_reference_from_its_first_row_on(compensate):
    reference = np.arange(200) * 1e-3 + 2.0
    reference[:20], reference[100:] = np.nan, reference[100:] - 0.01
    text = compensate(Log(output=np.full(200, 0.1), time=np.arange(200) / 100.0,
                          reference_heading=reference), 'effects: {}').text
    assert ('Error against the reference heading: mean 0.318 deg, at the end 0.573 deg.' in text
            and 'temperature' not in text)


@pytest.mark.parametrize('noise', ['', '\nnoise: {angle_random_walk: 1.0e-4}'])
def test_compensate_warns_of_a_model_without_noise_figures(compensate, noise):
    log = Log(output=np.full(300, 0.1), time=np.arange(300) / 100.0)
    model = f'effects: {{bias: {{bias: 0.01}}}}\ncovariance: [[1.0e-8]]{noise}'
    assert ('no noise figures' in compensate(log, model).text) == (not noise)
    assert json.loads(compensate(log, model, '--json').text)['noise_is_known'] == bool(noise)


@pytest.mark.parametrize('words, said', [((), '0 was used'), (('--rest',), 'first steady rate')])
@pytest.mark.parametrize('effects, known', [
    ('{scale_factor_error: {scale_factor_error: 0.01}}', False), ('{bias: {bias: 0.01}}', True)])
def test_compensate_warns_of_a_bias_that_is_not_calibrated(compensate, words, said, effects,
                                                           known):
    generator = np.random.default_rng(1)
    rate = np.where(np.arange(3000) < 1500, 0.3 * DEGREE, 0.0)
    log = Log(output=rate + 0.01 * known + 1e-3 * generator.standard_normal(3000),
              time=np.arange(3000) / 100.0)
    model = f'effects: {effects}\ncovariance: [[1.0e-8]]\nnoise: {{angle_random_walk: 1.0e-4}}'
    text = compensate(log, model, *words).text
    assert ('The bias is not known from a calibration' in text and said in text) != known
    answer = json.loads(compensate(log, model, *words, '--json').text)
    assert answer['bias_is_calibrated'] == known
    assert ('a change of the bias with it is not in the standard deviation' in text) == bool(words)
    assert ('The scale factor error is not known from a calibration: 3 %' in text) == (
        known and bool(words))
    if words:
        assert (answer['bias_ambiguity_rad_s'] > 0.1 * DEGREE) != known
        assert ('everal steady rates may be that of a rest' in text) != known


@pytest.mark.parametrize('words', [(), ('--rest',), ('--hindsight',)])
def test_compensate_does_not_take_another_unit_of_time_for_seconds(compensate, words):
    in_ms = Log(output=np.full(300, DEGREE), time=10.0 * np.arange(300))
    done = compensate(in_ms, NOISY_GYRO, *words)
    said = done.error if words else done.text
    assert done.code == bool(words) and '10 s apart' in said and 'the unit of time_s' in said


def test_compensate_gives_rates_alone_for_a_rate_table(compensate, model):
    columns = compensate(Log(output=[0.0, 0.16], reference_rate=[0.0, 0.17]), model).columns
    assert 'rate_rad_s' in columns and 'heading_rad' not in columns


def test_a_new_model_names_its_log_and_a_given_one_keeps_its_origin(run, log, model, tmp_path):
    write_log(tmp_path / 'rest.csv',
              Log(output=np.random.default_rng(1).normal(size=2000), time=np.arange(2000) / 100.0))
    for name, given in (('self-calibrate', log), ('allan', tmp_path / 'rest.csv')):
        assert run(name, given, '--out', tmp_path / 'new.yaml')[0] == 0
        origin = read_model(tmp_path / 'new.yaml').origin
        assert origin['files'] == [{'name': given.name,
                                    'sha256': hashlib.sha256(given.read_bytes()).hexdigest()}]
        assert origin['date'] and origin['program'].startswith('gyro_calibration ')
        assert run(name, given, '--model', model, '--out', tmp_path / 'new.yaml')[0] == 0
        assert read_model(tmp_path / 'new.yaml').origin == {}


@pytest.mark.parametrize('words', [(), ('--turns', 'nearest')], ids=['profile', 'turns'])
def test_self_calibrate_by_a_model_that_looks_around_leaves_nothing_to_calibrate(
        run, tmp_path, words):
    """A gyro that agrees with its model: the effect of its specific force is no bias."""
    (tmp_path / 'model.yaml').write_text(
        'effects: {acceleration_sensitivity: {acceleration_sensitivity: 0.001}}')
    rate = np.concatenate([np.zeros(500), np.full(2000, math.tau / 20.0), np.zeros(500)])
    output = rate + 0.00981 + 1e-6 * np.random.default_rng(0).standard_normal(3000)
    write_log(tmp_path / 'log.csv', Log(output=output, time=np.arange(3000) / 100.0,
                                        specific_force=np.full(3000, 9.81), reference_rate=rate))
    code, text, error = run('self-calibrate', tmp_path / 'log.csv',
                            '--model', tmp_path / 'model.yaml', '--json', *words)
    assert code == 0, error
    assert abs(json.loads(text)['bias']) < 1e-5


def test_a_run_in_counts_is_refused_for_its_implausible_turns(run, log, tmp_path):
    in_rates = read_log(log)
    write_log(tmp_path / 'counts.csv', replace(in_rates, output=145.0 * in_rates.output))
    code, _, error = run('self-calibrate', tmp_path / 'counts.csv')
    assert code == 1 and 'times what was turned: correct its unit or sensitivity' in error, error


def test_a_log_of_counts_wants_its_sensitivity(compensate, model):
    log = Log(counts=np.full(10, 100.0))
    done = compensate(log, model, '--rate', 10)
    assert done.code == 2 and '--sensitivity' in done.error
    done = compensate(log, model, '--rate', 10, '--sensitivity', 0.07)
    assert done.columns['rate_rad_s'] == pytest.approx((7 * DEGREE - 0.002) / 0.9)


def test_the_same_seed_gives_the_same_log_and_the_seed_is_reported(run, tmp_path):
    (tmp_path / 'model.yaml').write_text(NOISY_GYRO)
    words = ['simulate', '--model', tmp_path / 'model.yaml', '--motion', 'rest', '--json', '--out']
    seed = json.loads(run(*words, tmp_path / 'a.csv')[1])['seed']
    run(*words, tmp_path / 'b.csv', '--seed', seed)
    assert (tmp_path / 'a.csv').read_bytes() == (tmp_path / 'b.csv').read_bytes()


@pytest.mark.parametrize('outputs', ['nan,nan', 'nan,1'])
def test_emulate_sends_no_log_without_an_output(run, tmp_path, outputs):
    (tmp_path / 'log.csv').write_text('time_s,gyro_dps\n' + ''.join(
        f'{row},{each}\n' for row, each in enumerate(outputs.split(','))))
    code, text, error = run('emulate', '--protocol', 'csv', '--log', tmp_path / 'log.csv',
                            '--repeat')
    assert (code == 1 and not text
            and 'of 2 samples have an output; give a log with two or more' in error)


def test_emulate_prints_its_path_first_and_sends_the_model(model, tmp_path):
    command = [sys.executable, '-m', 'gyro_calibration', 'emulate', '--protocol', 'kvh_dsp3000',
               '--model', model, '--json', '--motion', 'calibration', '--wait',
               '--link', tmp_path / 'gyro']
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert json.loads(process.stdout.readline())['path'] == str(tmp_path / 'gyro')
        decoder, samples, port = (find_protocol('kvh_dsp3000').decoder(), [],
                                  os.open(tmp_path / 'gyro', os.O_RDONLY | os.O_NOCTTY))
        while len(samples) < 30:
            samples += decoder.feed(os.read(port, 1000))
        assert samples[0].output == pytest.approx(0.002, abs=1e-7)
        os.close(port)
    finally:
        process.terminate()
        assert process.wait(10) == 0
    assert not (tmp_path / 'gyro').exists(), 'the link was left behind'


def test_the_demonstration_takes_off_most_of_the_heading_error_and_leaves_picture_table_and_log(
        ros_domain, tmp_path):
    pytest.importorskip('matplotlib', reason='matplotlib is not installed')
    folder = tmp_path / 'demo'
    process = subprocess.run([sys.executable, '-m', 'gyro_calibration', 'demo',
                              '--out', folder, '--seed', '2', '--json'],
                             capture_output=True, text=True, timeout=240)
    assert process.returncode == 0 and 'Traceback' not in process.stderr, process.stderr
    errors = json.loads(process.stdout)['mean_error_deg']
    assert max(errors['both'], errors['rests tracked']) < 0.6 * errors['pure integration']
    assert (folder / 'heading.png').read_bytes().startswith(b'\x89PNG')
    assert 'Hong and Park' in (folder / 'table.md').read_text()
    assert len(read_log(folder / 'log.csv')) > 4000


def test_a_method_that_gives_no_standard_deviation_claims_none(run, compensate, log, tmp_path):
    code, text, _ = run('self-calibrate', log, '--method', 'rate', '--out', tmp_path / 'new.yaml')
    assert code == 0 and '+-' not in text
    assert read_model(tmp_path / 'new.yaml').self_calibration.covariance is None
    assert np.isnan(compensate(log, tmp_path / 'new.yaml').columns['heading_std_rad'][-1])


# progress, which is shown on a terminal, with the elapsed time, and nowhere else

class Terminal(io.StringIO):

    def isatty(self):
        return True


def test_a_long_step_is_shown_with_share_and_time_and_cleared_after_it(monkeypatch, wait_until):
    for stream, delay in ((Terminal(), 20.0), (io.StringIO(), 0.0), (Terminal(), 0.01)):
        monkeypatch.setattr(sys, 'stderr', stream)
        monkeypatch.setattr(verb, 'PROGRESS_DELAY', delay)
        with verb.show_progress('fit') as on_progress:
            on_progress(0.5, 'search')
            if delay == 0.01:
                wait_until(lambda: 'search' in sys.stderr.getvalue())
        assert bool(stream.getvalue()) == (delay == 0.01), 'a short step, or no terminal'
    assert re.search(r' 50 %  search \.\.\.  \d+ s.*\r +\r$', stream.getvalue(), re.DOTALL)


# Long logs, which compensate processes in blocks

CLIPPED = ('effects: {bias_temperature: {bias_temperature: 1.0e-4}}\n'
           'valid: {rate: [-0.8, 0.8], temperature: [26.0, 45.0]}\n'
           'noise: {angle_random_walk: 7.3e-4}\n'
           'self_calibration: {scale_factor_error: 0.01, bias: 0.001, '
           'covariance: [[1.0e-6, 0.0], [0.0, 1.0e-8]]}\n')


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr('gyro_calibration.cli.compensate.CACHE_BLOCK_SAMPLES', 300)
    monkeypatch.setattr('gyro_calibration.logs.log.CACHE_BLOCK_SAMPLES', 300)


WORDS = {'plain': [], 'threshold': ['--threshold', '0.3'], 'inverted': ['--invert'],
         'at a rate': ['--rate', '100'], 'unwrapped': ['--unwrap']}


@pytest.mark.parametrize('words', WORDS.values(), ids=WORDS)
def test_a_log_in_blocks_gives_the_columns_of_one_piece(words, request, compensate):
    time = np.arange(4001) / 100.0
    log = Log(time, ROBOT_MOTION.rate_at(time), temperature=35.0 + 12.0 * np.sin(time / 20.0))
    log.output[[0, 1, *range(289, 1299), 4000]] = np.nan  # whole blocks, and the last row
    whole = compensate(log, CLIPPED, '--json', *words)
    request.getfixturevalue('small_blocks')
    blocks = compensate(log, CLIPPED, '--json', *words)
    assert whole.text == blocks.text and '"rows_without_output": 1013' in whole.text
    assert list(whole.columns) == list(blocks.columns) and len(whole.columns) == 6
    for name, values in whole.columns.items():
        np.testing.assert_allclose(blocks.columns[name], values, rtol=1e-12, err_msg=name)


def test_a_log_without_any_output_is_refused(small_blocks, compensate):
    done = compensate(Log(output=np.full(1000, np.nan), time=np.arange(1000.0)), CLIPPED)
    assert done.code == 1 and 'no gyro output is finite' in done.error and done.log is None


@pytest.mark.parametrize('time, output, interval', [
    # a gap of 3 s, then only every other sample
    (np.cumsum([0.0, *np.full(499, 0.01), 3.0, *np.full(500, 0.02)]), np.zeros(1001), 0.01),
    # a table writes a row at 100 Hz, and the gyro has a value in one of ten
    (np.arange(2000) / 100.0, np.where(np.arange(2000) % 10, np.nan, 0.0), 0.1)],
    ids=['gaps', 'rows of others'])
def test_a_rate_is_as_noisy_as_samples_of_the_first_interval(
        small_blocks, compensate, time, output, interval):
    deviation = compensate(Log(output=output, time=time), GyroModel(noise=Noise(7.3e-4))).columns[
        'rate_std_rad_s']
    assert deviation[np.isfinite(output)] == pytest.approx(7.3e-4 / math.sqrt(interval), rel=1e-9)
