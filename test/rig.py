# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
A small robot, and a pipeline joined to it as the node joins them, with a clock that a test steps.

`Robot` computes: commands in, odometry and the samples of a gyro out. `Rig` joins it to a pipeline
without rclpy and without waiting: a run of 24 s takes a fraction of a second, and a call of
`Rig.step` does what the compensation node does in the interval of one sample. All units are SI;
angles are counter-clockwise positive.
"""

from collections import deque
from dataclasses import dataclass
from itertools import repeat
import math
import random

from gyro_calibration.ros.calibration_session import PROFILE
from gyro_calibration.ros.inputs import parameter_values, Velocity
from gyro_calibration.ros.pipeline import PARAMETERS, Pipeline

INTERVAL = 0.01  # s between samples


@dataclass(frozen=True)
class Reading:
    stamp: float  # of sample and odometry, s
    output: float | None  # rate that the gyro reports, rad/s; None while it is unplugged
    heading: float  # by odometry, rad, not wrapped
    rate: float  # by odometry, rad/s


class Robot:
    """
    A base that follows commands late, and a gyro on it.

    The noise is that of a sample, rad/s. A command acts after the latency, with the time constant
    `lag`, s; without one for the timeout, s, the base stops, unless it is `deaf`: then it goes on
    with what it did last. `distort` makes of the output what the gyro reports.
    """

    def __init__(self, *, scale_factor_error=0.0373, bias=0.01, noise=1e-3, latency=0.15, lag=0.2,
                 timeout=math.inf, stamp=1000.0, seed=0):
        self.time = self.heading = self.rate = 0.0
        self.unplugged = self.stamps_stand = self.deaf = False
        self.distort = lambda output: output
        self.scale_factor_error, self.bias, self.noise = scale_factor_error, bias, noise
        self._latency, self._lag, self._timeout = latency, lag, timeout
        self._stamp, self._random = stamp, random.Random(seed)
        self._steps, self._target, self._heard = 0, 0.0, -math.inf
        self._commands = deque()

    def command(self, rate):
        """Take a command to turn, rad/s, at the time of the last step; it acts after a latency."""
        if not self.deaf:
            self._heard = self.time
            self._commands.append((self.time + self._latency, rate))

    def step(self):
        """Go on by the interval of the samples, and return a `Reading`."""
        self._steps += 1
        self.time = self._steps * INTERVAL
        while self._commands and self._commands[0][0] <= self.time + 1e-9:
            self._target = self._commands.popleft()[1]
        if not self.deaf and self.time - self._heard > self._timeout + self._latency:
            self._target = 0.0
        # exact for a target that is constant over the step
        kept = math.exp(-INTERVAL / self._lag)
        self.heading += (self._target * INTERVAL
                         + (self.rate - self._target) * self._lag * (1 - kept))
        self.rate = self._target + (self.rate - self._target) * kept
        if not self.stamps_stand:
            self._stamp += INTERVAL
        output = ((1.0 + self.scale_factor_error) * self.rate + self.bias
                  + self._random.gauss(0.0, self.noise))
        return Reading(self._stamp, None if self.unplugged else self.distort(output), self.heading,
                       self.rate)


BEGIN = 1_700_000_000  # s since 1970
NSEC_PER_SEC = 10 ** 9
MODEL = 'effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 1.0e-4}\n'


class StepClock:
    """The clocks of a node, stepped by a test; `ros` is the time of a simulation, s."""

    def __init__(self, ros=None):
        self.now, self.ros = 1000.0, ros
        self.set_by = 0.0  # what somebody set the clock of the host by, s

    def steady(self):
        return self.now

    def date(self):
        return BEGIN - 1000.0 + self.now + self.set_by

    def simulated(self):
        return self.ros


class Rig:
    """
    A pipeline, a robot that obeys its commands, and what comes out.

    The model is the text of its file, '' for none; stamps follow a simulation that begins at
    `ros`, s. Of the parameters of the node ``calibration_drive=True`` is ``calibration.drive``.
    """

    def __init__(self, folder, model=MODEL, robot=None, ros=None, calibration_file=None,
                 **parameters):
        self.clock, self.robot = StepClock(ros), robot or Robot()
        self.commands = []  # time of the steady clock, s, and rate, rad/s
        self.outputs = []  # what `Pipeline.add_sample` returned, without None
        self.truth = {}  # true heading, rad, by stamp, ns
        self.publishers = ['/driver_node']  # who publishes the samples
        self.receivers = self.callers = 1  # of cmd_vel, and clients that calibrate
        self.ros_speed = 1.0  # seconds of the simulation in one second; 0 while it stands
        self.speed = 1.0  # seconds of robot and simulation in one second of the steady clock
        self.other = None  # what somebody else commands at 20 Hz, rad/s
        self.fed = BEGIN * NSEC_PER_SEC  # stamp of the last sample of `feed`, ns
        self._steps, self._stamp, self._echoes, self._timers = 0, 0, [], {}
        if model:
            (folder / 'model.yaml').write_text(model)
            parameters = {'model_file': str(folder / 'model.yaml'), **parameters}
        names = {each.attribute: each.name for each in PARAMETERS}
        self._given = {names[attribute]: value for attribute, value in parameters.items()}
        self.calibration_file = calibration_file or folder / 'calibration.yaml'
        self.pipeline = Pipeline(parameter_values(PARAMETERS, self._given), self.calibration_file,
                                 self.clock, self._send)
        self.session, self.journal = self.pipeline.session, self.pipeline.journal

    def _send(self, rate):
        self.commands.append((self.clock.now, rate))
        self._echoes.append(rate)
        if self.receivers:
            self.robot.command(rate)

    def set(self, **parameters):  # noqa: A003
        names = {each.attribute: each.name for each in PARAMETERS}
        self._given.update({names[attribute]: value for attribute, value in parameters.items()})
        self.pipeline.values = parameter_values(PARAMETERS, self._given)

    def pace_stamps(self, pace):
        """Let the stamps go on from now at another pace than the clock."""
        stamp, begin = self.stamp, self.clock.now
        self.stamp = lambda reading: stamp(reading) + round(1e9 * (pace - 1)
                                                            * (self.clock.now - begin))

    def hold_up_samples(self, is_busy):
        """Let samples wait while this computer is busy, and come together then."""
        sample, waiting = self.sample, []

        def late(*reading):
            waiting.append(reading)
            while waiting and not is_busy():
                sample(*waiting.pop(0))
        self.sample = late

    def stamp(self, reading):
        if self.clock.ros is not None:
            if not self.robot.stamps_stand:
                self._stamp = round(1e9 * self.clock.ros)
            return self._stamp
        return BEGIN * NSEC_PER_SEC + round(1e9 * (reading.stamp - 1000.0 + self.clock.set_by))

    def step(self):
        self._steps += 1
        self.clock.now += INTERVAL / self.speed
        if self.clock.ros:
            self.clock.ros += INTERVAL * self.ros_speed
        for _ in range(len(self._echoes)):
            self.pipeline.add_command(Velocity(angular=(0.0, 0.0, self._echoes.pop(0))))
        if self.other is not None and self._steps % 5 == 0:
            self.robot.command(self.other)
            self.pipeline.add_command(Velocity(angular=(0.0, 0.0, self.other)))
        reading = self.robot.step()
        stamp = self.stamp(reading)
        self.odometry(stamp, reading)
        if reading.output is not None:
            self.sample(stamp, reading.output, reading.heading)
        self.guards()

    def odometry(self, stamp, reading):
        heading = math.remainder(reading.heading, math.tau)
        self.pipeline.add_odometry(stamp, heading, Velocity(angular=(0.0, 0.0, reading.rate)))

    def sample(self, stamp, output, heading=math.nan):
        self.truth[stamp] = heading
        found = self.pipeline.add_sample(stamp, output, receivers=self.receivers)
        if found is not None:
            self.outputs.append(found)
        return found

    def guards(self):
        """Look as the timers of the node do: every 20 ms during a drive, else every 0.2 s."""
        if self._is_due('look', 0.2):
            self.pipeline.update_publishers(self.publishers)
            self.session.update_callers(self.callers)
        if self._is_due('watch', 0.02 if self.session.is_driving else 0.2):
            self.pipeline.poll(self.receivers)
        if self._is_due('learn', 1.0):
            self.pipeline.run_periodic_tasks()

    def _is_due(self, timer, period):
        due = self.clock.now > self._timers.get(timer, -math.inf) + period - 1e-6
        if due:
            self._timers[timer] = self.clock.now
        return due

    def go(self, seconds=60.0, until=lambda: False):
        """Step for a time, or until a condition holds; return whether it did."""
        for _ in range(round(seconds / INTERVAL)):
            if until():
                return True
            self.step()
        return until()

    def turn(self, rate, seconds):
        self.robot.command(rate)
        self.go(seconds)

    def feed(self, outputs, interval=INTERVAL, temperature=None, moving=None):
        """Play outputs, rad/s, without the robot; `moving` is what odometry shows, rad/s."""
        found, is_one = [], temperature is None or isinstance(temperature, float)
        for output, degc in zip(outputs, repeat(temperature) if is_one else temperature):
            self._steps += 1
            self.clock.now += interval
            self.fed += round(1e9 * interval)
            if degc is not None:
                self.pipeline.add_temperature(self.fed, float(degc))
            if moving is not None:
                self.pipeline.add_odometry(self.fed, 0.0, Velocity(angular=(0.0, 0.0, moving)))
            found.append(self.pipeline.add_sample(self.fed, float(output), None, self.receivers))
            self.outputs += [found[-1]] if found[-1] else []
            self.guards()
        return found

    def skip(self, seconds, steady=None):
        """Let the stamps of `feed` jump, and the steady clock by as much or by another time."""
        self.fed += round(1e9 * seconds)
        self.clock.now += seconds if steady is None else steady

    def begin(self, kind=PROFILE):
        drive = self.pipeline.values.calibration_drive and kind == PROFILE
        obstacle = self.pipeline.find_obstacle() if drive else self.pipeline.find_conflict(kind)
        return self.session.begin(kind, self.pipeline.values, obstacle)

    @property
    def ended(self):
        """Tell whether a run has ended, and only its answer is left."""
        run = self.session.run
        return run is None or run.end_reason is not None

    def calibrate(self, kind=PROFILE, seconds=60.0):
        if refusal := self.begin(kind):
            return False, refusal
        return self.end(seconds)

    def end(self, seconds=60.0):
        assert self.go(seconds, lambda: self.ended), 'no end of the run'
        return self.session.conclude()

    def stop(self):
        assert self.session.cancel()[0]
        return self.session.conclude()

    def drive_to(self):
        """Begin a calibration that drives the robot; return when it turns at 0.7 rad/s."""
        assert not self.begin()
        assert self.go(10.0, lambda: abs(self.robot.rate) > 0.7)

    def stopped_after(self, since):
        """Return how long after a time the last command to turn was followed by a zero, s."""
        sent = [(when, rate) for when, rate in self.commands if when >= since]
        last = max([when for when, rate in sent if rate], default=since)
        zeros = [when for when, rate in sent if not rate and when >= last]
        return zeros[0] - since if zeros else math.inf

    def error(self, begin=10, end=-1):
        """Return what the heading is off by from one output to another, and its deviation, rad."""
        first, last = self.outputs[begin], self.outputs[end]
        truth = self.truth[last.stamp] - self.truth[first.stamp]
        deviation = math.sqrt(max(last.heading_variance - first.heading_variance, 0.0))
        return last.heading - first.heading - truth, deviation


def rested(*arguments, seconds=3.0, **parameters):
    rig = Rig(*arguments, **parameters)
    rig.go(seconds)
    return rig


def driven(*arguments, **parameters):
    """Return a rig whose robot is in the midst of a calibration that drives it."""
    rig = rested(*arguments, calibration_drive=True, **parameters)
    rig.drive_to()
    return rig
