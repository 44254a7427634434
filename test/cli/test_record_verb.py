# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Recording: files that others read, and real processes interrupted, killed, on a full disk."""

import contextlib
import json
import math
import multiprocessing
import os
from pathlib import Path
import re
import resource
import signal
import sys
import tempfile
import time

from gyro_calibration.cli import main as command_line
from gyro_calibration.cli import record as record_verb
from gyro_calibration.cli.record import CsvRecorder, McapRecorder
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
from gyro_calibration.driver.protocols.protocol import ASSUMED_FORCE_NOISE, ASSUMED_NOISE
from gyro_calibration.logs.log import read_log
from gyro_calibration.logs.recording import read_recording, Topics
import numpy as np
import pytest
from recordings import BEGIN, Messages, rosbags

RATE = 200.0
COLUMNS = 'gyro_rad_s', 'time_s', 'temperature_degc'
KINDS = ['a.csv', 'a.csv.gz', 'a.mcap']


@contextlib.contextmanager
def gyro(link, rate=RATE):
    """
    Emulate a gyro that counts: its outputs rise by 1e-4 rad/s a sample, which numbers them.

    It is a replay at double speed, which waits for a reader on a busy machine. It sends its time,
    which shows losses; without it, samples that are late by a period for 0.3 s look like a loss.
    """
    samples = (Sample(1e-4 * (number % 10_000), 25.0, time=2.0 * number / rate)
               for number in range(10 ** 6))
    with Emulator(find_protocol('csv'), samples,
                  Settings(columns=COLUMNS), 2.0, link):
        yield


def words_for(link, out, *more):
    return ['record', '--port', str(link), '--protocol', 'csv',
            '--columns', ','.join(COLUMNS), '--out', str(out), *more]


def _record(words, output, error, environment, limit):
    """Run the program with its output in files and, if given, a file size limit in bytes."""
    os.environ.update(environment)
    # The tests may run without a terminal, where the signal is ignored.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    for path, number in ((output, 1), (error, 2)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.exit(command_line.main(words))


class Recording:
    """The program in a process forked from one with its imports, for a tenth of the time."""

    def __init__(self, folder, words, limit=None):
        forks = multiprocessing.get_context('forkserver')
        forks.set_forkserver_preload(['gyro_calibration.cli.main',
                                      'gyro_calibration.ros.recorder_node', __name__])
        self._files = [Path(tempfile.mkstemp(dir=folder)[1]) for _ in range(2)]
        self.process = forks.Process(
            target=_record, args=(list(map(str, words)), *self._files, dict(os.environ), limit))
        self.process.start()

    def end(self, number=None, timeout=60.0):
        if number is not None:
            os.kill(self.process.pid, number)
        self.process.join(timeout)
        out, error = (file.read_text() for file in self._files)
        assert self.process.exitcode is not None and 'Traceback' not in error, error
        return self.process.exitcode, out, error

    @property
    def error(self):
        return self._files[1].read_text()


@pytest.fixture
def record(tmp_path_factory):
    """Return a function that starts the program; it is killed after the test if it still runs."""
    started, folder = [], tmp_path_factory.mktemp('printed')

    def record(*words, **how):
        started.append(Recording(folder, words, **how))
        return started[-1]
    yield record
    for each in started:
        each.process.kill()
        each.process.join()


def read(path, **topics):
    return (read_recording(path, Topics(**topics)) if str(path).endswith('.mcap')
            else read_log(path))


def holds(path, count):
    """Return whether so many samples are in a file; before the first piece it is empty."""
    try:
        return path.stat().st_size > 0 and len(read(path)) >= count
    except FileNotFoundError:  # also after the try at the start
        return False


def is_unbroken(log):
    """Return whether no sample is missing in the middle, by the numbers in the samples."""
    steps = np.diff(np.round(1e4 * np.asarray(log.output)))
    return bool(np.isin(steps, (1, -9999)).all())


def notes():
    return {'port': '/dev/ttyUSB0', 'protocol': 'csv'}


def samples(count=300):
    return [(BEGIN + 10_000_000 * number,
             Sample(0.01 * number, 20.0 + 0.001 * number, specific_force=9.8))
            for number in range(count)]


def recorders(folder):
    logs = [CsvRecorder(str(folder / name), notes) for name in ('a.csv', 'a.csv.gz')]
    return *logs, McapRecorder(str(folder / 'a.mcap'), notes)


