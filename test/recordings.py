# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Recordings for tests: by the library rosbags, independent of the reader here, and by hand."""

import sqlite3
import struct

import numpy as np

BEGIN = 1_700_000_000_000_000_000  # ns
DELAY = 2_000_000  # how long after its stamp a message was received, in ns
#: Kind of storage -> arguments of `write`.
KINDS = {'sqlite3': {}, 'sqlite3-file': {'mode': 'FILE'}, 'sqlite3-message': {'mode': 'MESSAGE'},
         'mcap': {'storage': 'MCAP'}, 'mcap-chunks': {'storage': 'MCAP', 'mode': 'STORAGE'},
         'mcap-file': {'storage': 'MCAP', 'mode': 'FILE'},
         'mcap-message': {'storage': 'MCAP', 'mode': 'MESSAGE'}}


def rosbags():
    import pytest  # not where a fuzzer takes the builders below
    pytest.importorskip('rosbags',
                        reason='rosbags, which writes recordings for tests, is not installed')
    from rosbags import rosbag2, typesys
    return rosbag2, typesys


class Messages:
    """Makes messages of a distribution, with stamps in s after the begin of a recording."""

    def __init__(self, distribution='ROS2_JAZZY'):
        _, typesys = rosbags()
        self.store = typesys.get_typestore(getattr(typesys.Stores, distribution))
        self._types = self.store.types

    def _make(self, kind, *values):
        return self._types[kind](*values)

    def header(self, time, frame='gyro'):
        stamp = 0 if time is None else BEGIN + round(time * 1e9)
        return self._make('std_msgs/msg/Header', self._make(
            'builtin_interfaces/msg/Time', stamp // 10 ** 9, stamp % 10 ** 9), frame)

    def vector(self, z, kind='geometry_msgs/msg/Vector3'):
        return self._make(kind, 0.0, 0.0, float(z))

    def quaternion(self, heading):
        """Return a rotation about z; None is that of a message that nobody filled in."""
        half = 0.0 if heading is None else heading / 2.0
        return self._make('geometry_msgs/msg/Quaternion', 0.0, 0.0, np.sin(half), np.cos(half))

    def imu(self, time, rate, force=None, heading=None, frame='gyro', reports_rate=True):
        def covariance(value):
            return np.array([value, *8 * [0.0]])
        return self._make('sensor_msgs/msg/Imu', self.header(time, frame),
                          self.quaternion(heading), covariance(-float(heading is None)),
                          self.vector(rate), covariance(0.0 if reports_rate else -1.0),
                          self.vector(force or 0.0), covariance(-float(force is None)))

    def temperature(self, time, value):
        return self._make('sensor_msgs/msg/Temperature', self.header(time), float(value), 0.0)

    def _pose(self, heading):
        return self._make('geometry_msgs/msg/Pose', self.vector(0.0, 'geometry_msgs/msg/Point'),
                          self.quaternion(heading))

    def _twist(self, rate):
        return self._make('geometry_msgs/msg/Twist', self.vector(0.0), self.vector(rate))

    def odometry(self, time, heading, rate, child='base_link'):
        pose = self._make('geometry_msgs/msg/PoseWithCovariance', self._pose(heading),
                          np.zeros(36))
        twist = self._make('geometry_msgs/msg/TwistWithCovariance', self._twist(rate),
                           np.zeros(36))
        return self._make('nav_msgs/msg/Odometry', self.header(time, 'odom'), child, pose, twist)

    def pose(self, time, heading):
        return self._make('geometry_msgs/msg/PoseStamped', self.header(time, 'map'),
                          self._pose(heading))

    def pose_with_covariance(self, time, heading):
        return self._make('geometry_msgs/msg/PoseWithCovarianceStamped', self.header(time, 'map'),
                          self.odometry(time, heading, 0.0).pose)

    def vector_stamped(self, time, rate):
        return self._make('geometry_msgs/msg/Vector3Stamped', self.header(time),
                          self.vector(rate))

    def twist(self, time, rate):
        return self._make('geometry_msgs/msg/TwistStamped', self.header(time, 'base_link'),
                          self._twist(rate))


def write(path, topics, storage='SQLITE3', mode='NONE', distribution='ROS2_JAZZY'):
    """
    Write a recording in a folder and return its path.

    Parameters
    ----------
    path : of the folder
    topics : topic -> (time of receiving in s without the delay, message) of each
    storage, mode, distribution : names in the library

    """
    rosbag2, _ = rosbags()
    store = Messages(distribution).store
    rows = sorted(((time, topic, message) for topic, messages in topics.items()
                   for time, message in messages), key=lambda row: row[0])
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage])
    writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with writer:
        kinds = {topic: messages[0][1].__msgtype__ for topic, messages in topics.items()}
        connections = {topic: writer.add_connection(topic, kind, typestore=store)
                       for topic, kind in kinds.items()}
        for time, topic, message in rows:
            writer.write(connections[topic], BEGIN + round(time * 1e9) + DELAY,
                         store.serialize_cdr(message, kinds[topic]))
    return path


def of_log(log):
    """Return the topics of a recording of a whole log, a message for each value at its time."""
    make, time = Messages(), log.time - log.time[0]
    force = [None] * len(log) if log.specific_force is None else log.specific_force.tolist()
    topics = {'imu/data_raw': [(at, make.imu(at, rate, each))
                               for at, rate, each in zip(time, log.output, force, strict=True)]}
    if log.temperature is not None:
        topics['imu/temperature'] = [(at, make.temperature(at, value))
                                     for at, value in zip(time, log.temperature, strict=True)]
    if log.reference_heading is not None:
        known = np.flatnonzero(np.isfinite(log.reference_heading))
        topics['table'] = [(time[row], make.pose(time[row], log.reference_heading[row]))
                           for row in known]
    return topics


def file_of(path):
    return next(file for file in path.iterdir() if file.name != 'metadata.yaml')


# By hand: odd, torn and hostile ones

MCAP = b'\x89MCAP0\r\n'


def text(words):
    return struct.pack('<I', len(words.encode())) + words.encode()


def record(code, body):
    return struct.pack('<BQ', code, len(body)) + body


def chunk(content, compression='', size=None, checksum=0):
    """Return a chunk of MCAP whose content, once unpacked, has this size, as it says."""
    return record(6, struct.pack('<QQQI', 0, 0, len(content) if size is None else size,
                                 checksum)
                  + text(compression) + struct.pack('<Q', len(content)) + content)


def channel(number, topic, kind):
    return (record(3, struct.pack('<H', number) + text(kind) + text('ros2msg') + text(''))
            + record(4, struct.pack('<HH', number, number) + text(topic) + text('cdr') + text('')))


def database(path, topics, messages=None, pragma='PRAGMA user_version'):
    """
    Return an open database as rosbag2 writes one.

    Parameters
    ----------
    path : of the file
    topics : topic -> kind
    messages : (topic, ns, bytes) of each; None makes no table of messages
    pragma : executed before the tables are made

    """
    made = sqlite3.connect(path)
    made.execute(pragma)
    made.execute('CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, '
                 'serialization_format TEXT)')
    made.executemany("INSERT INTO topics(name, type, serialization_format) VALUES (?, ?, 'cdr')",
                     topics.items())
    if messages is not None:
        numbers = {topic: number for number, topic in enumerate(topics, 1)}
        made.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, '
                     'timestamp INTEGER, data BLOB)')
        made.executemany('INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)',
                         ((numbers[topic], *rest) for topic, *rest in messages))
    made.commit()
    return made
