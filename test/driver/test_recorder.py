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


from gyro_calibration.driver.protocols import Sample
from gyro_calibration.driver.protocols.protocol import ASSUMED_FORCE_NOISE, ASSUMED_NOISE
from gyro_calibration.driver.recorder import (
    about,
    AtomicAppender,
    CsvRecorder,
    DiskFull,
    McapRecorder,
    MessageLog,
)
from gyro_calibration.logs.cdr import IMU, TEMPERATURE
from gyro_calibration.logs.log import LogError, read_log
from gyro_calibration.logs.recording import read_recording, Topics
from gyro_calibration.logs.ros_bag import Message
import numpy as np
import pytest
from recordings import BEGIN, Messages, rosbags

TOPICS = {'gyro': '/imu', 'temperature': '/t', 'reference': '/odom'}


def notes():
    return {'port': '/dev/ttyUSB0', 'protocol': 'csv'}


def samples(count=300):
    return [(BEGIN + 10_000_000 * number, Sample(0.01 * number, 20.0 + 0.001 * number,
                                                 specific_force=9.8)) for number in range(count)]


def recorders(folder):
    """Return one recorder of each kind."""
    logs = [CsvRecorder(str(folder / name), notes) for name in ('a.csv', 'a.csv.gz')]
    return *logs, McapRecorder(str(folder / 'a.mcap'), notes)


def read(path):
    return read_recording(path) if str(path).endswith('.mcap') else read_log(path)


def test_each_kind_of_file_holds_the_samples_and_says_where_they_came_from(tmp_path):
    pytest.importorskip('mcap', reason='mcap is not installed')
    for recorder in recorders(tmp_path):
        for stamp, sample in samples():
            recorder.add_sample(stamp, sample)
            if stamp % 500_000_000 == 0:
                recorder.flush()
        recorder.close()
    for name in ('a.csv', 'a.csv.gz', 'a.mcap'):
        log = read(tmp_path / name)
        np.testing.assert_array_equal(log.output, [sample.output for _, sample in samples()])
        np.testing.assert_array_equal(log.temperature,
                                      [sample.temperature for _, sample in samples()])
        np.testing.assert_array_equal(log.specific_force, 9.8)
        np.testing.assert_array_equal(log.time, np.arange(300) * 10_000_000 / 1e9)
        assert {'port: /dev/ttyUSB0', 'protocol: csv'} <= set(log.notes)


def test_every_piece_can_be_read_before_the_recording_ends(tmp_path):
    pytest.importorskip('mcap', reason='mcap is not installed')
    for recorder, name in zip(recorders(tmp_path), ('a.csv', 'a.csv.gz', 'a.mcap')):
        for number, (stamp, sample) in enumerate(samples(400)):
            recorder.add_sample(stamp, sample)
            if number % 50 == 49:
                recorder.flush()
                if number > 150:
                    assert len(read(tmp_path / name)) == number + 1, name
        recorder.close()


def test_rosbags_reads_what_is_recorded(tmp_path):
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
        found = [store.deserialize_cdr(data, connection.msgtype)
                 for connection, _, data in reader.messages()
                 if connection.topic == '/imu/data_raw']
        assert reader.message_count == 600
    assert [message.angular_velocity.z for message in found] == [
        sample.output for _, sample in samples()]
    last = found[-1]
    assert last.header.frame_id == 'gyro' and last.linear_acceleration.z == 9.8
    assert last.orientation_covariance[0] == -1.0
    for covariance, deviation in ((last.angular_velocity_covariance, ASSUMED_NOISE),
                                  (last.linear_acceleration_covariance, ASSUMED_FORCE_NOISE)):
        assert covariance.tolist() == [1e6, 0.0, 0.0, 0.0, 1e6, 0.0, 0.0, 0.0, deviation ** 2]


def test_a_file_that_is_there_is_never_written_to(tmp_path):
    for name in ('a.csv', 'a.mcap'):
        (tmp_path / name).write_text('precious')
        with pytest.raises(FileExistsError):
            AtomicAppender(str(tmp_path / name))
        assert (tmp_path / name).read_text() == 'precious'


