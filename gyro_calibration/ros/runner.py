"""
What the ROS nodes share: parameters, qualities of service, calls at intervals, and how a node starts and ends.

A node is a subclass of `rclpy.node.Node` that declares its table of `Parameter` records in its constructor, and joins threads of its
own in `destroy_node`. Its ``main`` is ``return run(TheNode)``.

"""

from __future__ import annotations

import faulthandler
import math
import reprlib
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

NOT_REPORTED = -1.0
"""Element 0 of the covariance of a quantity that a message does not report (REP-145)."""

UNMEASURED_VARIANCE = 1e6
"""
Variance of the rates about x and y, which a gyro with one axis does not measure, in (rad/s)².

All zeros would say that the whole covariance is unknown, z included. A standard deviation of 1000 rad/s is beyond any robot, so a
filter gives x and y no weight, and the matrix can still be inverted in double precision beside a variance of 1e-8 about z.

"""

SENSOR_QUALITY = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
"""
Best effort, as sensors are; 5000 deep, so that a subscriber whose callbacks are busy for five seconds loses nothing at 1 kHz.

A whole process that the machine does not let run for a second may lose more: Fast DDS 2.14 drops what 512 messages do not hold.

"""

ENDING = 10.0
"""A node that has not ended after so long is killed, s."""

LATCHED_QUALITY = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last state, also for those who come later."""


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of a node; its type is the type of its default.

    Attributes
    ----------
    name : str
    default : bool, int, float, str or sequence of str
    description : str
        One sentence, without the unit.
    unit : str
        Empty where there is none.
    range : tuple of two numbers, or None
        Lowest and highest value, both allowed.
    dynamic : bool
        Whether it may be set while the node runs.
    choices : tuple of str
        The values that a text may have; empty for any.

    """

    name: str
    default: bool | int | float | str | Sequence[str]
    description: str
    unit: str = ''
    range: tuple[float, float] | None = None
    dynamic: bool = False
    choices: tuple[str, ...] = ()

    def descriptor(self) -> ParameterDescriptor:
        """Return what ``ros2 param describe`` shows."""
        text = f'{self.description} Unit: {self.unit}.' if self.unit else self.description
        descriptor = ParameterDescriptor(description=text, read_only=not self.dynamic, additional_constraints=_one_of(self.choices))
        if self.range and isinstance(self.default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(self.range[0]), to_value=float(self.range[1]))]
        elif self.range:
            descriptor.integer_range = [IntegerRange(from_value=int(self.range[0]), to_value=int(self.range[1]))]
        return descriptor

    def check(self, value: object) -> object:
        """
        Return the value as the type of the default; a whole number may stand for a float, as in ``-p rate:=100``.

        Raises
        ------
        ValueError : the value has another type, is not finite or is out of range

        """
        if isinstance(self.default, float) and type(value) is int and abs(value) < 1 << 63:
            value = float(value)
        wanted: type = list if isinstance(self.default, Sequence) and not isinstance(self.default, str) else type(self.default)
        if type(value) is not wanted or (isinstance(value, list) and not all(isinstance(item, str) for item in value)):
            words = _one_of(self.choices) or f'{_WORDS[wanted]}, for example {self.default!r}'
            raise ValueError(f'parameter {self.name} is {reprlib.repr(value)}, but must be {words}')
        if any('\0' in text for text in ([value] if isinstance(value, str) else value if isinstance(value, list) else ())):
            raise ValueError(f'parameter {self.name} is {reprlib.repr(value)}, but must be without a zero byte, as all names are')
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f'parameter {self.name} is {value!r}, but must be finite, for example {self.default!r}')
        if self.range and isinstance(value, (int, float)) and not self.range[0] <= value <= self.range[1]:
            low, high = self.range
            raise ValueError(f'parameter {self.name} is {reprlib.repr(value)}, but must be from {low} to {high} {self.unit}'.rstrip())
        if self.choices and value not in self.choices:
            raise ValueError(f'parameter {self.name} is {reprlib.repr(value)}, but must be {_one_of(self.choices)}')
        return value


