# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Files that are no files, that cannot be opened, that grow without end, or that say odd things.

Each ends within seconds in one sentence that names it and says what to do, or is read for what it
is; what was there before is there afterwards.
"""

import json
import os
import re
import signal
import socket
import stat
import struct
import tracemalloc

from conftest import strict
from gyro_calibration.files import to_printable, write_atomically
from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.logs.cdr import IMU
from gyro_calibration.logs.log import LogError, read_log
from gyro_calibration.logs.ros_bag import Contents, read_messages
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.model_file import ModelError, read_model, write_model
from gyro_calibration.model.motion import MotionError, read_motion
from gyro_calibration.ros.state_store import StateStore
import numpy as np
import pytest
from recordings import channel, chunk, database, MCAP, record

MODEL = 'effects: {bias: {bias: 0.001}}\nnoise: {angle_random_walk: 1.0e-4}\n'
ROWS = ''.join(f'{row / 100:.2f},{0.1 * (row % 7)}\n' for row in range(400))
LONG = 300 * 'x'


@pytest.fixture(autouse=True)
def _within_seconds():
    def fail(*_):
        raise TimeoutError('it waits')
    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / 'model.yaml').write_text(MODEL)
    (tmp_path / 'log.csv').write_text('time_s,gyro_dps\n' + ROWS)
    return tmp_path


def make_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


KINDS = {'a pipe': os.mkfifo, 'a socket': make_socket, 'a folder': os.mkdir,
         'a device': lambda path: os.symlink('/dev/zero', path)}
each_kind = pytest.mark.parametrize('kind', KINDS)


@each_kind
@pytest.mark.parametrize('read, error, name', [
    (lambda path: read_log(path), LogError, 'a.csv'),
    (lambda path: read_log(path), LogError, 'a.csv.gz'),
    (lambda path: read_model(path), ModelError, 'a.yaml'),
    (lambda path: read_motion(path), MotionError, 'a.csv'),
    (lambda path: list(read_messages(path, Contents())), LogError, 'a.mcap'),
    (lambda path: list(read_messages(path, Contents())), LogError, 'a.mcap.zstd'),
    (lambda path: list(read_messages(path, Contents())), LogError, 'a.db3'),
], ids=['log', 'packed log', 'model', 'motion', 'mcap', 'packed mcap', 'db3'])
def test_what_is_no_file_is_not_read(read, error, name, kind, tmp_path):
    KINDS[kind](tmp_path / name)
    before = len(os.listdir('/proc/self/fd'))
    with pytest.raises(error) as raised:
        read(tmp_path / name)
    assert str(tmp_path / name) in str(raised.value)
    assert kind in str(raised.value) or name.endswith('3') or kind == 'a folder', raised.value
    assert len(os.listdir('/proc/self/fd')) == before, 'it was left open'


@each_kind
def test_what_is_no_file_is_not_replaced(kind, folder, run):
    words = ['compensate', folder / 'log.csv', '--model', folder / 'model.yaml', '--out']
    for name in 'there.csv', 'calibration.yaml':
        KINDS[kind](folder / name)
    before = {path.name: stat.S_IFMT(path.lstat().st_mode) for path in folder.iterdir()}
    code, _, error = run(*words, folder / 'there.csv')
    assert code == 2 and f'there.csv: it is {kind}, where a file is wanted; name a file' in error
    store = StateStore('', folder / 'calibration.yaml', folder / 'biases.yaml', Prior())
    assert kind in store.calibration_hint and store.model.self_calibration is None
    assert ('NOT STORED' in store.store_calibration(SelfCalibration(0.01, 0.02))
            and 'name a file' in store.calibration_hint)
    assert {path.name: stat.S_IFMT(path.lstat().st_mode) for path in folder.iterdir()} == before


@pytest.mark.parametrize('path, words', [
    (f'{LONG}.csv', 'file name too long'), (f'log.csv/{LONG}.csv', 'a directory|file exists'),
    ('log.csv/a.csv', 'a directory|file exists'),
    ('circle.csv', 'too many levels of symbolic links')])
def test_what_cannot_be_opened_is_reported_with_its_remedy(path, words, folder, run):
    (folder / 'circle.csv').symlink_to(folder / 'circle.csv')
    path = folder / path
    for read, error in (read_log, LogError), (read_model, ModelError), (read_motion, MotionError):
        with pytest.raises(error) as raised:
            read(path)
        assert re.search(words, str(raised.value))
    store = StateStore(str(path), path, path.with_suffix('.yaml'), Prior())
    assert 'uncalibrated' in store.problem and str(path) in store.problem
    store = StateStore('', path, path.with_suffix('.yaml'), Prior())
    if 'circle' not in path.name:  # a link is replaced by what is written
        said = store.store_calibration(SelfCalibration())
        assert 'NOT STORED' in said and re.search(words, said)
        code, _, error = run('compensate', folder / 'log.csv', '--model', folder / 'model.yaml',
                             '--out', path)
        assert code == 2 and error.count('\n') == 1 and re.search(words, error) and ';' in error
    code, _, error = run('compensate', path, '--model', folder / 'model.yaml',
                         '--out', folder / 'out.csv')
    assert code == 2 and error.count('\n') == 1 and path.name in error


def test_the_longest_name_that_there_may_be_is_written(folder):
    path = folder / (251 * 'x' + '.csv')
    write_atomically(path, b'new')
    write_atomically(path, b'newer')
    assert path.read_bytes() == b'newer' and len(os.listdir(folder)) == 3


@pytest.mark.parametrize('step', ['fsync', 'replace'])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, step):
    path = tmp_path / 'model.yaml'
    write_atomically(path, b'old')

    def fail(*_):
        raise OSError(28, 'No space left on device')
    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match='No space left'):
        write_atomically(path, b'new')
    assert path.read_bytes() == b'old' and os.listdir(tmp_path) == ['model.yaml']


def test_a_folder_that_takes_no_file_is_reported_by_the_name_that_was_given():
    with pytest.raises(FileNotFoundError) as refused:
        write_atomically('/proc/model.yaml', b'new')
    assert refused.value.filename == '/proc/model.yaml'


def test_a_link_is_replaced_a_file_keeps_its_mode_and_a_new_one_has_that_of_the_umask(tmp_path):
    (tmp_path / 'precious').write_text('precious')
    (tmp_path / 'new').symlink_to(tmp_path / 'precious')
    before = os.umask(0o027)
    try:
        write_atomically(tmp_path / 'new', b'x')
        assert (tmp_path / 'precious').read_text() == 'precious'
        assert (tmp_path / 'new').lstat().st_mode & 0o777 == 0o640
        for mode in (0o600, 0o664, 0o400):
            (tmp_path / 'new').chmod(mode)
            write_atomically(tmp_path / 'new', b'y')
            assert (tmp_path / 'new').stat().st_mode & 0o777 == mode
    finally:
        os.umask(before)


ESCAPES = '\x1b[31m\x9b2J\u202e\u2066\x07\r'


def test_nothing_that_a_terminal_obeys_is_printed(folder, run):
    name = folder / f'a{ESCAPES}b.csv'
    name.write_bytes((folder / 'log.csv').read_bytes())
    model, out = folder / 'model.yaml', folder / f'o{ESCAPES}.csv'
    tries = [('compensate', name, '--model', model, '--out', out),
             ('compensate', name, '--model', model, '--out', out, '--json'),
             ('compensate', f'{name}2', '--model', model, '--out', out),
             ('compensate', folder / 'log.csv', '--model', f'{model}{ESCAPES}', '--out', out),
             ('compensate', name, f'--{ESCAPES}'),
             ('simulate', '--motion', ESCAPES, '--model', model, '--out', out), ('allan', name),
             ('diagnose', name, '--out', folder / 'd'), ('fit', name, '--out', folder / 'm.yaml')]
    for text in (f'time_s,gyro_dps{ESCAPES}\n0,1\n', f'time_s,gyro_dps\n0,{ESCAPES}\n1,1\n',
                 f'{ESCAPES},gyro_dps,gyro_rad_s\n0,1,2\n'):
        path = folder / f'{len(tries)}.csv'
        path.write_text(text, newline='')
        tries.append(('compensate', path, '--model', model, '--out', out))
    path = folder / 'named.yaml'
    path.write_text(
        MODEL + f'gyro: {{name: {json.dumps(ESCAPES)}}}\nbad{json.dumps(ESCAPES)}: 1\n')
    tries.append(('compensate', folder / 'log.csv', '--model', path, '--out', out))
    for words in tries:
        code, answer, error = run(*words)
        assert code in (0, 1, 2) and answer + error
        assert not [each
                    for each in answer + error if not each.isprintable() and each != '\n'], words


# Files that need much memory

def mcap(content, compression, times, size=None):
    """Return a recording of chunks that unfold to a content, and say that it has a size."""
    compress = {'zstd': lambda data:
                pytest.importorskip('zstandard').ZstdCompressor(level=19).compress(data),
                'lz4': lambda data: pytest.importorskip('lz4.frame').compress(data)}[compression]
    return MCAP + channel(1, '/imu', IMU) + times * chunk(
        compress(content), compression, size or len(content))


def small_messages(size):
    message = record(5, struct.pack('<HIQQ', 1, 0, 0, 0))
    return message * (size // len(message))


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
@pytest.mark.parametrize('content', [bytes, small_messages], ids=['zeros', 'messages'])
def test_a_small_recording_that_unfolds_to_gigabytes_is_refused(content, compression, tmp_path):
    (tmp_path / 'a.mcap').write_bytes(mcap(content(64 << 20), compression,
                                           40 if compression == 'zstd' else 1))
    refused(tmp_path / 'a.mcap', UNFOLDS)


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_is_never_larger_than_it_says(compression, tmp_path):
    (tmp_path / 'a.mcap').write_bytes(mcap(small_messages(64 << 20), compression, 1, size=1000))
    assert len(list(read_messages(tmp_path / 'a.mcap', Contents()))) == 1000 // 31


def test_messages_and_files_that_unfold_are_counted_too(tmp_path, monkeypatch):
    compress = pytest.importorskip('zstandard').compress
    message = record(5, struct.pack('<HIQQ', 1, 0, 0, 0) + compress(bytes(1 << 16)))
    (tmp_path / 'a.mcap').write_bytes(mcap(message * 20_000, 'zstd', 1))
    refused(tmp_path / 'a.mcap', UNFOLDS)
    monkeypatch.setattr('gyro_calibration.logs.ros_bag.MAX_RECORD_BYTES', 1 << 23)
    (tmp_path / 'a.db3.zstd').write_bytes(compress(bytes(1 << 26)))
    refused(tmp_path / 'a.db3.zstd', UNFOLDS)


UNFOLDS = 'decompresses to more than 100 times its size'


def refused(path, words):
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=words):
            for _ in read_messages(path, Contents()):
                pass
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 60 << 20


PLAIN = (
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB')
VIEW = ('CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) '
        'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(99) AS data FROM n')


@pytest.mark.parametrize('messages, more, words', [
    (PLAIN + ' AS (CAST(hex(zeroblob(100000 + id)) AS BLOB)))', '', 'no ROS 2 recording'),
    (PLAIN + ' AS (CAST(hex(zeroblob(10)) AS BLOB)) STORED)', '', 'no ROS 2 recording'),
    (VIEW, '', 'no ROS 2 recording'),
    (VIEW, "PRAGMA writable_schema = ON; UPDATE sqlite_master SET type = 'table' WHERE name = "
     "'messages'", 'cannot be read'),
], ids=['generated', 'stored', 'view', 'view called a table'])
def test_nothing_in_the_schema_of_a_recording_is_computed(messages, more, words, tmp_path):
    with database(tmp_path / 'a.db3', {'/imu': IMU}) as made:
        made.execute(messages)
        if 'AS (' in messages and 'VIEW' not in messages:
            made.executemany('INSERT INTO messages(topic_id, timestamp) VALUES (1, ?)',
                             ((row,) for row in range(10)))
        made.executescript(more)
    refused(tmp_path / 'a.db3', words)


def test_a_trigger_and_large_messages_of_others_leave_a_recording_as_it_is(tmp_path):
    with database(tmp_path / 'a.db3', {'/imu': IMU}) as made:
        made.execute(PLAIN + ')')
        rows = [(1, row, bytes(5_000_000 if row % 50 == 0 else 400)) for row in range(100)]
        made.executemany('INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)', rows)
        made.execute('CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END')
    contents = Contents()
    assert (len(list(read_messages(tmp_path / 'a.db3', contents))) == 98
            and contents.skipped_parts == 2)


ODD = {
    'empty': b'', 'two rows': b'time_s,gyro_dps\n0,1\n1,1\n',
    **{name: ('time_s,gyro_rad_s,reference_rate_rad_s,temperature_degc\n' + ''.join(
        f'{k * step!r},{rate(k)},{rate(k)},{k % 60}\n' for k in range(600))).encode()
       for name, step, rate in (
           ('all zero', 0.01, lambda k: 0), ('all equal', 0.01, lambda k: -1e19),
           ('tiny', 0.01, lambda k: 1e-300), ('one huge', 0.01, lambda k: 1e19 * (k == 300)),
           ('nan', 0.01, lambda k: 'nan'), ('half nan', 0.01, lambda k: 1 if k % 2 else 'nan'),
           ('fast', 1e-9, lambda k: 1), ('slow', 1e17, lambda k: 1))},
    'counts': b'time_s,gyro_counts\n0,1\n1,2\n2,1\n',
    **{name: f'{columns}\n{"".join(map(row, range(500)))}'.encode() for name, columns, row in (
        ('values of 1e20 on a table', 'time_s,gyro_dps,reference_rate_dps',
         lambda k: f'{k / 10},{1e20 * (k % 3)},{k // 100 * 20}\n'),
        ('values of 1e-300', 'time_s,gyro_dps,reference_heading_deg',
         lambda k: f'{k / 10},{1e-300 * k},{k}\n'),
        ('an eternity', 'time_s,gyro_dps,reference_heading_deg',
         lambda k: f'{k * 1e17},{k % 7},{k % 5}\n'),
        ('an instant', 'time_s,gyro_dps,reference_heading_deg',
         lambda k: f'{k * 2e-9},{k % 7},{k % 5}\n'),
        ('one dwell', 'gyro_dps,reference_rate_dps', lambda k: '1.5,2\n'),
        ('samples far apart', 'time_s,gyro_dps,reference_rate_dps',
         lambda k: f'{k * 1e10},{k % 7},{k % 5}\n'),
        ('heat', 'gyro_dps,reference_rate_dps,temperature_degc',
         lambda k: f'{k},{k},{(k % 3) * 1e19}\n'),
        ('a reference of 0.2 s', 'time_s,gyro_rad_s,reference_rate_rad_s',
         lambda k: f'{k / 100},{(k * k % 7) / 9},{k / 99 if k < 20 else ""}\n'))},
    'two samples': b'time_s,gyro_dps\n1e10,1\n2e10,-1e20\n',
}


VERBS = {'compensate': 'compensate {log} --model {model} --out {out}',
         'rest': 'compensate {log} --model {model} --out {out} --rest',
         'hindsight': 'compensate {log} --model {model} --out {out} --hindsight',
         'counts': 'compensate {log} --model {model} --out {out} --sensitivity 1e19',
         'rate': 'compensate {log} --model {model} --out {out} --rate 1e-19',
         'threshold': 'compensate {log} --model {model} --out {out} --threshold 0',
         'fit': 'fit {log} --out {out}', 'polynomial': 'fit {log} --polynomial',
         **{f'fit by {name}': f'fit {{log}} --method {name}'
            for name in ('dwells', 'likelihood')},
         'allan': 'allan {log} --out {out}', 'self-calibrate': 'self-calibrate {log} --out {out}',
         'profile': 'self-calibrate {log} --profile {log} --out {out}',
         'turns': 'self-calibrate {log} --turns nearest --out {out}',
         'turn': 'turn {log} --model {model}', 'plan': 'plan --limits {log}',
         'simulate': 'simulate --motion {log} --model {model} --out {out}',
         'diagnose': 'diagnose {log} --out {folder}',
         'as a model': 'compensate {log} --model {log} --out {out}'}


@pytest.mark.filterwarnings('error::RuntimeWarning')
@pytest.mark.parametrize('verb', VERBS)
def test_no_odd_log_ends_a_verb_in_a_traceback(verb, tmp_path, run):
    """Finite data give finite numbers, and a refusal leaves no file."""
    model = tmp_path / 'model.yaml'
    model.write_text(
        'effects: {bias: {bias: 0.1}, cubic_nonlinearity: {cubic_nonlinearity: 1.0e-3}}\n'
        'noise: {angle_random_walk: 1.0e-4}\n')
    for name in ODD:
        log, out = tmp_path / 'log.csv', tmp_path / 'out.csv'
        log.write_bytes(ODD[name])
        words = [word.format(log=log, out=out, model=model, folder=tmp_path / 'found')
                 for word in VERBS[verb].split()]
        with np.errstate(all='ignore'):
            code, answer, error = run(*words, '--json')
        said = [line for line in error.splitlines() if line.startswith('gyro_calibration: ')]
        assert (code in (0, 1, 2) and len(said) == (code > 0)
                and bool(answer) == (code == 0)), (name, error)
        assert not answer or strict(answer)
        assert code == 0 or not out.exists(), name
        out.unlink(missing_ok=True)


@pytest.mark.parametrize('bias', [np.nan, np.inf, -np.inf])
def test_no_file_is_written_that_cannot_be_read(bias, tmp_path):
    path = tmp_path / 'calibration.yaml'
    with pytest.raises(ArithmeticError, match='is no number that a file may hold'):
        write_model(path, GyroModel(self_calibration=SelfCalibration(0.0, bias)))
    store = StateStore('', path, tmp_path / 'biases.yaml', Prior())
    assert ('NOT STORED' in store.store_calibration(SelfCalibration(0.0, bias))
            and not path.exists())


def test_a_model_with_the_name_of_a_log_that_is_no_text_is_written(tmp_path):
    model = GyroModel(origin={'files': [{'name': to_printable('a\udcff.csv')}]})
    write_model(tmp_path / 'model.yaml', model)
    assert read_model(tmp_path / 'model.yaml').origin == model.origin
