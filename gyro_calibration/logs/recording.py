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
Conversion of a ROS 2 recording to a `Log` at the stamps of the gyro.

The gyro is an Imu; temperature and reference are interpolated at its stamps. Other message types
with a rate, an orientation or a temperature are used where their topic is named. Times are the
stamps of the headers; times of receipt are used only where headers have no stamps. Notes list this
and all other corrections.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import os.path
from pathlib import Path
from typing import Any

from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import MessageError, NSEC_PER_SEC
from gyro_calibration.logs.log import Array, Log, LogError, Mask, mask_invalid, unwrap_heading
from gyro_calibration.logs.ros_bag import Contents, Message, OnProgress, read_messages
import numpy as np
from numpy.typing import NDArray

_Nanoseconds = NDArray[np.int64]

_REFERENCE_TYPES = (cdr.ODOMETRY, cdr.IMU, cdr.POSE, cdr.TWIST)
#: Role of a topic -> the option that names it, its possible message types, and the quantities of
#: which a message of another type must have one.
_ROLES = {
    'gyro': ('--topic', (cdr.IMU,), {'rate'}),
    'temperature': ('--temperature-topic', (cdr.TEMPERATURE,), {'temperature'}),
    'reference': ('--reference-topic', _REFERENCE_TYPES, {'rate', 'orientation.w'}),
}

#: Largest step back of stamps by messages out of order, s; at a larger one a clock was set.
_MAX_STEP_BACK = 1.0
_MAX_LISTED_TOPICS = 20  # in a message, which hundreds of topics would make unreadable
#: Time without a temperature beyond which a note is made, s; gyros take minutes to warm up.
_MAX_TEMPERATURE_GAP = 30.0


@dataclass(frozen=True)
class Topics:
    """Topics of a recording, None for the only one and no reference; axis x, y, z of the gyro."""

    gyro: str | None = None
    reference: str | None = None
    temperature: str | None = None
    axis: str = 'z'


def topic_type_fault(role: str, topic: str, kind: str) -> str:
    """Return why the message type of a topic does not fit its role; '' if it does."""
    option, kinds, _ = _ROLES[role]
    return '' if kind in kinds else f'{topic} is {kind}; {option} wants {_join_names(kinds, "or")}'


def _is_same_topic(topic: str, other: str | None) -> bool:
    return topic.strip('/') == (other or '').strip('/')


class _TopicBuffer:
    """Messages of one topic: stamps and times of receipt, ns, and the numbers of quantities."""

    def __init__(self, topic: str, kind: str, definition: str, axis: str):
        self.topic, self.kind, self.damaged_count = topic, kind, 0
        self.frames = set[str]()  # the first two in the headers
        self._layout = cdr.parse_layout(definition, axis)
        self._stamps, self._received, self._numbers = array('q'), array('q'), array('d')

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, message: Message) -> None:
        try:
            stamp, numbers = cdr.parse(message.data, self._layout)
            self._received.append(message.received)
        except (MessageError, OverflowError):
            self.damaged_count += 1
            return
        if len(self.frames) < 2:
            self.frames.add(cdr.parse_frame(message.data))
        self._stamps.append(stamp)
        self._numbers.extend([numbers[place] for place in self._layout.quantities.values()])

    def sort_by_arrival(self) -> _TopicSeries:
        received = np.frombuffer(self._received, np.int64)
        numbers = np.frombuffer(self._numbers).reshape(len(self), -1)
        series = _TopicSeries(self.topic, self.kind, np.frombuffer(self._stamps, np.int64),
                              received, numbers, tuple(self._layout.quantities))
        # no copy where they are in order already
        return (series if (received[1:] >= received[:-1]).all()
                else series.select(np.argsort(received, kind='stable')))


@dataclass(frozen=True)
class _TopicSeries:
    """Stamps and times of receipt of a topic, ns, shape (n,), and numbers, shape (n, m)."""

    topic: str
    kind: str
    stamps: _Nanoseconds
    received: _Nanoseconds
    numbers: Array
    quantities: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.stamps)

    def values(self, quantity: str) -> Array:
        """Return the values of a quantity, shape (n,); zeros where there is none."""
        if quantity not in self.quantities:
            return np.zeros(len(self))
        return self.numbers[:, self.quantities.index(quantity)]

    def is_reported(self, quantity: str) -> bool:
        """Return whether the messages have a quantity and do not declare it unknown."""
        return quantity in self.quantities and not (
            self.values(f'{quantity} variance') == cdr.NOT_REPORTED).all()

    @property
    def has_stamps(self) -> bool:
        """Return whether the headers have stamps; else they are zero or all the same."""
        return bool(self.stamps.any()) and (len(self) < 2 or int(np.ptp(self.stamps)) > 0)

    def select(self, which: Mask | NDArray[np.intp]) -> _TopicSeries:
        return replace(self, stamps=self.stamps[which], received=self.received[which],
                       numbers=self.numbers[which])

    def with_unique_stamps(self) -> _TopicSeries:
        """Return the series sorted by stamps, without duplicates."""
        return self.select(np.unique(self.stamps, return_index=True)[1])

    def with_times(self, use_stamps: bool) -> _TopicSeries:
        """Return the series with stamps, or times of receipt, as its stamps."""
        if not use_stamps:
            return replace(self, stamps=self.received)
        return self if self.stamps.all() else self.select(self.stamps != 0)


