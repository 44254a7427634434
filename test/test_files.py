# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A file is complete or not there, also after a failed write."""

import os

from gyro_calibration.files import describe_error, read_bytes, write_atomically
import pytest


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
    assert describe_error(raised.value) == f'it is a {kind}, where a file is wanted'
    assert len(os.listdir('/proc/self/fd')) == len(before)


def test_the_folder_is_made(tmp_path):
    write_atomically(tmp_path / 'a' / 'b' / 'model.yaml', b'x')
    assert (tmp_path / 'a' / 'b' / 'model.yaml').read_bytes() == b'x'


def test_a_folder_that_takes_no_file_is_reported_by_the_name_that_was_given():
    with pytest.raises(FileNotFoundError) as refused:
        write_atomically('/proc/model.yaml', b'new')
    assert refused.value.filename == '/proc/model.yaml'