def _one_of(choices: Sequence[str]) -> str:
    return f'{", ".join(choices[:-1])} or {choices[-1]}' if choices else ''


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_WORDS: dict[type, str] = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'text', list: 'a list of texts'}


def declare(node: Node, table: Sequence[Parameter]) -> SimpleNamespace:
    """
    Declare the parameters of a table and return their values by name.

    Raises
    ------
    ValueError : an override has the wrong type or is out of range; the message is one sentence

    """
    values = SimpleNamespace(**{parameter.name: _declare(node, parameter) for parameter in table})
    node.add_on_set_parameters_callback(lambda given: _checked({parameter.name: parameter for parameter in table}, given))
    return values


def _checked(table: Mapping[str, Parameter], given: Sequence[rclpy.Parameter]) -> SetParametersResult:
    """Refuse values that are not possible; they are taken on after they are set, see `current`."""
    try:
        for each in given:
            if each.name in table:
                table[each.name].check(each.value)
    except ValueError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _declare(node: Node, parameter: Parameter) -> object:
    # Declared first with any type, since rclpy itself refuses 100 for 100.0, and with a message in several sentences.
    default = parameter.default if isinstance(parameter.default, (bool, int, float, str)) else list(parameter.default)
    given = node.declare_parameter(parameter.name, default, ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(parameter.name)
    value = parameter.check(given)
    node.declare_parameter(parameter.name, value, parameter.descriptor(), ignore_override=True)
    return value


def current(node: Node, table: Sequence[Parameter]) -> SimpleNamespace:
    """Return the values that the declared parameters of a table have now: dynamic ones may have been set since."""
    return SimpleNamespace(**{parameter.name: node.get_parameter(parameter.name).value for parameter in table})


def call_every(node: Node, period: float, callback: Callable[[], None]) -> None:
    """
    Call again and again while the node spins, each time after a period, s, of the steady clock.

    By the clock of the node, as rclpy's timers go by themselves, all would rest for an hour when somebody sets the clock back by one,
    and for ever where a simulation does not go on.

    """
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def run(node_class: Callable[[], Node]) -> int:
    """
    Start a node, spin it until SIGINT or SIGTERM, and return the exit code of the process.

    Returns
    -------
    int
        0 after a signal; 2 when an argument or a parameter was refused, with one sentence on standard error.

    """
    stop = _stop_on_signals()
    try:
        node = _start(node_class)
        if node is None:
            return 2
        spin(node, stop)
        return 0
    finally:
        rclpy.try_shutdown()
        # Ctrl-C under a launch file comes twice, and the second would kill the interpreter while it ends.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _start(node_class: Callable[[], Node]) -> Node | None:
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        return node_class()
    # rclpy says with a RuntimeError that an argument cannot be parsed, and with a ParameterException that one of its own is none
    except (ValueError, OSError, RuntimeError, ParameterException) as error:
        print(f'{node_class.__name__}: {error}', file=sys.stderr)
        return None


def _stop_on_signals() -> threading.Event:
    """
    Return an event that SIGINT and SIGTERM set.

    rclpy's own handlers invalidate the context while a callback still publishes, which ends some runs in a traceback.

    """
    stop = threading.Event()
    for number in _SIGNALS:
        signal.signal(number, lambda *_: stop.set())
    return stop


def spin(node: Node, stop: threading.Event) -> None:
    """Serve the callbacks of a node until an event is set, then close it."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.1)
    except ExternalShutdownException:
        pass  # somebody else shut rclpy down: the same end
    finally:
        executor.shutdown()
        # Fast DDS 2.14 waits for ever where it hears of another node's end at the moment of its own, as after Ctrl-C, with the GIL held.
        faulthandler.dump_traceback_later(ENDING, exit=True)
        node.destroy_node()
        faulthandler.cancel_dump_traceback_later()
