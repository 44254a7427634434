# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What is recorded is in the file, whole piece by whole piece: rows of a log, chunks of MCAP."""

from gyro_calibration.cli.record import CsvRecorder, McapRecorder
from gyro_calibration.cli.verb import UsageError
from gyro_calibration.driver.protocols import Sample
from gyro_calibration.driver.protocols.protocol import ASSUMED_FORCE_NOISE, ASSUMED_NOISE
from gyro_calibration.logs.log import read_log
from gyro_calibration.logs.recording import read_recording
import numpy as np
import pytest
from recordings import BEGIN, rosbags


def notes():
    return {'port': '/dev/ttyUSB0', 'protocol': 'csv'}


def samples(count=300):
    return [(BEGIN + 10_000_000 * number,
             Sample(0.01 * number, 20.0 + 0.001 * number, specific_force=9.8))
            for number in range(count)]


def recorders(folder):
    logs = [CsvRecorder(str(folder / name), notes) for name in ('a.csv', 'a.csv.gz')]
    return *logs, McapRecorder(str(folder / 'a.mcap'), notes)


def read(path):
    return read_recording(path) if str(path).endswith('.mcap') else read_log(path)


def test_each_kind_of_file_holds_the_samples_and_says_where_they_came_from(tmp_path):
    """Every piece can be read before the recording ends."""
    pytest.importorskip('mcap', reason='mcap is not installed')
    for recorder, name in zip(recorders(tmp_path), ('a.csv', 'a.csv.gz', 'a.mcap')):
        for number, (stamp, sample) in enumerate(samples()):
            recorder.add_sample(stamp, sample)
            if number % 50 == 49:
                recorder.flush()
                assert number < 150 or len(read(tmp_path / name)) == number + 1, name
        recorder.close()
        log = read(tmp_path / name)
        np.testing.assert_array_equal(log.output, [sample.output for _, sample in samples()])
        np.testing.assert_array_equal(log.temperature,
                                      [sample.temperature for _, sample in samples()])
        np.testing.assert_array_equal(log.specific_force, 9.8)
        np.testing.assert_array_equal(log.time, np.arange(300) * 10_000_000 / 1e9)
        assert {'port: /dev/ttyUSB0', 'protocol: csv'} <= set(log.notes)


def test_rosbags_and_mcap_read_what_is_recorded(tmp_path):
    reading = pytest.importorskip('mcap.reader', reason='mcap is not installed')
    rosbag2, typesys = rosbags()
    recorder = McapRecorder(str(tmp_path / 'a.mcap'), notes)
    for number, (stamp, sample) in enumerate(samples()):
        recorder.add_sample(stamp, sample)
        if number % 100 == 0:
            recorder.flush()
    recorder.close()
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    with rosbag2.Reader(tmp_path / 'a.mcap') as reader:
        for connection in reader.connections:
            store.register(typesys.get_types_from_msg(connection.msgdef.data, connection.msgtype))
        found = [
            store.deserialize_cdr(data, connection.msgtype)
            for connection, _, data in reader.messages() if connection.topic == '/imu/data_raw']
        assert reader.message_count == 600
    assert [message.angular_velocity.z for message in found] == [
        sample.output for _, sample in samples()]
    last = found[-1]
    assert last.header.frame_id == 'gyro' and last.linear_acceleration.z == 9.8
    assert last.orientation_covariance[0] == -1.0
    for covariance, deviation in ((last.angular_velocity_covariance, ASSUMED_NOISE),
                                  (last.linear_acceleration_covariance, ASSUMED_FORCE_NOISE)):
        assert covariance.tolist() == [1e6, 0.0, 0.0, 0.0, 1e6, 0.0, 0.0, 0.0, deviation ** 2]
    times = [stamp for stamp, _ in samples()]
    with open(tmp_path / 'a.mcap', 'rb') as file:
        reader = reading.NonSeekingReader(file, validate_crcs=True)
        assert [message.log_time for _, channel, message in reader.iter_messages()
                if channel.topic == '/imu/temperature'] == times
        file.seek(0)
        reader = reading.SeekingReader(file, validate_crcs=True)
        said = reader.get_summary().statistics
        assert (said.message_count, said.chunk_count, said.message_start_time,
                said.message_end_time) == (600, 4, times[0], times[-1])
        assert reader.get_header().profile == 'ros2'
        metadata, = reader.iter_metadata()
        assert metadata.metadata == notes()
        assert [message.log_time
                for *_, message in reader.iter_messages(['/imu/data_raw'])] == times


def test_a_file_that_is_there_is_never_written_to(tmp_path):
    (tmp_path / 'a.mcap').write_text('precious')
    with pytest.raises(UsageError, match='exists already'):
        recorders(tmp_path)
    assert (tmp_path / 'a.mcap').read_text() == 'precious'


def test_a_recording_of_nothing_leaves_no_file(tmp_path):
    for recorder in recorders(tmp_path):
        recorder.flush()
        recorder.close()
    assert not list(tmp_path.iterdir())


def test_values_that_come_seldom_are_held_and_late_ones_are_reported(tmp_path):
    recorder = CsvRecorder(str(tmp_path / 'a.csv'), notes)
    for number in range(400):
        health = {10: {'supply_v': 5.0}, 200: {'supply_v': 4.9},
                  350: {'source_current_a': 0.1}}.get(number, {})
        recorder.add_sample(BEGIN + 10_000_000 * number, Sample(0.0, health=health))
        recorder.flush()
    recorder.close()
    np.testing.assert_array_equal(read_log(tmp_path / 'a.csv').supply, 200 * [5.0] + 200 * [4.9])
    assert recorder.late_columns == {'source_current_a'}
