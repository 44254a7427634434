# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What the project writes as MCAP is read by others: here by the library mcap."""

import io

from gyro_calibration.logs.cdr import DEFINITIONS, IMU, LAYOUTS, serialize, TEMPERATURE
from gyro_calibration.logs.ros_bag import McapWriter
import pytest

NOTES = {'recorded by': 'a test', 'gyro': '12°'}
TIMES = [10**18 + 10**7 * number for number in range(300)]


@pytest.fixture
def recording(tmp_path):
    """Write 300 samples in chunks of 100, each tenth with a temperature."""
    writer = McapWriter()
    pieces = [writer.pack_header('a test', 'about', NOTES)]
    for number, time in enumerate(TIMES):
        numbers = 37 * [0.0]
        numbers[LAYOUTS[IMU].quantities['rate']] = 0.001 * number
        imu = serialize(time, 'gyro', numbers)
        writer.add('/imu/data_raw', IMU, DEFINITIONS[IMU], time, imu)
        if number % 10 == 0:
            degc = serialize(time, 'gyro', [20.0 + number, 0.0])
            writer.add('/imu/temperature', TEMPERATURE, DEFINITIONS[TEMPERATURE], time, degc)
        if number % 100 == 99:
            assert writer.pending_bytes > 0
            pieces.append(writer.pack_chunk())
    assert writer.pending_bytes == 0 and writer.pack_chunk() == b''
    path = tmp_path / 'recording.mcap'
    path.write_bytes(b''.join([*pieces, writer.pack_summary()]))
    return path


def test_the_library_mcap_finds_all_from_the_beginning_on_and_by_the_index(recording):
    reading = pytest.importorskip('mcap.reader', reason='mcap is not installed')
    reader = reading.NonSeekingReader(io.BytesIO(recording.read_bytes()), validate_crcs=True)
    assert [message.log_time for _, channel, message in reader.iter_messages()
            if channel.topic == '/imu/temperature'] == TIMES[::10]
    with open(recording, 'rb') as file:
        reader = reading.SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 330 and summary.statistics.chunk_count == 3
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (
            TIMES[0], TIMES[-1])
        assert reader.get_header().profile == 'ros2'
        metadata, = reader.iter_metadata()
        assert (metadata.name, metadata.metadata) == ('about', NOTES)
        found = list(reader.iter_messages(['/imu/data_raw']))
        assert [message.log_time for _, _, message in found] == TIMES
        assert {(schema.name, schema.encoding) for schema, _, _ in found} == {(IMU, 'ros2msg')}