def test_a_recording_of_nothing_leaves_no_file(tmp_path):
    for recorder in recorders(tmp_path):
        recorder.flush()
        recorder.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', ['a.csv', 'a.csv.gz', 'a.mcap'])
def test_what_is_killed_before_its_first_piece_takes_no_name(tmp_path, name):
    recorder = (McapRecorder if name.endswith('.mcap') else CsvRecorder)(
        str(tmp_path / name), notes)
    for stamp, sample in samples(50):
        recorder.add_sample(stamp, sample)
    assert not list(tmp_path.iterdir())


def test_a_place_that_is_taken_meanwhile_is_not_written_to(tmp_path):
    pieces = AtomicAppender(str(tmp_path / 'a.csv'))
    (tmp_path / 'a.csv').write_text('precious')
    with pytest.raises(LogError, match='another program has created it meanwhile'):
        pieces.append(b'a piece')
    pieces.close()
    assert (tmp_path / 'a.csv').read_text() == 'precious'


def test_a_piece_that_does_not_fit_is_taken_back(tmp_path, monkeypatch):
    pieces = AtomicAppender(str(tmp_path / 'a.csv'))
    pieces.append(b'whole\n')

    class Full:
        """A file on a disk that has room for three bytes."""

        def __init__(self, file):
            self.file, self.room = file, 3

        def write(self, data):
            if not self.room:
                raise OSError(28, 'No space left on device')
            count, self.room = self.file.write(data[:self.room]), 0
            return count

        def __getattr__(self, name):
            return getattr(self.file, name)

    file = pieces._file
    monkeypatch.setattr(pieces, '_file', Full(file))
    with pytest.raises(DiskFull, match='No space left on device'):
        pieces.append(b'no longer whole\n')
    monkeypatch.setattr(pieces, '_file', file)
    pieces.append(b'there is room again\n')
    pieces.close()
    assert (tmp_path / 'a.csv').read_bytes() == b'whole\nthere is room again\n'


def test_other_programs_read_the_whole_pieces_of_a_recording_on_a_full_disk(tmp_path, monkeypatch):
    reading = pytest.importorskip('mcap.reader', reason='mcap is not installed')
    recorder, append = McapRecorder(str(tmp_path / 'a.mcap'), notes), AtomicAppender.append

    def without_room(pieces, piece):
        if len(piece) > 100:
            pieces.is_full = True
            raise DiskFull(28, 'No space left on device')
        append(pieces, piece)
    for stamp, sample in samples(200):
        recorder.add_sample(stamp, sample)
    recorder.flush()
    monkeypatch.setattr(AtomicAppender, 'append', without_room)
    for stamp, sample in samples(400)[200:]:
        recorder.add_sample(stamp, sample)
    with pytest.raises(DiskFull):
        recorder.flush()
    recorder.close()
    with open(tmp_path / 'a.mcap', 'rb') as file:
        assert len(list(reading.make_reader(file).iter_messages(topics=['/imu/data_raw']))) == 200
    assert len(read(tmp_path / 'a.mcap')) == 200


def test_values_that_come_seldom_are_held_and_late_ones_are_reported(tmp_path):
    recorder = CsvRecorder(str(tmp_path / 'a.csv'), notes)
    for number in range(400):
        health = {10: {'supply_v': 5.0}, 200: {'supply_v': 4.9},
                  300: {'source_current_a': 0.1}}.get(number, {})
        recorder.add_sample(BEGIN + 10_000_000 * number, Sample(0.0, health=health))
        recorder.flush()
    recorder.close()
    np.testing.assert_array_equal(read_log(tmp_path / 'a.csv').supply, 200 * [5.0] + 200 * [4.9])
    assert recorder.missed == {'source_current_a'}


@pytest.mark.parametrize(('first', 'missed'),
                         [(2.0, set()), (4.0, {'reference_heading_rad', 'reference_rate_rad_s'})])
