# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What ROS reviewers run, where it is installed; elsewhere `make style` runs the same checks."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.flake8
@pytest.mark.linter
def test_flake8(monkeypatch):
    linter = pytest.importorskip('ament_flake8.main', reason='ament_flake8 is not installed')
    monkeypatch.chdir(ROOT)
    code, errors = linter.main_with_errors(argv=['--config', str(ROOT / '.flake8')])
    assert code == 0, '\n'.join(errors)


@pytest.mark.linter
@pytest.mark.pep257
def test_pep257(monkeypatch):
    linter = pytest.importorskip('ament_pep257.main', reason='ament_pep257 is not installed')
    monkeypatch.chdir(ROOT)
    # the descriptions of parameters stand on the line of the name, where this check sees none
    assert linter.main(argv=['--add-ignore', 'D417', '--', '.']) == 0


@pytest.mark.copyright
@pytest.mark.linter
def test_copyright(monkeypatch):
    linter = pytest.importorskip('ament_copyright.main', reason='ament_copyright is not installed')
    monkeypatch.chdir(ROOT)
    assert linter.main(argv=['.']) == 0