def test_each_kind_of_file_holds_the_samples_and_says_where_they_came_from(tmp_path):
    """Every piece can be read before the recording ends."""
    pytest.importorskip('mcap', reason='mcap is not installed')
    for recorder, name in zip(recorders(tmp_path), KINDS):
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


def by_rosbags(path):
    """Return topic and message of each, by the definitions in the recording."""
    rosbag2, typesys = rosbags()
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    with rosbag2.Reader(path) as reader:
        for connection in reader.connections:
            store.register(typesys.get_types_from_msg(connection.msgdef.data, connection.msgtype))
        return [(connection.topic, store.deserialize_cdr(data, connection.msgtype))
                for connection, _, data in reader.messages()]


def test_rosbags_and_mcap_read_what_is_recorded(tmp_path):
    reading = pytest.importorskip('mcap.reader', reason='mcap is not installed')
    recorder = McapRecorder(str(tmp_path / 'a.mcap'), notes)
    for number, (stamp, sample) in enumerate(samples()):
        recorder.add_sample(stamp, sample)
        if number % 100 == 0:
            recorder.flush()
    recorder.close()
    messages = by_rosbags(tmp_path / 'a.mcap')
    assert len(messages) == 600
    found = [message for topic, message in messages if topic == '/imu/data_raw']
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


@pytest.mark.parametrize(('name', 'number'),
                         [('a.csv.gz', signal.SIGTERM), ('a.mcap', signal.SIGINT)])
def test_an_interrupted_recording_is_done(record, wait_until, tmp_path, name, number):
    with gyro(tmp_path / 'gyro'):
        recording = record(*words_for(tmp_path / 'gyro', tmp_path / name, '--json'))
        wait_until(lambda: holds(tmp_path / name, 1000), 60.0, 'samples')
        code, out, _ = recording.end(number)
    answer, log = json.loads(out), read(tmp_path / name)
    assert code == 0
    assert (answer['samples'], answer['lost'], answer['protocol']) == (len(log), 0, 'csv')
    assert is_unbroken(log) and (log.temperature == 25.0).all()
    # An MCAP file has its closing part.
    assert (not name.endswith('.mcap')
            or len(_messages(tmp_path / name, '/imu/data_raw')) == len(log))
    assert np.median(np.diff(log.time)) == pytest.approx(1.0 / RATE, rel=0.05)
    assert {'protocol: csv', f'port: {tmp_path / "gyro"}'} <= set(log.notes)


def test_where_a_hangup_is_ignored_a_recording_goes_on(wait_until):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with record_verb._stop_event(None) as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.is_set() and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGTERM)
            # not by a long wait, which a signal received by another thread does not interrupt
            wait_until(stop.is_set)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize('name', ['a.csv', 'a.mcap'])
def test_it_ends_by_itself_and_writes_over_nothing(run, tmp_path, name):
    """Where columns have a unit, no sensitivity is noted."""
    path = tmp_path / name
    words = words_for(tmp_path / 'gyro', path, '--seconds', '2')
    with gyro(tmp_path / 'gyro'):
        code, out, error = run(*words)
        assert code == 0 and f'0 lost, written to {path}.' in out, (out, error)
        notes, before = read(path).notes, path.read_bytes()
        assert 'inverted: no' in notes and not any('sensitivity' in note for note in notes)
        code, _, error = run(*words)
    assert code == 2 and 'exists already' in error and path.read_bytes() == before


@pytest.mark.parametrize(('words', 'sentence'), [
    (['--out', 'a.txt', '--port', '/dev/x'], 'give a name that ends in .csv, .csv.gz, .mcap'),
    (['--out', 'a.csv', '--port', '/dev/x', '--topic', 'imu'],
     '--port and topics were both given'),
    (['--out', 'a.csv', '--port', '/dev/x', '--protocol', 'morse'], 'morse'),
    (['--out', 'a.csv', '--port', '/dev/x', '--baud', '-5'],
     '--baud is -5, but must be from 0 to 4000000'),
    (['--out', 'a.csv', '--port', '/dev/x', '--baud', '9' * 30], 'but must be from 0 to 4000000'),
    (['--out', 'a.csv', '--protocol', 'csv'], 'need --port'),
    (['--out', 'a.csv', '--sample-rate', '100'], 'need --port'),
    (['--out', 'a.csv', '--increments', 'never'], 'need --port'),
    (['--out', 'a.csv', '--topic', 'imu', '--reference-topic', '/imu'],
     'a topic was named twice'),
    (['--out', 'a.csv', '--reference-topic', 'a', '--reference-topic', 'b'],
     'record several topics into .mcap'),
])
def test_wrong_use_is_one_sentence_and_leaves_no_file(run, tmp_path, monkeypatch, words, sentence):
    monkeypatch.chdir(tmp_path)
    code, out, error = run('record', *words)
    assert (code, out) == (2, '') and sentence in error and error.count('\n') == 1
    assert not list(tmp_path.iterdir())