def test_a_reference_that_comes_too_late_for_a_column_is_reported(topic, first, missed):
    for number in range(600):
        time = 0.01 * number
        topic.send('/imu', topic.make.imu(time, time), time)
        topic.send('/t', topic.make.temperature(time, 20.0), time)
        if time >= first:
            topic.send('/odom', topic.make.odometry(time, 0.1, time), time)
    assert (topic.read().reference_rate is None) == bool(missed)
    assert topic.rows.missed == missed


def test_about_names_the_program_and_leaves_out_what_is_not_known():
    known = about(port='/dev/ttyUSB0', protocol='', baud=None)
    assert set(known) == {'recorded by', 'date', 'port'}


# Messages of topics into a log


class Topic:
    """Puts messages of rosbags into a log, as a subscription would."""

    def __init__(self, path, topics=TOPICS):
        self.make, self.path = Messages(), path
        self.rows = CsvRecorder(str(path), notes, ('temperature_degc', 'reference'))
        self.log = MessageLog(self.rows, topics)

    def send(self, topic, message, received):
        kind = message.__msgtype__
        self.log.add(Message(topic, kind, BEGIN + round(1e9 * received),
                             bytes(self.make.store.serialize_cdr(message, kind))))
        self.rows.flush()

    def read(self):
        self.rows.close()
        return read_log(self.path)


@pytest.fixture
def topic(tmp_path):
    return Topic(tmp_path / 'a.csv')


def test_a_log_from_topics_holds_what_a_recording_of_them_holds(topic, tmp_path):
    recorder = McapRecorder(str(tmp_path / 'a.mcap'), notes)
    take = topic.log.add

    def both(message):
        recorder.add_message(message, 'x')
        take(message)
    topic.log.add = both
    for number, time in enumerate(np.arange(0.0, 20.0, 0.01)):
        heading = np.remainder(2.0 * time + np.pi, 2.0 * np.pi) - np.pi
        topic.send('/t', topic.make.temperature(time, 20.0 + time), time)
        topic.send('/imu', topic.make.imu(time, np.sin(time), 9.8), time)
        if number % 5 == 0 and not 5.0 < time < 8.0:
            topic.send('/odom', topic.make.odometry(time - 0.003, heading, 2.0), time)
    recorder.close()
    log, other = topic.read(), read_recording(tmp_path / 'a.mcap', Topics('imu', 'odom', 't'))
    for name in ('time', 'output', 'temperature', 'specific_force', 'reference_rate'):
        np.testing.assert_array_equal(getattr(log, name), getattr(other, name), name)
    turned = log.reference_heading - other.reference_heading
    known = np.isfinite(turned)
    np.testing.assert_array_equal(known, np.isfinite(other.reference_heading))
    # The log goes on after the gap by less than half a turn; a recording asks the gyro, which here
    # does not measure the turns.
    np.testing.assert_allclose(np.remainder(turned[known] + 1.0, 2.0 * np.pi), 1.0, atol=1e-9)
    assert 200 < np.isnan(log.reference_heading).sum() < 400


