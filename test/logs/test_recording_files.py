# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""ROS 2 recordings as logs: written by rosbags in each storage, whole, torn and hostile."""

import contextlib
from dataclasses import replace
import json
import shutil
import sys

from gyro_calibration.logs.cdr import (
    DEFINITIONS, IMU, LAYOUTS, MessageError, parse, parse_layout, serialize, TEMPERATURE)
from gyro_calibration.logs.log import LogError, read_log, select_rows
from gyro_calibration.logs.recording import read_recording, Topics
from gyro_calibration.logs.ros_bag import is_recording
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.motion import motion_by_name, simulate
import numpy as np
import pytest
from recordings import BEGIN, database, DELAY, file_of, KINDS, Messages, of_log, write

RATE = 100.0


@pytest.fixture
def make():
    return Messages()


@pytest.fixture
def turning():
    """Return times over 20 s, the rate, rad/s, and its integral, which passes half turns."""
    time = np.arange(0.0, 20.0, 1.0 / RATE)
    return time, 1.5 + np.sin(0.4 * time), 1.5 * time + (1.0 - np.cos(0.4 * time)) / 0.4


def each_of(message, time, *values, **how):
    """Return a topic: the times and the messages that are made of times and values."""
    return [(at, message(at, *row, **how)) for at, *row in zip(time, *values, strict=True)]


def gyro(make, time, rate, **how):
    return each_of(make.imu, time, rate, **how)