def test_a_port_that_is_not_there_is_reported_and_leaves_no_file(run, tmp_path):
    code, out, error = run(*words_for(tmp_path / 'gyro', tmp_path / 'a.csv', '--seconds', '1'))
    assert ((code, out) == (1, '') and 'no sample was received in' in error
            and str(tmp_path / 'gyro') in error)
    assert not (tmp_path / 'a.csv').exists()


def test_a_gyro_that_is_unplugged_leaves_a_gap(record, wait_until, tmp_path):
    with gyro(tmp_path / 'gyro'):
        recording = record(*words_for(tmp_path / 'gyro', tmp_path / 'a.csv', '--json'))
        wait_until(lambda: (tmp_path / 'a.csv').exists() and (tmp_path / 'a.csv').stat().st_size,
                   60.0, 'a first piece')
    time.sleep(1.0)
    size = (tmp_path / 'a.csv').stat().st_size
    with gyro(tmp_path / 'gyro'):
        wait_until(lambda: (tmp_path / 'a.csv').stat().st_size > size + 1000, 60.0,
                   'samples after the gap')
        code, out, error = recording.end(signal.SIGINT)
    steps = np.diff(read_log(tmp_path / 'a.csv').time)
    assert code == 0 and json.loads(out)['openings'] >= 2 and 'samples of csv come' in error
    assert np.count_nonzero(steps > 0.5) == 1


@pytest.mark.parametrize('name', ['a.csv.gz', 'a.mcap'])
def test_a_killed_recording_can_be_read_up_to_the_last_second(record, wait_until, tmp_path, name):
    # 7 of each kind make more than 20; each is killed at another time.
    generator, lateness = np.random.default_rng(KINDS.index(name)), []
    with contextlib.ExitStack() as stack:
        running = []
        for number in range(7):
            (tmp_path / str(number)).mkdir()
            link, out = tmp_path / str(number) / 'gyro', tmp_path / str(number) / name
            stack.enter_context(gyro(link))
            running.append((out, record(*words_for(link, out)).process))
        wait_until(lambda: all(out.exists() and out.stat().st_size for out, _ in running), 30.0,
                   'first pieces')
        for out, process in running:
            time.sleep(0.3 * generator.random())
            killed = time.time()
            process.kill()
            process.join()
            log = read(out)
            assert is_unbroken(log), out
            note = next(note for note in log.notes if 'time_s ' in note)
            begin = float(re.search(r'time_s (counts from: |from )(\S+)', note)[2])
            lateness.append(killed - begin - log.time[-1])
    assert np.median(lateness) < 1.0 and max(lateness) < 2.0, lateness  # the machine may be busy


@pytest.mark.parametrize(('name', 'limit'), [('a.csv', 60_000), ('a.mcap', 600_000)])
def test_a_file_that_may_not_grow_stays_readable(record, tmp_path, name, limit):
    with gyro(tmp_path / 'gyro', 1000.0):
        code, _, error = record(*words_for(tmp_path / 'gyro', tmp_path / name), limit=limit).end()
    log, size = read(tmp_path / name), (tmp_path / name).stat().st_size
    assert (code == 1 and f'{size} bytes remain in {tmp_path / name}' in error
            and 'make room' in error)
    assert size <= limit and len(log) > 500 and is_unbroken(log)
    assert (not name.endswith('.mcap')  # other programs read it too
            or len(_messages(tmp_path / name, '/imu/data_raw')) == len(log))


@pytest.mark.parametrize('name', KINDS)
def test_where_nothing_can_be_written_no_file_is_left(record, tmp_path, name):
    with gyro(tmp_path / 'gyro'):
        code, _, error = record(*words_for(tmp_path / 'gyro', tmp_path / name), limit=1000).end()
    assert code == 1 and 'nothing was written' in error and not (tmp_path / name).exists()