def test_a_log_goes_on_where_the_clock_of_the_stamps_was_set(topic):
    for number in range(600):
        time = 0.01 * number
        topic.send('/imu',
                   topic.make.imu(time + (0.0, -3600.0, 7200.0)[number // 200], time), time)
    log = topic.read()
    np.testing.assert_allclose(log.time, 0.01 * np.arange(600), atol=1e-6)
    assert topic.log.clock_steps == 2 and topic.log.samples == 600


@pytest.mark.parametrize('step', [3600.0, -3600.0])
@pytest.mark.parametrize('first', ['/odom', '/t', '/imu'])
def test_whichever_topic_a_set_clock_shows_on_first_all_go_on(topic, first, step):
    order = sorted(['/imu', '/odom', '/t'], key=lambda name: name != first)
    for number in range(600):
        time = 0.01 * number
        stamp = time + step * (number >= 300)
        make = topic.make
        made = {'/imu': make.imu(stamp, time), '/odom': make.odometry(stamp, 0.1, time),
                '/t': make.temperature(stamp, time)}
        for name in order:
            topic.send(name, made[name], time)
    log = topic.read()
    for values in (log.time, log.temperature, log.reference_rate):
        np.testing.assert_allclose(values[:-1], 0.01 * np.arange(599), atol=0.011)
    assert topic.log.clock_steps == 1 and topic.log.samples == 600


def test_a_message_that_was_under_way_while_the_clock_was_set_changes_nothing(topic):
    for number in range(600):
        time = 0.01 * number
        topic.send('/imu', topic.make.imu(time + 3600.0 * (number >= 300), time), time)
        topic.send('/odom', topic.make.odometry(time + 3600.0 * (number >= 303), 0.1, time), time)
    np.testing.assert_allclose(topic.read().reference_rate[:-1], 0.01 * np.arange(599), atol=1e-6)
    assert topic.log.clock_steps == 1


def test_a_stalled_subscriber_shifts_no_stamps(topic):
    for number in range(600):
        topic.send('/imu', topic.make.imu(0.01 * number, number),
                   max(0.01 * number, 4.0 if number > 100 else 0.0))
    np.testing.assert_allclose(topic.read().time, 0.01 * np.arange(600), atol=1e-9)
    assert topic.log.clock_steps == 0


def test_lost_and_doubled_samples_are_counted(topic):
    for number in range(600):
        if number % 100 != 99:
            topic.send('/imu', topic.make.imu(0.01 * number, number), 0.01 * number)
        if number % 100 == 50:
            topic.send('/imu', topic.make.imu(0.01 * number, number), 0.01 * number)
    log = topic.read()
    # Nobody sees the last one lost.
    assert (topic.log.lost, topic.log.left_out, len(log)) == (5, 6, 594)


def test_bytes_that_are_no_message_are_counted(topic):
    for number in range(200):
        topic.send('/imu', topic.make.imu(0.01 * number, number), 0.01 * number)
    for data in (b'', b'\0\1\0\0', bytes(400)):
        topic.log.add(Message('/imu', IMU, BEGIN, data))
        topic.log.add(Message('/t', TEMPERATURE, BEGIN, data[:10]))
    assert len(topic.read()) == 200 and topic.log.damaged >= 5


@pytest.mark.parametrize(('name', 'kind', 'wanted'), [
    ('/imu', 'nav_msgs/msg/Odometry', '--topic wants sensor_msgs/msg/Imu'),
    ('/imu', 'geometry_msgs/msg/TwistStamped', '--topic wants sensor_msgs/msg/Imu'),
    ('/imu', 'std_msgs/msg/String', '--topic wants sensor_msgs/msg/Imu'),
    ('/t', IMU, '--temperature-topic wants sensor_msgs/msg/Temperature'),
    ('/odom', TEMPERATURE, '--reference-topic wants nav_msgs/msg/Odometry, sensor_msgs/msg/Imu,'),
])
def test_a_topic_of_another_kind_than_its_role_is_refused_in_a_log_and_counted_in_a_recording(
        topic, name, kind, wanted):
    message = Message(name, kind, BEGIN, bytes(1000))
    with pytest.raises(LogError, match=f'^{name} is {kind}; {wanted}'):
        topic.log.add(message)
    counted = MessageLog(None, TOPICS)
    counted.add(message)
    assert counted.samples == 0 and list(counted.of_another_kind) == [name]


def test_what_a_reference_does_not_report_is_no_column(topic):
    for number in range(500):
        time = 0.01 * number
        topic.send('/imu', topic.make.imu(time, time), time)
        topic.send('/odom', topic.make.imu(time, 7.0, heading=0.1, reports_rate=False), time)
    log = topic.read()
    assert (log.reference_rate is None
            and np.nanmax(np.abs(log.reference_heading)) == pytest.approx(0.1, abs=1e-6))
