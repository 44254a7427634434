# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The diagnostics of the driver."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from gyro_calibration.driver.connection import Connection, ConnectionCounts
from gyro_calibration.driver.protocols import Sample, Settings
from gyro_calibration.ros.diagnostics import ERROR, OK, Report, WARN

_MIN_RATE_DURATION = 0.5  # s; shortest time over which a sample rate is computed
_STATE_MESSAGES = {'opening': 'opening the port', 'listening': 'listening for a protocol'}


class DriverReport:
    """
    Makes reports of a connection, once per second.

    Parameters
    ----------
    connection, settings : of the driver
    port : parameter of the node
    clock : returns seconds of the steady clock

    Attributes
    ----------
    event : the last event, in a sentence

    """

    def __init__(self, connection: Connection, port: str, settings: Settings,
                 clock: Callable[[], float]):
        self._connection, self._port, self._settings = connection, port, settings
        self._clock, self._last_counts, self._last_time = clock, ConnectionCounts(), clock()
        self._rate, self._step_count = 0.0, 0
        self._new_counts: dict[str, int] = {}
        self._clock_steps, self.event = '0', ''
        self._temperature: float | None = None
        self._health: dict[str, float] = {}

    def add(self, samples: Iterable[Sample]) -> None:
        """Store temperature and health of the gyro; may be called from another thread."""
        for sample in samples:
            if sample.health:
                self._health = {**self._health, **sample.health}
            if sample.temperature is not None:
                self._temperature = sample.temperature

    def add_clock_step(self, step: float) -> None:
        """Count a step of the clock of the stamps, s."""
        self._step_count += 1
        self._clock_steps = f'{self._step_count}, last by {step:+.1f} s'
        self.event = f'the clock of this computer was set by {step:+.1f} s; the stamps follow it'

    def clear(self) -> None:
        """Clear temperature and health while the gyro is silent; from any thread."""
        self._temperature, self._health = None, {}

    def make(self) -> Report:
        """Return level, message and values."""
        counts, now, connection = self._connection.counts(), self._clock(), self._connection
        elapsed = now - self._last_time
        if elapsed >= _MIN_RATE_DURATION:
            self._new_counts = {name: count - getattr(self._last_counts, name)
                                for name, count in vars(counts).items()}
            self._rate = self._new_counts.pop('samples') / elapsed
            self._last_counts, self._last_time = counts, now
        # The other thread may clear these meanwhile.
        last, clock, protocol = self._temperature, connection.clock, connection.protocol
        return *self._evaluate(), {
            'port': self._port,
            'device': connection.path,
            'state': connection.state.name,
            'protocol': protocol.name if protocol else '',
            'baud': connection.baud,
            'detected': connection.detected,
            'reopened': max(0, connection.open_count - 1),
            'waiting_s': f'{connection.state.retry_delay:.1f}',
            'waited_s': f'{connection.waited_duration:.1f}',
            'last_error': connection.last_error,
            **vars(counts),
            'rate_hz': f'{self._rate:.1f}',
            'longest_gap_s': f'{self._connection.longest_gap:.3f}',
            'clock_steps': self._clock_steps,
            **({} if clock is None or protocol is None else {
                'period_ms': f'{1e3 * clock.period:.6g}',
                'nominal_period_ms': f'{1e3 / protocol.nominal_rate(self._settings):.6g}',
                'jitter_before_ms': f'{1e3 * clock.jitter[0]:.3g}',
                'jitter_after_ms': f'{1e3 * clock.jitter[1]:.3g}'}),
            **({} if last is None else {'temperature_degc': f'{last:.2f}'}),
            **{name: f'{value:.4g}' for name, value in self._health.items()},
            'last_event': self.event,
        }

    def _evaluate(self) -> tuple[bytes, str]:
        state = self._connection.state
        if state.name == 'failed':
            return ERROR, state.problem
        if state.name != 'reading':
            return WARN, _STATE_MESSAGES[state.name]
        grown = [f'{name.replace("_", " ")} {count}'
                 for name, count in self._new_counts.items() if count > 0]
        warnings = [f'in the last second there were: {", ".join(grown)}'] if grown else []
        protocol, clock = self._connection.protocol, self._connection.clock
        if protocol is not None and clock is not None:
            for name, (low, high) in protocol.normal_ranges.items():
                value = self._health.get(name)
                if value is not None and not low <= value <= high:
                    warnings.append(f'{name} is {value:.4g}, but should be from {low:g} to '
                                    f'{high:g}: check the supply, then have the gyro checked')
            if (clock.is_settled
                    and (wrong := protocol.sample_rate_warning(self._settings, clock.period))):
                warnings.append(wrong)
        return (WARN, f'samples come, but {"; ".join(warnings)}') if warnings else (
            OK, 'samples come')
