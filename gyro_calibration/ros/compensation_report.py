"""What the compensation node says of itself: diagnostics once a second, and the state of its calibration."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus

from gyro_calibration.heading_estimator import HeadingEstimator
from gyro_calibration.log import DEGREE
from gyro_calibration.ros.calibration_run import Run
from gyro_calibration.ros.health_monitor import Check
from gyro_calibration.ros.state_store import Memory
from gyro_calibration.ros.wheels import Wheels

COUNTED = ('samples', 'not_finite', 'lost_samples', 'stamps_ignored', 'restarts', 'temperature_clipped', 'beyond_range')
#: So many in a second are no bad news.
_TOLERATED = {'lost_samples': 3}
#: Reasons of refused calibrations that are remembered.
_REMEMBERED = 3


@dataclass
class Journal:
    """
    What happened so far.

    Attributes
    ----------
    counts : of samples, and of what was wrong with some
    event : the last, in words
    refused : how many calibrations were, and the last reasons
    brought : channels that the samples bring beside the rate
    clock_set : how often the clock of this computer was set, in words; ''
    heard : when the last sample came, by the node's clock, s

    """

    heard: float
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))
    event: str = ''
    clock_set: str = ''
    refused: int = 0
    reasons: deque[str] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    brought: set[str] = field(default_factory=set)
    _before: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))
    _asked: float = math.nan

    def refuse(self, reason: str) -> None:
        """Count a refused calibration."""
        self.refused += 1
        self.reasons.append(reason)

    def growing(self) -> set[str]:
        """Return the counts that grew since `grown` was asked."""
        return {name for name, count in self.counts.items() if count - self._before[name] > _TOLERATED.get(name, 0)}

    def grown(self, now: float) -> tuple[set[str], float]:
        """Return the counts that grew since the last time this was asked, and the samples in a second since then."""
        grown = self.growing()
        rate = (self.counts['samples'] - self._before['samples']) / (now - self._asked) if now > self._asked else math.nan
        self._before, self._asked = dict(self.counts), now
        return grown, rate


@dataclass(frozen=True)
class Rooms:
    """What is reported on."""

    live: HeadingEstimator
    memory: Memory
    check: Check
    wheels: Wheels
    journal: Journal


def trouble(rooms: Rooms, grown: set[str], now: float) -> tuple[bytes, str]:
    """Return level and message of the diagnostics; a count is bad news only while it grows."""
    live, memory, silent = rooms.live, rooms.memory, now - rooms.journal.heard
    if memory.problem:
        return DiagnosticStatus.ERROR, memory.problem
    if 'samples' not in grown and silent > 1.0:
        return DiagnosticStatus.ERROR, f'no samples on imu/data_raw for {silent:.0f} s: is the driver running?'
    found = [text for name, text in _counted(rooms).items() if name in grown]
    found += _of_temperature(live)
    found += [f'the model looks at the {channel.replace("_", " ")}, which no message brings; that effect is left out'
              for channel in live.missing(rooms.journal.brought)]
    found += [text for text in (memory.hint, memory.shared_hint, rooms.check.bias_alarm, rooms.check.noise_alarm, live.sentence,
                              memory.table_hint) if text]
    if found:
        return DiagnosticStatus.WARN, found[0]
    return DiagnosticStatus.OK, 'heading goes on' if live.tracker.slowest_noticed > 0.0 else f'heading goes on; {_UNTRACKED}'


_UNTRACKED = 'the bias is not tracked at rest'


def _counted(rooms: Rooms) -> dict[str, str]:
    low, high = rooms.live.model.temperature_range
    event = rooms.journal.event
    return {'restarts': event, 'stamps_ignored': event, 'not_finite': 'rates that are not finite came and were not used',
            'lost_samples': 'samples are lost: look at the cable, the baud rate and the load of the computer; the heading goes on over the '
                            'gaps, and its variance allows for them',
            'beyond_range': 'the rate is beyond the calibrated range; the correction is extrapolated',
            'temperature_clipped': f'the temperature is outside the calibrated {low:g} to {high:g} degC; its nearest end is used'}


def _of_temperature(live: HeadingEstimator) -> list[str]:
    if live.temperature is None:
        reference = live.model.reference_temperature
        return [f'no temperature comes; the model is used at its reference temperature of {reference:g} degC'
                ] if live.model.looks_at('temperature') else []
    return [f'no temperature comes any more; the last one, {live.temperature:.1f} degC, is held, and the bias becomes less and less known'
            ] if live.temperature_is_lost else []


def values(rooms: Rooms, rate: float, standing: str, now: float, date: float) -> dict[str, object]:
    """Return all that is known, by name; `rate` of the samples in Hz, `standing` as the parameter has it, `date` in s since 1970."""
    live, journal = rooms.live, rooms.journal
    calibration = live.model.self_calibration
    return {
        **journal.counts, 'longest_gap_s': f'{live.tracker.intervals.longest:.3f}', 'clock_set': journal.clock_set,
        'input_rate_hz': f'{rate:.1f}', **_of_heading(live), **_of_rest(live, standing, rooms.wheels, now),
        **(calibration.figures() if calibration else {}),
        'calibration_age_h': f'{live.age(date) / 3600.0:.2f}' if calibration else '', 'calibration_now': live.sentence,
        **_temperatures(live), 'refused_calibrations': journal.refused, 'refusals': ' | '.join(journal.reasons),
        'bias_table_entries': len(live.table.entries), 'bias_table_held_back': live.table.held_back,
        'bias_table_written_min': '' if rooms.memory.written is None else f'{(date - rooms.memory.written) / 60.0:.1f}',
        'bias_table': rooms.memory.table_hint, 'last_event': journal.event, **_checked(rooms.check)}


def _of_heading(live: HeadingEstimator) -> dict[str, object]:
    tracker, known = live.tracker, live.model.noise.angle_random_walk > 0.0
    deviation = math.sqrt(tracker.variance) / DEGREE if known else math.nan
    return {'heading_deg': f'{tracker.heading / DEGREE:.3f}', 'heading_standard_deviation_deg': f'{deviation:.3f}',
            'deleted_heading_deg': f'{tracker.deleted / DEGREE:.3f}'}


def _of_rest(live: HeadingEstimator, standing: str, wheels: Wheels, now: float) -> dict[str, object]:
    tracker, moving = live.tracker, wheels.moving(now)
    bias, deviation = tracker.bias
    slowest = tracker.slowest_noticed / DEGREE
    age = wheels.age(now)
    return {'standing': _standing(live, standing), 'resting': tracker.resting, 'bias_learned_deg_s': f'{bias / DEGREE:.5f}',
            'bias_standard_deviation_deg_s': f'{deviation / DEGREE:.5f}', 'slowest_noticed_turn_deg_s': f'{slowest:.4f}',
            'slow_turns': '' if moving is not None or math.isnan(slowest) else
            'without wheels or commands, slower turns cannot be told from drift',
            'wheels': {True: 'moving', False: 'standing', None: 'unknown'}[moving],
            'wheels_age_s': f'{age:.2f}' if math.isfinite(age) else ''}


def _standing(live: HeadingEstimator, standing: str) -> str:
    if standing == 'rest' and not live.model.noise.angle_random_walk:
        return 'threshold, as the model has no angle random walk: measure it (allan), and rests are found and used'
    return standing


def _temperatures(live: HeadingEstimator) -> dict[str, object]:
    low, high = live.model.temperature_range
    return {'temperature_degc': '' if live.temperature is None else f'{live.temperature:.2f}',
            'temperature_range_degc': f'{low:g} to {high:g}' if live.model.looks_at('temperature') else ''}


def _checked(check: Check) -> dict[str, object]:
    """Return what the last rest showed."""
    rest = check.last
    if rest is None:
        return {'rests_checked': 0}
    return {'rests_checked': check.examined, 'rest_noise_ratio': f'{rest.noise_ratio:.3f}',
            'rest_rate_deg_s': f'{rest.bias / DEGREE:.5f}', 'rest_rate_sigmas': f'{rest.sigmas:.2f}',
            'noise_alarm': check.noise_alarm, 'bias_alarm': check.bias_alarm}


def state(memory: Memory, run: Run | None) -> tuple[bytes, str, Mapping[str, object]]:
    """Return level, message and values of the latched state of the calibration."""
    calibration = memory.model.self_calibration
    shown: dict[str, object] = {'calibrated': calibration is not None, 'running': run is not None}
    if run:
        shown['progress'] = f'{run.progress:.2f}'
    if calibration:
        shown.update(calibration.figures())
    return *_state(memory, run), shown


def _state(memory: Memory, run: Run | None) -> tuple[bytes, str]:
    if run:
        return DiagnosticStatus.OK, f'calibrating: {run.says()}; the old calibration is in use'
    if memory.problem or memory.hint:
        return DiagnosticStatus.ERROR if memory.problem else DiagnosticStatus.WARN, memory.problem or memory.hint
    if not memory.model.self_calibration:
        return DiagnosticStatus.WARN, 'no self-calibration yet; call calibrate'
    return DiagnosticStatus.OK, str(memory.model.self_calibration)
