# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A serial port with devices behind it, its faults, and a clock that goes on while it waits."""

import heapq
import itertools
import math

from gyro_calibration.driver.connection import Connection, PortError
from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample, Settings
import numpy as np

BEGIN = 100.0  # s
STEP = 0.1  # s; what `SerialPort.read` waits for a first byte
#: With what a format cannot be without: one unit of fizoptika has 27880 counts per deg/s.
SETTINGS = {
    name: Settings(sensitivity=np.radians(1.0 / 27880.0) if protocol.sensitivity is None else None)
    for name, protocol in PROTOCOLS.items()}


class World:
    """
    Devices that send bytes at their times, for as long as the world lasts.

    It is the clock of a `Connection`, the event that stops it, and what makes its ports.
    """

    def __init__(self, seconds, baud=None):
        self.now, self._end, self._baud = BEGIN, BEGIN + seconds, baud
        self.plugged, self.restart, self.answer = True, 0.0, None
        self.asked, self.openings, self.attempts = [], [], 0
        self._events, self._number = [], itertools.count()

    # the clock

    def __call__(self):
        return self.now

    def at(self, seconds, action):
        heapq.heappush(self._events, (BEGIN + seconds, next(self._number), action))

    def sleep(self, seconds):
        """Let time go on, to the next byte at most; return whether all of it has passed."""
        end = self.now + seconds
        while self._events and self._events[0][0] <= end:
            self.now, _, action = heapq.heappop(self._events)
            if action():
                return False
        self.now = end
        return True

    # the event

    def is_set(self):
        return self.now >= self._end

    def wait(self, seconds):
        end = self.now + min(seconds, self._end - self.now)
        while self.now < end:
            self.sleep(end - self.now)

    # devices

    def send(self, data, begin=0.0, end=math.inf, rate=100.0):
        """Send bytes, or what an iterator gives, at a rate in Hz from a time to another, s."""
        pieces = itertools.repeat(data) if isinstance(data, bytes) else data
        end = min(end, self._end - BEGIN)

        def go_on(number):
            def deliver():
                if begin + (number + 1) / rate < end:
                    self.at(begin + (number + 1) / rate, go_on(number + 1))
                return self._deliver(next(pieces, b''))
            return deliver
        self.at(begin, go_on(0))

    def gyro(self, protocol, outputs=None, settings=None, rate=100.0, **when):
        """Be a gyro with a protocol, whose outputs may be given, rad/s."""
        encode, numbers = (find_protocol(protocol).encoder(settings
                                                           or Settings()), itertools.count())
        outputs = itertools.repeat(0.5) if outputs is None else outputs
        self.send((encode(Sample(output, 31.5, number / rate, number, specific_force=9.81))
                   for output, number in zip(outputs, numbers)), rate=rate, **when)

    def plug(self):
        self.plugged = True

    def unplug(self):
        self.plugged = False
        return True

    def _deliver(self, data):
        port = self.openings[-1] if self.openings else None
        if not self.plugged or port is None or not port.is_open or self.now < port.talks:
            return False
        if self.answer is not None and port.answers:
            data = self.answer
        is_right = self._baud in (None, port.baud)
        port.data += data if is_right else bytes(byte * 37 + 11 & 0xFF for byte in data)
        return True

    # the port

    def port(self, path, baud):
        return _Port(self, path, baud)


class _Port:

    def __init__(self, world, path, baud):
        self._world, self.path, self.baud = world, path, baud
        self.data, self.is_open, self.talks, self.answers = b'', False, math.inf, False

    def open(self):  # noqa: A003
        self._world.attempts += 1
        if not self._world.plugged:
            raise PortError(f'cannot open {self.path}: it does not exist')
        self.is_open, self.talks = True, self._world.now + self._world.restart
        self._world.openings.append(self)

    def read(self):
        if not self.data:
            self._world.sleep(STEP)
        if not self._world.plugged:
            self.close()
            raise PortError(f'lost {self.path}: the device was disconnected')
        data, self.data = self.data, b''
        return data

    def write(self, data):
        self._world.asked.append(data)
        self.answers = self.answers or bool(data) and self._world.now >= self.talks

    def set_baud(self, baud):
        self.baud, self.data = baud, b''

    def close(self):
        self.is_open = False


class Reading:
    """All that a connection gives while a world lasts."""

    def __init__(self, world, protocol='auto', port='/dev/gyro', settings=None, baud=0):
        self.world, self.states, self.times = world, [], []
        self.connection = Connection(str(port), protocol, baud, settings, self._on_change, world,
                                     world.port)
        self.chunks = list(self.connection.chunks(world))
        self.samples = [sample for chunk in self.chunks for sample in chunk.samples]
        self.stamps = [stamp for chunk in self.chunks for stamp in chunk.stamps]
        self.steps = [later - earlier for earlier, later in itertools.pairwise(self.stamps)]
        self.problems = [state.problem for state in self.states if state.problem]
        self.names = [state.name for state in self.states]

    def _on_change(self, state):
        self.states.append(state)
        self.times.append(self.world.now - BEGIN)