class Robot:
    """Publishes the topics of a robot, with stamps of its own, many times faster than them."""

    def __init__(self, ros):
        from geometry_msgs.msg import PoseStamped
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu, Temperature
        self.kinds = {'imu/data_raw': Imu, 'imu/temperature': Temperature, 'odom': Odometry,
                      'pose': PoseStamped}
        self._ros, self._publishers, self._make = ros, {}, Messages()

    def offer(self, *topics, quality=None):
        """Publish on some topics from now on, anew where it did already."""
        for topic in topics:
            if topic in self._publishers:
                self._ros.node.destroy_publisher(self._publishers[topic])
            self._publishers[topic] = self._ros.publisher(
                self.kinds[topic], topic, quality or reliable())

    def is_heard(self, count=1):
        return all(each.get_subscription_count() >= count for each in self._publishers.values())

    def is_received(self):
        """Return whether all subscribers acknowledged all that was published."""
        from rclpy.duration import Duration
        return all(each.wait_for_all_acked(Duration(seconds=0.01))
                   for each in self._publishers.values())

    def send(self, time, rate, heading):
        make = self._make
        messages = {'imu/data_raw': make.imu(time, rate),
                    'imu/temperature': make.temperature(time, 25.0 + 0.01 * time),
                    'odom': make.odometry(time, heading, rate), 'pose': make.pose(time, heading)}
        for topic, publisher in self._publishers.items():
            message = messages[topic]
            publisher.publish(bytes(make.store.serialize_cdr(message, message.__msgtype__)))

    def drive(self, begin=0.0, duration=40.0):
        """Turn to and fro between rests, and return how many samples that were."""
        times = np.arange(round(begin * 50), round((begin + duration) * 50)) / 50.0
        for number, at in enumerate(times.tolist()):
            rate = math.sin(0.5 * at) * (at % 20.0 > 6.0)
            self.send(at, rate, 2.0 * (1.0 - math.cos(0.5 * at)))
            if number % 20 == 0:
                time.sleep(0.01)  # or a subscriber on a busy machine loses some
        return len(times)


def reliable(**how):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    return QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE, **how)


def test_a_log_and_a_recording_of_the_same_topics_hold_the_same(ros, record, wait_until, tmp_path):
    robot = Robot(ros)
    robot.offer('imu/data_raw', 'imu/temperature', 'odom')
    both = [record('record', '--reference-topic', 'odom', *more, '--out', tmp_path / name,
                   '--json')
            for name, more in (('a.csv', []), ('a.mcap', ['--reference-topic', 'pose']))]
    wait_until(lambda: robot.is_heard(2), 60.0, 'both recorders')
    robot.offer('pose')
    wait_until(robot.is_heard, what='one of them')
    count = robot.drive()
    wait_until(robot.is_received, 60.0, 'the last message')
    # a busy machine takes them later, and a recorder that is stopped takes them for 10 s
    wait_until(lambda: holds(tmp_path / 'a.csv.mcap', count - 200)
               and holds(tmp_path / 'a.mcap', count - 200), 120.0, 'nearly all of them')
    answers = [each.end(signal.SIGINT) for each in both]
    for code, out, error in answers:
        assert (code == 0
                and (json.loads(out)['samples'], json.loads(out)['lost']) == (count, 0)), error
    assert not (tmp_path / 'a.csv.mcap').exists()
    log, recording = read(tmp_path / 'a.csv'), read(tmp_path / 'a.mcap', reference='odom')
    for name in ('output', 'time', 'temperature', 'reference_rate'):
        np.testing.assert_array_equal(getattr(log, name), getattr(recording, name), name)
    np.testing.assert_allclose(log.reference_heading, recording.reference_heading, atol=1e-9)
    found = dict(by_rosbags(tmp_path / 'a.mcap'))
    assert {'/imu/data_raw', '/imu/temperature', '/odom', '/pose'} == set(found)
    assert found['/odom'].twist.twist.angular.z == pytest.approx(math.sin(0.5 * 39.98))
    assert found['/imu/data_raw'].header.stamp.sec == 1_700_000_039