def read_recording(path: str | Path, topics: Topics = Topics(), rate: float | None = None,
                   on_progress: OnProgress = lambda place: None,
                   on_note: Callable[[str], object] = lambda note: None) -> Log:
    """
    Read a ROS 2 recording: a folder, or a file .mcap or .db3.

    A sample rate, Hz, replaces the stamps. `on_progress` takes the number of bytes read, `on_note`
    each note on selections and corrections. Raise `LogError` for a recording that cannot be read,
    or has no gyro or several; it names the topics.
    """
    contents, series = Contents(), dict[str, _TopicBuffer]()
    for message in read_messages(path, contents, on_progress):
        if message.topic not in series:
            axis = 'z' if _is_same_topic(message.topic, topics.reference) else topics.axis
            series[message.topic] = _TopicBuffer(
                message.topic, message.kind, contents.definitions[message.kind], axis)
        series[message.topic].add(message)
    try:
        log = _LogBuilder(Path(path).name, topics, contents, series).build(rate)
    except LogError as error:
        raise LogError(f'{path}: {error}') from None
    for note in log.notes:
        on_note(note)
    return replace(log, notes=(*log.notes, *contents.recorder_notes))


class _LogBuilder:
    """Makes a log of the messages of a recording, with notes on selections and corrections."""

    def __init__(self, name: str, topics: Topics, contents: Contents,
                 series: dict[str, _TopicBuffer]):
        self._topics, self._contents, self._series = topics, contents, series
        self._notes = [f'ROS 2 recording {name}']

    def build(self, rate: float | None) -> Log:
        found = [topic for topic in self._topics_of_type({cdr.IMU})
                 if not _is_same_topic(topic, self._topics.reference)]
        if self._topics.gyro:
            found = [self._find_topic(self._topics.gyro, 'gyro')]
        elif len(found) > 1:
            raise LogError(f'several gyros, {_join_names(found)}; select one with --topic')
        elif not found:
            reasons = ''.join(f' ({note})' for note in self._contents.notes)
            others = self._topics_of_type({
                kind for kind, definition in self._contents.definitions.items()
                if kind not in _REFERENCE_TYPES
                and 'rate' in cdr.parse_layout(definition).quantities})
            remedy = (f'select {_join_names(others, "or")} with --topic' if others
                      else 'record the topic of the gyro')
            raise LogError(f'no message of {cdr.IMU} in it{reasons}{self._list_topics()}; '
                           f'{remedy}')
        gyro = self._topic_series(found[0])
        if not gyro.is_reported('rate'):
            raise LogError(f'{gyro.topic} declares that it reports no angular velocity; name '
                           'another by --topic')
        thermometer = None
        if self._topics.temperature is not None:
            thermometer = self._find_topic(self._topics.temperature, 'temperature')
        elif found := self._topics_of_type({cdr.TEMPERATURE}):
            if len(found) > 1:
                self._notes.append(f'of the temperatures {_join_names(found)}, the one whose name '
                                   'is nearest to the topic of the gyro is used')
            thermometer = max(found, key=lambda topic: len(os.path.commonprefix(
                [topic.strip('/'), gyro.topic.strip('/')])))
        temperature = self._topic_series(thermometer) if thermometer else None
        reference = None
        if self._topics.reference is not None:
            reference = self._topic_series(self._find_topic(self._topics.reference, 'reference'))
        elif possible := self._topics_of_type(set(_REFERENCE_TYPES) - {cdr.IMU}):
            self._notes.append('no reference was asked for; --reference-topic may be '
                               f'{_join_names(possible)}')
        use_stamps = all(course.has_stamps for course in (gyro, reference) if course is not None)
        if not use_stamps:
            self._notes.append('headers have no stamps: times are those at which messages were '
                               'received')
        gyro = self._order_samples(gyro.with_times(use_stamps), rate)
        time = (gyro.stamps - gyro.stamps[0]) / NSEC_PER_SEC
        self._notes.append(f'gyro: {gyro.topic} ({gyro.kind}), {len(gyro)} samples, '
                           f'time_s from {_format_seconds(gyro.stamps[0])} s on')
        output = gyro.values('rate').copy()
        lost = mask_invalid(output, 'output') | np.isnan(output)
        if lost.any():
            self._notes.append(f'{np.count_nonzero(lost)} samples are no finite number and count '
                               'as lost')
            output[lost] = np.nan
        arrays: dict[str, Any] = {'output': output}
        force = gyro.values('force')
        if force.any() and not (gyro.values('force variance') == cdr.NOT_REPORTED).any():
            if mask_invalid(force, 'specific_force').any():
                self._notes.append('the specific force is not finite everywhere and was left out')
            else:
                arrays['specific_force'] = force.copy()
        if temperature is not None:
            times = temperature.with_times(use_stamps and temperature.has_stamps)
            arrays['temperature'] = self._interpolate_temperature(times, gyro.stamps[0], time)
        if reference is not None:
            arrays |= self._interpolate_reference(reference.with_times(use_stamps), gyro, time,
                                                  output)
        return Log(time=time if rate is None else np.arange(len(gyro)) / rate, **arrays,
                   notes=(*self._notes, *self._contents.notes))

    def _find_topic(self, wanted: str, role: str) -> str:
        topic = next((topic for topic in self._contents.topics if _is_same_topic(topic, wanted)),
                     None)
        if topic is None:
            raise LogError(f'no topic {wanted}{self._list_topics()}; name one of them by '
                           f'{_ROLES[role][0]}')
        kind = self._contents.topics[topic]
        definition = self._contents.definitions.get(kind)
        found = cdr.parse_layout(definition).quantities if definition else {}
        if not _ROLES[role][2] & set(found) and (wrong := topic_type_fault(role, topic, kind)):
            raise LogError(wrong)
        if topic not in self._series or not len(self._series[topic]):
            raise LogError(f'{topic} has no message that can be read; record again')
        return topic

    def _topics_of_type(self, kinds: set[str]) -> list[str]:
        return sorted(topic for topic, series in self._series.items()
                      if series.kind in kinds and len(series))

    def _list_topics(self) -> str:
        topics = [f'{topic} ({kind})' for topic, kind in sorted(self._contents.topics.items())]
        return f'; there are {_join_names(topics)}' if topics else ', which holds no topic at all'

    def _topic_series(self, topic: str) -> _TopicSeries:
        series = self._series[topic]
        if series.damaged_count:
            self._notes.append(f'{series.damaged_count} messages of {topic} could not be read and '
                               'were left out')
        if len(series.frames) > 1:
            raise LogError(f'messages of the frames {_join_names(sorted(series.frames))} are on '
                           f'{topic}, as of several sensors: record each on a topic of its own, '
                           'or split the recording where the frame changes')
        return series.sort_by_arrival()

    def _order_samples(self, gyro: _TopicSeries, rate: float | None) -> _TopicSeries:
        """Sort samples by their stamps, leave out duplicates, and refuse unusable times."""
        latest = np.maximum.accumulate(gyro.stamps)
        back = latest - gyro.stamps
        if rate is not None:
            gyro = replace(gyro, stamps=latest)
        elif back.any():
            if back.max() > _MAX_STEP_BACK * NSEC_PER_SEC:
                place = int(np.argmax(back > _MAX_STEP_BACK * NSEC_PER_SEC))
                raise LogError(f'the stamps of {gyro.topic} step back by '
                               f'{_format_seconds(back[place])} s at sample {place + 1}, as after '
                               'setting a clock; split the recording there, or give the sample '
                               'rate with --rate')
            self._notes.append(f'{np.count_nonzero(back)} samples came out of order and were '
                               'sorted')
            gyro = gyro.select(np.argsort(gyro.stamps, kind='stable'))
        doubled = np.diff(gyro.stamps, prepend=gyro.stamps[:1] - 1) == 0
        if rate is None and doubled.any():
            differs = np.diff(gyro.values('rate'), prepend=np.nan) != 0.0
            other = int(np.count_nonzero(doubled & differs))
            if other > 1 + 0.01 * len(gyro):
                raise LogError(f'{other} of {len(gyro)} samples of {gyro.topic} have the stamp of '
                               'another sample, so their times are unknown; give the sample rate '
                               'with --rate')
            self._notes.append(f'{np.count_nonzero(doubled)} samples with the stamp of another '
                               'one were left out')
            gyro = gyro.select(~doubled)
        if len(gyro) < 2:
            raise LogError(f'{gyro.topic} has {len(gyro)} samples with a time; a log has at '
                           'least two: record more')
        return gyro

    def _interpolate_temperature(self, series: _TopicSeries, begin: np.int64,
                                 time: Array) -> Array | None:
        """Return the temperature between readings; before and after them it is constant."""
        valid = ~mask_invalid(series.values('temperature'), 'temperature')
        series = series.select(valid).with_unique_stamps()
        at = (series.stamps - begin) / NSEC_PER_SEC
        if (not len(at) or at[0] > time[-1] + _MAX_TEMPERATURE_GAP
                or at[-1] < -_MAX_TEMPERATURE_GAP):
            self._notes.append(f'temperature: {series.topic} has none at the times of the gyro, '
                               'and was left out')
            return None
        self._notes.append(f'temperature: {series.topic} ({series.kind}), {len(at)} readings')
        inside = at[(at >= 0.0) & (at <= time[-1])]
        longest = float(np.diff(np.concatenate([[0.0], inside, time[-1:]])).max())
        if longest > _MAX_TEMPERATURE_GAP:
            self._notes.append(f'no temperature came for up to {longest:.0f} s; '
                               'it was interpolated, or held at the ends')
        return np.interp(time, at, series.values('temperature'))

    def _interpolate_reference(self, series: _TopicSeries, gyro: _TopicSeries, time: Array,
                               output: Array) -> dict[str, Any]:
        """Return heading and rate of a reference at the samples of the gyro; nan where lost."""
        if series.topic == gyro.topic:
            raise LogError(f'{gyro.topic} cannot be its own reference; name another by '
                           '--reference-topic')
        series = series.with_unique_stamps()
        at = (series.stamps - gyro.stamps[0]) / NSEC_PER_SEC
        rate = series.values('rate') if series.is_reported('rate') else None
        if rate is not None:
            rate = np.where(np.isfinite(rate), rate, np.nan)
        heading = None
        x, y, z, w = (series.values(f'orientation.{each}') for each in 'xyzw')
        variance = series.values('orientation variance')
        # declared unknown by an Imu, or left at its default
        if series.is_reported('orientation.w') and not (
                'orientation variance' in series.quantities and (
                    (variance == cdr.NOT_REPORTED).all()
                    or not (x.any() or y.any() or z.any() or variance.any())
                    and (w == 1.0).all())):
            heading, by_gyro = unwrap_heading(
                at, np.asarray(cdr.quaternion_heading(x, y, z, w)), time, output)
            if by_gyro:
                self._notes.append('the reference turned by more than half a turn between two '
                                   'values; the number of turns was taken from the gyro')
        if (rate is not None and heading is not None and not rate.any()
                and np.nanmax(heading) - np.nanmin(heading) > 0.1):
            self._notes.append('the rates of the reference are all zero, and were left out')
            rate = None
        found: dict[str, Any] = {}
        for name, values in (('reference_heading', heading), ('reference_rate', rate)):
            if values is None or np.isfinite(values).sum() < 2:
                continue
            # nan in gaps longer than 5 median intervals and 0.1 s
            known, values = at[np.isfinite(values)], values[np.isfinite(values)]
            longest = max(5.0 * float(np.median(np.diff(known))), 0.1)
            place = np.clip(np.searchsorted(known, time, 'right') - 1, 0, len(known) - 2)
            inside = (time >= known[0]) & (time <= known[-1])
            close = ((known[place + 1] - known[place] <= longest) | (time == known[place])
                     | (time == known[place + 1]))
            found[name] = np.where(inside & close, np.interp(time, known, values), np.nan)
        if not any(np.isfinite(values).any() for values in found.values()):
            raise LogError(f'{series.topic} has no heading and no rate at the times of the gyro; '
                           'name another reference, or check that both clocks agree')
        lost = np.isnan(next(iter(found.values()))).mean()
        self._notes.append(f'reference: {series.topic} ({series.kind}), {len(at)} values, '
                           f'lost for {100 * lost:.1f} % of the samples')
        return found


def _format_seconds(nanoseconds: np.int64) -> str:
    return f'{int(nanoseconds) // NSEC_PER_SEC}.{int(nanoseconds) % NSEC_PER_SEC:09d}'


def _join_names(names: Sequence[str], word: str = 'and') -> str:
    if len(names) > _MAX_LISTED_TOPICS:
        names = [*names[:_MAX_LISTED_TOPICS], f'{len(names) - _MAX_LISTED_TOPICS} more']
    return names[0] if len(names) == 1 else f'{", ".join(names[:-1])} {word} {names[-1]}'
