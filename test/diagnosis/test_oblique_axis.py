# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


from attitudes import attitude_log
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.logs.log import DEGREE, Log
import numpy as np


def test_an_oblique_axis_is_named_as_such_and_nothing_else_is():
    log = attitude_log(11, (0.4 * DEGREE, 0.3 * DEGREE))
    found = diagnose([log], np.random.default_rng(0))
    (finding,) = found.findings
    size = finding.parameters['axis_misalignment']
    assert finding.status == 'established' and 'one axis' in finding.remedy
    assert size.interval[0] < 0.5 * DEGREE < size.interval[1] < 0.55 * DEGREE, size
    assert 'axis_misalignment' not in {each.effect.name for each in found.model.terms}
    assert found.reference.kind == 'motion_capture'
    assert 'oblique' in '\n'.join(terminal_lines(found))


def test_a_parallel_axis_is_not_named():
    assert not diagnose([attitude_log(12)], np.random.default_rng(0)).findings


def test_a_reference_without_an_attitude_cannot_show_an_oblique_axis():
    log = attitude_log(13, (0.2 * DEGREE, 0.0))
    alone = Log(time=log.time, output=log.output, reference_heading=log.reference_heading)
    found = diagnose([alone], np.random.default_rng(0))
    assert 'axis_misalignment' in found.cannot_show
