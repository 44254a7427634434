# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The Razor firmware: axes right and down, negated accelerations, and lines of other kinds."""

from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
import pytest

PROTOCOL = find_protocol('razor')
#: At rest and level the axis that points down has 256.
LINE = b'#YPRAG=-142.28,-5.38,33.52,12.8,-25.6,256.00,0.01,0.02,-0.03\r\n'


def decoded(data, axis='z'):
    return PROTOCOL.decoder(Settings(axis=axis)).feed(data)


@pytest.mark.parametrize('axis, rate, force', [
    ('x', 0.01, -0.05),  # forward in both frames; what is sent is negated
    ('y', -0.02, -0.1),  # right becomes left
    ('z', 0.03, 1.0),  # down becomes up, and what holds the sensor up is up
])
def test_axes_and_accelerations_are_turned_as_in_ros(axis, rate, force):
    """As in the ROS driver: x, -y, -z of the rates and -x, y, z of the accelerations."""
    sample, = decoded(LINE, axis)
    assert (sample.output == pytest.approx(rate)
            and sample.specific_force == pytest.approx(force * 9.80665))
    again, = decoded(PROTOCOL.encoder(Settings(axis=axis))(sample), axis)
    assert (again.output == pytest.approx(sample.output)
            and again.specific_force == pytest.approx(sample.specific_force, abs=0.001))


def test_a_line_is_written_as_the_firmware_prints_it():
    assert (PROTOCOL.encoder()(Sample(-0.25, specific_force=9.80665))
            == b'#YPRAG=0.00,0.00,0.00,0.00,0.00,256.00,0.00,0.00,0.25\r\n')


@pytest.mark.parametrize(
    'line', [b'#YPRAG=1,2,3,4,5,6,7,8', b'#YPRAG=1,2,3,4,5,6,7,8,9,10',
             b'#YPRAG=1,2,3,4,5,6,7,8,nan', b'#YPRAG=1,2,3,4,5,6,7,8,', b'YPRAG=1,2,3,4,5,6,7,8,9',
             b'#YPRAGM=1,2,3,4,5,6,7,8,9,10,11,12', b'#YPRAG=1,2,3,4,5,6,7,8,0x9', b'#A-C=1,2,3'])
def test_other_lines_are_discarded(line):
    decoder = PROTOCOL.decoder()
    assert decoder.feed(line + b'\r\n') == [] and decoder.discarded_bytes == len(line)


def test_angles_alone_are_in_order_but_no_sample():
    """So the firmware sends at the start, until it is asked for more."""
    decoder = PROTOCOL.decoder()
    assert decoder.feed(b'#YPR=-142.28,-5.38,33.52\r\n') == [] and decoder.discarded_bytes == 0
    assert PROTOCOL.startup == b'#ox#o1'
