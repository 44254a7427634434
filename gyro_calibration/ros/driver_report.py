"""What the driver says of its gyro in the diagnostics."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

from diagnostic_msgs.msg import DiagnosticStatus

from gyro_calibration.driver.connection import Connection, Counts
from gyro_calibration.driver.protocols import Protocol, Sample, Settings
from gyro_calibration.driver.timestamps import SampleClock
from gyro_calibration.ros.diagnostics import Report

_LEAST_TIME = 0.5  # s; over less a rate says nothing


class DriverReport:
    """
    Judges how a connection does, once a second.

    Parameters
    ----------
    connection : Connection
    port : str
        As it was given.
    settings : Settings

    """

    def __init__(self, connection: Connection, port: str, settings: Settings):
        self._connection, self._port, self._settings = connection, port, settings
        self._last, self._last_time = Counts(), time.monotonic()
        self._rate = 0.0
        self._grown: dict[str, int] = {}
        self._temperature: float | None = None
        self._health: dict[str, float] = {}

    def see(self, samples: Iterable[Sample]) -> None:
        """Keep what the gyro says of itself; may be called from another thread."""
        for sample in samples:
            if sample.health:
                self._health = {**self._health, **sample.health}
            if sample.temperature is not None:
                self._temperature = sample.temperature

    def forget(self) -> None:
        """Forget what the gyro said of itself, when it says no more; may be called from another thread."""
        self._temperature, self._health = None, {}

    def make(self) -> Report:
        """Return level, message and values."""
        counts = self._count()
        return *self._judge(), {
            **self._of_the_port(),
            'rate in Hz': f'{self._rate:.1f}',
            **{name.replace('_', ' '): count for name, count in vars(counts).items()},
            **self._of_the_clock(),
            **self._of_the_gyro(),
        }

    def _count(self) -> Counts:
        """Return the counts, and keep by how much they have grown in the last second."""
        counts, now = self._connection.counts(), time.monotonic()
        elapsed = now - self._last_time
        if elapsed >= _LEAST_TIME:
            self._grown = {name: count - getattr(self._last, name) for name, count in vars(counts).items()}
            self._rate = self._grown.pop('samples') / elapsed
            self._last, self._last_time = counts, now
        return counts

    def _judge(self) -> tuple[bytes, str]:
        state = self._connection.state
        if state.name == 'failed':
            return DiagnosticStatus.ERROR, state.problem
        if state.name != 'reading':
            return DiagnosticStatus.WARN, {'opening': 'opening the port', 'listening': 'listening for a protocol'}[state.name]
        protocol, clock = self._connection.protocol, self._connection.clock
        known = () if protocol is None or clock is None else (*self._ill_health(protocol), *self._wrong_rate(protocol, clock))
        warnings = [*self._losses(), *known]
        return (DiagnosticStatus.WARN, f'samples come, but {"; ".join(warnings)}') if warnings else (DiagnosticStatus.OK, 'samples come')

    def _losses(self) -> list[str]:
        worst = ', '.join(f'{name.replace("_", " ")} {count}' for name, count in self._grown.items() if count > 0)
        return [f'in the last second there were: {worst}'] if worst else []

    def _ill_health(self, protocol: Protocol) -> Iterator[str]:
        for name, (low, high) in protocol.good.items():
            value = self._health.get(name)
            if value is not None and not low <= value <= high:
                yield f'{name} is {value:.4g}, but should be from {low:g} to {high:g}: check the supply, then have the gyro checked'

    def _wrong_rate(self, protocol: Protocol, clock: SampleClock) -> Iterator[str]:
        """Yield a warning where rates are wrong by the factor of the interval, since the gyro sends angles."""
        warning = protocol.wrong_rate(self._settings, clock.period) if clock.is_settled else ''
        if warning:
            yield warning

    def _of_the_port(self) -> dict[str, object]:
        connection = self._connection
        return {
            'port': self._port,
            'device': connection.path,
            'state': connection.state.name,
            'protocol': connection.protocol.name if connection.protocol else '',
            'baud': connection.baud,
            'heard': connection.heard,
            'reopened': max(0, connection.openings - 1),
            'waiting in s': f'{connection.state.waiting:.1f}',
            'waited in s': f'{connection.waited:.1f}',
            'last error': connection.last_error,
        }

    def _of_the_clock(self) -> dict[str, str]:
        clock, protocol = self._connection.clock, self._connection.protocol
        if clock is None or protocol is None:
            return {}
        return {
            'period in ms': f'{1e3 * clock.period:.6g}',
            'nominal period in ms': f'{1e3 / protocol.nominal_rate(self._settings):.6g}',
            'jitter before in ms': f'{1e3 * clock.jitter_before:.3g}',
            'jitter after in ms': f'{1e3 * clock.jitter_after:.3g}',
        }

    def _of_the_gyro(self) -> dict[str, str]:
        last = self._temperature  # which the other thread may forget meanwhile
        temperature = {} if last is None else {'temperature_degc': f'{last:.2f}'}
        return temperature | {name: f'{value:.4g}' for name, value in self._health.items()}
