# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A file is complete or not there, also after a kill at any moment and after a failed write."""

import os
import random
import signal
import subprocess
import sys
import time

from gyro_calibration.files import read_bytes, reason, write_atomically
import pytest

_WRITER = """
import sys
from gyro_calibration.files import write_atomically
for letter in 'ab' * 100000:
    write_atomically(sys.argv[1], letter.encode() * 500_000)
    print(letter, flush=True)
"""


def test_a_killed_writer_leaves_a_whole_file(tmp_path):
    path, moments, found = tmp_path / 'model.yaml', random.Random(0), set()
    for _ in range(40):
        writer = subprocess.Popen([sys.executable, '-c', _WRITER, path], stdout=subprocess.PIPE)
        writer.stdout.readline()
        time.sleep(moments.uniform(0.0, 0.02))
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
        content = path.read_bytes()
        assert content in (b'a' * 500_000, b'b' * 500_000), (
            f'{len(content)} bytes of {set(content)}')
        found.add(content[:1])
    assert found == {b'a', b'b'}, 'no kill came between two writes, so this test shows nothing'


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


@pytest.mark.parametrize('kind', ['folder', 'pipe'])
def test_what_is_no_regular_file_is_refused_and_not_left_open(tmp_path, kind):
    (os.mkdir if kind == 'folder' else os.mkfifo)(tmp_path / 'a')
    before = os.listdir('/proc/self/fd')
    with pytest.raises(OSError) as raised:
        read_bytes(tmp_path / 'a', 10)
    assert reason(raised.value) == f'it is a {kind}, where a file is wanted'
    assert len(os.listdir('/proc/self/fd')) == len(before)


def test_the_folder_is_made(tmp_path):
    write_atomically(tmp_path / 'a' / 'b' / 'model.yaml', b'x')
    assert (tmp_path / 'a' / 'b' / 'model.yaml').read_bytes() == b'x'


def test_others_may_read_the_file(tmp_path):
    write_atomically(tmp_path / 'model.yaml', b'x')
    assert (tmp_path / 'model.yaml').stat().st_mode & 0o777 == 0o644


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / 'a').write_text('a file')
    with pytest.raises(OSError):
        write_atomically(tmp_path / 'a' / 'model.yaml', b'x')