@pytest.mark.parametrize('kind', KINDS)
def test_a_recording_holds_what_the_log_held(data, tmp_path, kind):
    log = select_rows(read_log(data / 'mems_encoder_turntable' / 'yaw_slow.csv.gz'), slice(800))
    folder = write(tmp_path / 'bag', of_log(log), **KINDS[kind])
    # As a folder, and as a file without metadata.yaml.
    for path in (folder, shutil.copy(file_of(folder), tmp_path)):
        read = read_recording(path, Topics(reference='table'))
        np.testing.assert_array_equal(read.output, log.output)
        # Stamps are whole nanoseconds.
        np.testing.assert_allclose(read.time, log.time - log.time[0], rtol=0.0, atol=0.6e-9)
        turned = read.reference_heading - read.reference_heading[0]
        np.testing.assert_allclose(turned, log.reference_heading - log.reference_heading[0],
                                   rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('frame', ['', 'g', 'gyro', 'gyro_link', 'a_longer_frame'])
def test_messages_of_any_alignment_are_parsed_as_rosbags_writes_them_and_read_by_it(make, frame):
    store = make.store
    for message in (make.imu(12.5, 0.25, 9.8, 1.0, frame), make.odometry(12.5, 1.0, 0.25, frame)):
        for little in (True, False):
            data = bytes(store.serialize_cdr(message, message.__msgtype__, little_endian=little))
            stamp, numbers = parse(data, LAYOUTS[message.__msgtype__])
            assert stamp == BEGIN + 12_500_000_000
            assert numbers[{IMU: 15}.get(message.__msgtype__, 48)] == 0.25
    numbers = [float(number) for number in range(37)]
    message = store.deserialize_cdr(serialize(BEGIN + 5, frame, numbers), IMU)
    assert ((message.header.frame_id, message.header.stamp.nanosec, message.angular_velocity.z)
            == (frame, 5, 15.0))
    assert message.linear_acceleration_covariance[8] == 36.0
    assert (parse(serialize(BEGIN, frame, [20.5, 0.0]), LAYOUTS[TEMPERATURE])
            == (BEGIN, (20.5, 0.0)))
    good = serialize(BEGIN, frame, 37 * [0.0])
    for data in (b'', good[:3], good[:15], good[:-1], b'\0\x07' + good[2:],
                 good[:12] + b'\xff' * 4 + good[16:]):
        with pytest.raises(MessageError):
            parse(data, LAYOUTS[IMU])


CUSTOM = """# a gyro of its own maker
uint8 GOOD=1
std_msgs/Header header
bool good
float32[] history
string<=20 name
Part[2] parts
float64[<=3] more
geometry_msgs/Vector3 angular_velocity
int16 temperature
string[] words
float64 behind
================================================================================
MSG: my_msgs/Part
int8 first
uint64 second
""" + DEFINITIONS[IMU][DEFINITIONS[IMU].index(80 * '='):]


@pytest.mark.parametrize('little', [True, False], ids=['little endian', 'big endian'])
def test_a_message_of_any_kind_is_parsed_by_its_definition(make, little):
    pytest.importorskip('rosbags')
    from rosbags.typesys import get_types_from_msg
    make.store.register(
        {kind: fields for kind, fields in get_types_from_msg(CUSTOM, 'my_msgs/msg/Gyro').items()
         if kind.startswith('my_msgs')})
    custom, part = (make.store.types[f'my_msgs/msg/{name}'] for name in ('Gyro', 'Part'))
    for frame, history in (('', []), ('gyro', [1.0, 2.0, 3.0])):
        message = custom(make.header(12.5, frame), True, np.array(history, np.float32), 'a name',
                         [part(1, 2), part(3, 4)], np.array(history), make.vector(0.25), 31,
                         ['x'], 7.0)
        layout = parse_layout(CUSTOM)
        stamp, numbers = parse(
            bytes(make.store.serialize_cdr(message, 'my_msgs/msg/Gyro', little_endian=little)),
            layout)
        assert (stamp, {name: numbers[place] for name, place in layout.quantities.items()}) == (
            BEGIN + 12_500_000_000, {'rate': 0.25, 'temperature': 31})


@pytest.mark.parametrize('definition', [
    '', 'float64 angular_velocity', 'std_msgs/Header header\n', 'x' * 200_000, CUSTOM[:700],
    'A a\n' + ''.join(f'{80 * "="}\nMSG: p/{name}\n{inner}[999999999] a\n'
                      for name, inner in ('AB', 'BC', 'CA')),
    'A a\n' + 80 * '=' + '\nMSG: p/A\nA a\n', 'Header header\nfloat64[999999999] a\n'])
def test_a_definition_of_nothing_or_without_end_is_refused_at_once(definition):
    with pytest.raises(MessageError):
        parse_layout(definition)


@pytest.mark.parametrize('first', ['std_msgs/Header header\nstring raw\n', ''],
                         ids=['own header', 'header of the Imu'])
def test_an_imu_in_the_message_of_a_driver_serves_where_its_topic_is_named(
        make, tmp_path, turning, monkeypatch, first):
    pytest.importorskip('rosbags')
    from rosbags.typesys import get_types_from_msg
    kind = 'my_msgs/msg/Driver'
    make.store.register(get_types_from_msg(f'{first}sensor_msgs/Imu imu\nint16 status\n', kind))
    time, rate, _ = turning

    def message(at, value):
        own = (make.header(at), 'raw') if first else ()
        return make.store.types[kind](*own, make.imu(at, value, force=9.8), 1)
    monkeypatch.setattr(Messages, '__init__', lambda self, _: vars(self).update(vars(make)))
    path = write(tmp_path / 'bag', {'driver': each_of(message, time, rate)})
    log = read_recording(path, Topics('driver'))
    np.testing.assert_array_equal(log.output, rate)
    np.testing.assert_allclose(log.time, time, atol=1e-9)
    assert log.specific_force[5] == 9.8
    with pytest.raises(LogError, match='select driver with --topic'):
        read_recording(path)


def write_chunks(path, compression, count, chunked=True):
    writing = pytest.importorskip('mcap.writer', reason='mcap is not installed')
    with open(path, 'wb') as file:
        writer = writing.Writer(file, chunk_size=10_000,
                                compression=writing.CompressionType[compression],
                                use_chunking=chunked)
        writer.start('ros2')
        writer.add_metadata('who', {'is': 'it'})
        channel = writer.register_channel('/imu', 'cdr',
                                          writer.register_schema(IMU, 'ros2msg', b''))
        for number in range(count):
            writer.add_message(
                channel, BEGIN + number,
                serialize(BEGIN + 10 ** 7 * number, 'gyro', 37 * [float(number)]), BEGIN)
        writer.finish()


@pytest.mark.parametrize('compression', ['NONE', 'LZ4', 'ZSTD'])
@pytest.mark.parametrize('chunked', [True, False])
def test_what_the_library_mcap_writes_is_read(tmp_path, compression, chunked):
    write_chunks(tmp_path / 'a.mcap', compression, 200, chunked)
    log = read_recording(tmp_path / 'a.mcap')
    np.testing.assert_array_equal(log.output, np.arange(200.0))
    assert not any('torn' in note or 'left out' in note for note in log.notes)


def test_several_files_of_a_folder_are_one_recording(make, tmp_path, turning):
    time, rate, _ = turning
    (tmp_path / 'whole').mkdir()
    for number in range(12):
        part = slice(number * 150, (number + 1) * 150)
        file = file_of(write(tmp_path / f'part_{number}',
                             {'imu': gyro(make, time[part], rate[part])}, storage='MCAP'))
        shutil.copy(file, tmp_path / 'whole' / f'whole_{number}.mcap')
    np.testing.assert_array_equal(read_recording(tmp_path / 'whole').output, rate[:1800])


@pytest.mark.parametrize('kind', ['mcap', 'mcap-chunks'])
def test_a_torn_mcap_file_is_read_up_to_the_tear(make, tmp_path, kind):
    # Enough for several chunks, the last of which is torn in its middle.
    time = np.arange(9000) / RATE
    whole = file_of(write(tmp_path / 'bag', {'imu': gyro(make, time, time)},
                          **KINDS[kind])).read_bytes()
    data = whole[:whole.index(b'rosbag2') - 13]  # without the closing part
    counts, torn = [], tmp_path / 'torn.mcap'
    for share in (0.5, 0.7, 0.9, 1.0):
        torn.write_bytes(data[:int(share * len(data))] + bytes(4096) * (share == 1.0))
        log = read_recording(torn)
        counts.append(len(log))
        np.testing.assert_array_equal(log.output, time[:len(log)])
        assert any('is torn after' in note for note in log.notes)
    # There are three chunks, so that most cuts lie within one: all that is left of it is read.
    assert counts == sorted(set(counts)) and counts[0] > 3000 and counts[-1] == 9000


def test_a_damaged_chunk_is_left_out_and_reported(tmp_path):
    write_chunks(tmp_path / 'a.mcap', 'ZSTD', 2000)
    data = bytearray((tmp_path / 'a.mcap').read_bytes())
    middle = data.index(b'zstd', len(data) // 3) + 100
    data[middle:middle + 20] = bytes(20)
    (tmp_path / 'a.mcap').write_bytes(data)
    log = read_recording(tmp_path / 'a.mcap')
    assert 1900 < len(log) < 2000 and (np.diff(log.output) > 0).all()
    assert any('damaged or oversized parts left out: 1' in note
               for note in log.notes)


def test_a_torn_database_is_read_up_to_the_tear(make, tmp_path):
    time = np.arange(2000) / RATE
    path = file_of(write(tmp_path / 'bag', {'imu': gyro(make, time, time)}))
    data = path.read_bytes()
    path.write_bytes(data[:len(data) * 2 // 3])
    log = read_recording(path)
    assert 100 < len(log) < 2000
    np.testing.assert_array_equal(log.output, time[:len(log)])
    assert any('read up to there' in note for note in log.notes)


def test_what_a_killed_writer_left_with_its_database_is_read(tmp_path):
    messages = [('/imu', BEGIN + number,
                 serialize(BEGIN + number * 10 ** 7, 'gyro', 37 * [float(number)]))
                for number in range(300)]
    with contextlib.closing(database(tmp_path / 'live.db3', {'/imu': IMU}, messages,
                                     'PRAGMA journal_mode=WAL')):
        (tmp_path / 'dead').mkdir()
        for file in tmp_path.glob('live.db3*'):
            shutil.copy(file, tmp_path / 'dead')
    assert len(read_recording(tmp_path / 'dead')) == 300


def test_a_compressed_recording_says_which_package_it_needs(make, tmp_path, monkeypatch):
    time = np.arange(300) / RATE
    topics = {'imu': gyro(make, time, time)}
    plain = write(tmp_path / 'plain', topics, storage='MCAP')
    packed = write(tmp_path / 'packed', topics, **KINDS['mcap-chunks'])
    monkeypatch.setitem(sys.modules, 'zstandard', None)
    assert len(read_recording(plain)) == 300
    with pytest.raises(LogError,
                       match='needs the Python package zstandard: pip install zstandard'):
        read_recording(packed)


def test_only_recordings_are_taken_for_recordings_and_one_that_is_not_there_is_not_made(tmp_path):
    assert not any(map(is_recording, ['log.csv', 'log.csv.gz', '/dev/stdin', 'a.mcap.csv']))
    assert all(map(is_recording, ['a.mcap', 'a.db3', 'a.mcap.zstd', 'a.db3.zstd', tmp_path]))
    with pytest.raises(LogError, match=r'a folder without an \.mcap or \.db3 file'):
        read_recording(tmp_path)
    for name in ('missing.mcap', 'missing.db3', 'missing.db3.zstd'):
        with pytest.raises(LogError, match=f'{name}: cannot be read .no such file or directory.'):
            read_recording(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_of_several_gyros_one_has_to_be_named(make, run, tmp_path, turning):
    time, rate, _ = turning
    path = write(tmp_path / 'bag', {'/imu/data_raw': gyro(make, time, rate),
                                    '/imu/data': gyro(make, time, 2 * rate)})
    code, _, error = run('allan', path)
    assert code == 2 and '/imu/data and /imu/data_raw; select one with --topic' in error
    for name in ('imu/data', '/imu/data'):
        np.testing.assert_array_equal(read_recording(path, Topics(name)).output, 2 * rate)
    # It is the only one left.
    np.testing.assert_array_equal(read_recording(path, Topics(reference='imu/data')).output, rate)


#: A Messages and times -> topics of a recording; which of them are read; words.
REFUSED = {
    'no such topic': (lambda make, time: {'/imu': gyro(make, time, time), '/t': degc(make)},
                      Topics('gyro'), r'no topic gyro; there are /imu \(sensor_msgs/msg/Imu\) '
                                      r'and /t \(sensor_msgs/msg/Temp'),
    'no reference': (lambda make, time: {'/imu': gyro(make, time, time), '/t': degc(make)},
                     Topics(reference='t'), '/t is sensor_msgs/msg/Temperature; '
                                            '--reference-topic wants nav_msgs/msg/Odometry, '),
    'its own reference': (lambda make, time: {'/imu': gyro(make, time, time)},
                          Topics('imu', reference='imu'), 'cannot be its own reference'),
    'no gyro': (lambda make, time: {'/t': degc(make)}, Topics(),
                'no message of sensor_msgs/msg/Imu in it; there are /t'),
    'no rate': (lambda make, time: {'imu': gyro(make, time, time, reports_rate=False)}, Topics(),
                'reports no angular velocity'),
    'a reference of another time': (
        lambda make, time: {'imu': gyro(make, time, time),
                            'pose': each_of(make.pose, time + 3600.0, time)},
        Topics(reference='pose'), 'no heading and no rate at the times of the gyro'),
}


def degc(make, value=20.0):
    return [(0.0, make.temperature(0.0, value))]


@pytest.mark.parametrize('topics, chosen, words', REFUSED.values(), ids=REFUSED)
def test_what_is_no_log_of_a_gyro_is_refused(make, tmp_path, topics, chosen, words):
    path = write(tmp_path / 'bag', topics(make, np.arange(300) / RATE))
    with pytest.raises(LogError, match=words):
        read_recording(path, chosen)


def test_times_are_those_of_the_headers(make, tmp_path):
    time = np.arange(300) / RATE
    received = time + 0.5 * np.random.default_rng(1).random(300)  # a busy host
    topics = {'imu': [(late, make.imu(at, at)) for at, late in zip(time, received)]}
    log = read_recording(write(tmp_path / 'bag', topics))
    np.testing.assert_allclose(log.time, time, atol=1e-9)
    np.testing.assert_array_equal(log.output, time)
    assert any(f'time_s from {BEGIN // 10 ** 9}.' in note for note in log.notes)
    assert any('out of order were sorted' in note for note in log.notes)


@pytest.mark.parametrize('stamp', [None, 7.0], ids=['zero', 'always the same'])
def test_without_stamps_the_times_of_receiving_are_taken_and_reported(make, tmp_path, stamp):
    time = np.arange(300) / RATE
    topics = {'imu': [(at, make.imu(stamp, at)) for at in time],
              'pose': each_of(make.pose, time, time)}
    log = read_recording(write(tmp_path / 'bag', topics), Topics(reference='pose'))
    np.testing.assert_allclose(log.time, time, atol=1e-9)
    np.testing.assert_allclose(log.reference_heading, time, atol=1e-9)  # from the gyro's clock
    assert any('times are those of receipt' in note for note in log.notes)
    assert any(f'time_s from {BEGIN // 10 ** 9}.{DELAY:09d} s' in note for note in log.notes)


def test_doubled_samples_are_left_out_and_reported(make, tmp_path):
    time = np.arange(300) / RATE
    topics = {'imu': sorted(gyro(make, time, time) + gyro(make, time[100:200], time[100:200]),
                            key=lambda each: each[0])}
    log = read_recording(write(tmp_path / 'bag', topics))
    np.testing.assert_array_equal(log.output, time)
    assert any('100 samples with the stamp of another one were left out' in note
               for note in log.notes)


def test_stamps_that_say_nothing_are_refused_unless_the_rate_is_given(make, tmp_path):
    time = np.arange(300) / RATE
    path = write(tmp_path / 'bag',
                 {'imu': [(at, make.imu(np.floor(10 * at) / 10, at)) for at in time]})
    with pytest.raises(LogError, match='270 of 300 samples of imu have the stamp of another '
                                       'sample.* give the sample rate'):
        read_recording(path)
    log = read_recording(path, rate=RATE)
    np.testing.assert_array_equal(log.output, time)
    np.testing.assert_array_equal(log.time, time)


def test_temperatures_lie_on_the_line_between_readings_and_long_gaps_are_reported(make, tmp_path):
    time = np.arange(0.0, 100.0, 0.1)
    imu = gyro(make, time, time)

    def read(name, readings):
        return read_recording(write(tmp_path / name, {'imu': imu, 't': readings}))
    log = read('slow', [(at, make.temperature(at, 20.0 + at)) for at in np.arange(2.5, 99.0)])
    np.testing.assert_allclose(log.temperature, 20.0 + np.clip(time, 2.5, 98.5), atol=1e-9)
    assert not any('no temperature came' in note for note in log.notes)
    log = read('some', [(at, make.temperature(at, 20.0 + at)) for at in range(10)])
    np.testing.assert_allclose(log.temperature, 20.0 + np.clip(time, 0.0, 9.0), atol=1e-9)
    assert any('no temperature came for up to 91 s' in note for note in log.notes)
    log = read('other', [(0.0, make.temperature(-3600.0, 20.0)),
                         (1.0, make.temperature(-3599.0, np.nan))])
    assert log.temperature is None and any('has none at the times' in note for note in log.notes)


def test_of_several_temperatures_the_one_named_like_the_gyro_is_taken(make, tmp_path, turning):
    time, rate, _ = turning
    topics = {'gyro/imu': gyro(make, time, rate),
              'battery/temperature': degc(make, 5.0), 'gyro/temperature': degc(make, 30.0)}
    path = write(tmp_path / 'bag', topics)
    np.testing.assert_array_equal(read_recording(path).temperature, 30.0)
    np.testing.assert_array_equal(
        read_recording(path, Topics(temperature='battery/temperature')).temperature, 5.0)


@pytest.mark.parametrize('distribution', ['ROS2_FOXY', 'ROS2_HUMBLE', 'ROS2_JAZZY', 'ROS2_KILTED'])
def test_each_kind_of_reference_of_any_distribution_gives_what_it_holds(
        tmp_path, turning, distribution):
    make, (time, rate, heading) = Messages(distribution), turning
    force, still = np.full(len(time), 9.8), 0.0 * time
    path = write(tmp_path / 'bag', {
        'imu': gyro(make, time, rate, force=9.8),
        'odom': each_of(make.odometry, time, heading, rate),
        'other': each_of(make.imu, time, rate, force, heading),
        'pose': each_of(make.pose, time, heading), 'twist': each_of(make.twist, time, rate),
        'without rate': each_of(make.odometry, time, heading, still),
        'bare': gyro(make, time, rate), 'vector': each_of(make.vector_stamped, time, rate),
        'covariance': each_of(make.pose_with_covariance, time, heading)},
        distribution=distribution)
    np.testing.assert_array_equal(read_recording(path, Topics('vector', 'pose')).output, rate)
    with pytest.raises(LogError, match='--topic wants sensor_msgs/msg/Imu'):
        read_recording(path, Topics('pose'))
    for name, held in (('odom', (heading, rate)), ('other', (heading, rate)),
                       ('pose', (heading, None)), ('twist', (None, rate)), ('bare', (None, rate)),
                       ('without rate', (heading, None)), ('covariance', (heading, None))):
        log = read_recording(path, Topics('imu', name))
        np.testing.assert_array_equal([log.output, log.specific_force], [rate, force], name)
        for found, wanted in zip((log.reference_heading, log.reference_rate), held, strict=True):
            assert (found is None) == (wanted is None), name
            assert found is None or found == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_lost_reference_is_nan_and_goes_on_with_the_right_turn(make, tmp_path, turning, sign):
    time, rate, heading = turning
    lost = (time > 5.0) & (time < 12.0)  # more than two turns
    imu = gyro(make, time, sign * (rate + 0.3))  # a bias, and perhaps upside down
    log = read_recording(write(tmp_path / 'bag', {'imu': imu, 'pose': each_of(
        make.pose, time, np.where(lost, np.nan, heading))}), Topics(reference='pose'))
    np.testing.assert_array_equal(np.isnan(log.reference_heading), lost)
    np.testing.assert_allclose(log.reference_heading[~lost], heading[~lost], atol=1e-9)
    assert any('more than half a turn' in note for note in log.notes)


@pytest.mark.parametrize('verb, motion', [
    ('fit', 'robot'), ('self-calibrate', 'calibration'), ('allan', 'rest'), ('diagnose', 'rest'),
    ('compensate', 'robot')])
def test_a_verb_that_takes_a_log_takes_a_recording(run, tmp_path, verb, motion):
    model = tmp_path / 'model.yaml'
    model.write_text('effects: {bias: {bias: 0.002}}\nnoise: {angle_random_walk: 0.0001}\n')
    log = simulate(read_model(model), motion_by_name(motion), 25.0, np.random.default_rng(1))
    recording = write(tmp_path / 'bag', of_log(replace(log, reference_rate=None)), storage='MCAP')
    words = {'diagnose': ['--model', model], 'compensate': [
        '--model', model, '--out', tmp_path / 'out.csv']}.get(verb, [])
    words += [] if motion == 'rest' else ['--reference-topic', 'table']
    code, answer, error = run(verb, recording, '--json', *words)
    assert code == 0 and json.loads(answer) and 'gyro: imu/data_raw' in error, error