def test_publishers_that_come_late_or_again_with_another_quality_are_received(
        ros, record, wait_until, tmp_path):
    from gyro_calibration.ros.runner import SENSOR_QOS
    from rclpy.qos import DurabilityPolicy
    robot = Robot(ros)
    recording = record('record', '--reference-topic', 'pose', '--reference-topic', 'map',
                       '--out', tmp_path / 'a.mcap', '--json')
    wait_until(lambda: 'no publisher so far of /imu/data_raw, /imu/temperature, /pose, /map'
               in recording.error, 60.0, 'a remark')
    latched = ros.publisher(robot.kinds['pose'], 'map',
                            reliable(durability=DurabilityPolicy.TRANSIENT_LOCAL))
    message = robot.kinds['pose']()
    message.header.frame_id = 'published before anybody listened'
    latched.publish(message)
    robot.offer('imu/data_raw')
    wait_until(robot.is_heard, what='the recorder')
    robot.drive(0.0, 4.0)
    robot.offer('pose', quality=SENSOR_QOS)  # best effort
    wait_until(robot.is_heard, what='the recorder')
    robot.drive(4.0, 6.0)
    wait_until(lambda: holds(tmp_path / 'a.mcap', 490), what='the last piece')
    robot.offer('imu/data_raw', quality=SENSOR_QOS)
    wait_until(robot.is_heard, what='the recorder')
    robot.drive(10.0, 2.0)
    wait_until(lambda: holds(tmp_path / 'a.mcap', 520), what='samples of the new publisher')
    code, out, error = recording.end(signal.SIGTERM)
    answer, log = json.loads(out), read(tmp_path / 'a.mcap', reference='pose')
    assert code == 0, error
    assert answer['messages'] > answer['samples'] > 0
    known = np.isfinite(log.reference_heading)
    assert known.any() and not known[log.time < 3.9].any()
    assert b'published before anybody' in b''.join(_messages(tmp_path / 'a.mcap', '/map'))


def test_a_recording_of_several_publishers_on_one_topic_says_so(
        ros, record, wait_until, tmp_path):
    robot = Robot(ros)
    ros.publisher(robot.kinds['imu/data_raw'], 'imu/data_raw')
    robot.offer('imu/data_raw')
    recording = record('record', '--out', tmp_path / 'a.mcap')
    wait_until(robot.is_heard, 60.0, 'the recorder')
    wait_until(lambda: robot.drive(0.0, 1.0) and holds(tmp_path / 'a.mcap', 50), 60.0, 'samples')
    code, out, error = recording.end(signal.SIGTERM)
    assert code == 0 and 'Several nodes published on /imu/data_raw (/test_client' in out + error


def _messages(path, topic):
    reading = pytest.importorskip('mcap.reader', reason='mcap is not installed')
    with open(path, 'rb') as file:
        return [message.data
                for _, _, message in reading.make_reader(file).iter_messages(topics=[topic])]


@pytest.mark.parametrize('name', ['a.csv', 'a.mcap'])
def test_a_topic_of_another_kind_is_refused(ros, record, tmp_path, name):
    Robot(ros).offer('odom')
    code, out, error = record('record', '--topic', 'odom', '--out', tmp_path / name).end()
    assert ((code, out) == (2, '')
            and '/odom is nav_msgs/msg/Odometry; --topic wants sensor_msgs/msg/Imu' in error)
    assert not list(tmp_path.glob('a.*'))


@pytest.mark.parametrize(('topic', 'domain', 'ended', 'sentence'), [
    ('a b', None, 2, 'gyro_calibration: /a b: no topic name (failed to resolve name'),
    ('imu', 'x', 2, 'ROS 2 cannot be started (failed to initialize rcl: '
     'ROS_DOMAIN_ID is not an integral number)'),
    ('imu', '999', 2, 'ROS_DOMAIN_ID is 999, but must be from 0 to 232'),
    ('imu', None, 1, 'no sample was received in'),
], ids=['no name', 'no domain', 'no such domain', 'no publisher'])
def test_topics_that_cannot_be_recorded_are_reported_and_leave_no_file(
        ros_domain, record, tmp_path, monkeypatch, topic, domain, ended, sentence):
    if domain is not None:
        monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    code, out, error = record('record', '--topic', topic, '--out', tmp_path / 'a.csv',
                              '--seconds', 2).end()
    assert (code, out) == (ended, '') and sentence in error
    assert error.count('\n') == 1 if ended == 2 else 'ROS_DOMAIN_ID' in error
    assert not list(tmp_path.glob('a.csv*'))


def test_without_ros_the_remedy_is_reported(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'gyro_calibration.ros.recorder_node', None)
    code, _, error = run('record', '--out', tmp_path / 'a.csv')
    assert code == 2 and 'topics need ROS 2' in error and 'record from --port' in error
