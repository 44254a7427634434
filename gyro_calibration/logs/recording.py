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

Temperature and reference are interpolated at these. Other message types with a rate, an
orientation or a temperature are used where their topic is named. Times are the stamps of the
headers; times of receipt are used only where headers have no stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
import os.path
from pathlib import Path
import struct
from typing import Any

from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import MessageError, NSEC_PER_SEC
from gyro_calibration.logs.log import (
    Array, Log, LogError, mask_invalid, read_log, unwrap_heading)
from gyro_calibration.logs.ros_bag import (
    Contents, is_recording, Message, OnProgress, read_messages)
import numpy as np
from numpy.typing import NDArray

_REFERENCE_TYPES = (cdr.ODOMETRY, cdr.IMU, cdr.POSE, cdr.TWIST)
#: Role of a topic -> the option that names it, its possible message types, and the quantities of
#: which a message of another type must have one.
_ROLES = {
    'gyro': ('--topic', (cdr.IMU,), {'rate'}),
    'temperature': ('--temperature-topic', (cdr.TEMPERATURE,), {'temperature'}),
    'reference': ('--reference-topic', _REFERENCE_TYPES, {'rate', 'orientation.w'}),
}

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


class _Topic:
    """Messages of one topic: `rows` has stamps and times of receipt, ns, and quantities."""

    def __init__(self, name: str, kind: str, definition: str, axis: str):
        self.name, self.kind, self.damaged_count = name, kind, 0
        self.frames = set[str]()  # the first two in the headers
        self._layout = cdr.parse_layout(definition, axis)
        self._struct = struct.Struct(f'=qq{len(self._layout.quantities)}d')
        self._data = bytearray()
        self.rows: Any = None  # in order of receipt, or of stamps

    def __len__(self) -> int:
        return len(self._data) // self._struct.size

    def add(self, message: Message) -> None:
        try:
            stamp, numbers = cdr.parse(message.data, self._layout)
            self._data += self._struct.pack(stamp, message.received, *(
                numbers[place] for place in self._layout.quantities.values()))
        except (MessageError, struct.error):
            self.damaged_count += 1
            return
        if len(self.frames) < 2:
            self.frames.add(cdr.parse_frame(message.data))

    def in_order_of_receipt(self) -> _Topic:
        """Return a copy with its own rows."""
        found = copy(self)
        rows = np.frombuffer(self._data, [('stamp', 'i8'), ('received', 'i8'), *(
            (quantity, 'f8') for quantity in self._layout.quantities)])
        found.rows = rows[np.argsort(rows['received'], kind='stable')]
        return found

    @property
    def stamps(self) -> NDArray[np.int64]:
        return self.rows['stamp']

    def values(self, quantity: str) -> Array:
        """Return the values of a quantity, shape (n,); zeros where there is none."""
        return (self.rows[quantity].copy() if quantity in self._layout.quantities
                else np.zeros(len(self.rows)))

    def is_reported(self, quantity: str) -> bool:
        """Return whether the messages have a quantity and do not declare it unknown."""
        return quantity in self._layout.quantities and not (
            self.values(f'{quantity} variance') == cdr.NOT_REPORTED).all()

    @property
    def has_stamps(self) -> bool:
        """Return whether the headers have stamps; else they are zero or all the same."""
        return bool(self.stamps.any()) and (len(self.stamps) < 2 or int(np.ptp(self.stamps)) > 0)

    def use_times(self, use_stamps: bool) -> None:
        """Leave out rows without a stamp, or use times of receipt as stamps."""
        if use_stamps:
            self.rows = self.rows[self.stamps != 0]
        else:
            self.rows['stamp'] = self.rows['received']

    def sort_by_stamps(self) -> None:
        """Sort the rows by stamps, and leave out duplicates."""
        self.rows = self.rows[np.unique(self.stamps, return_index=True)[1]]


def read_file(path: str | Path, topics: Topics = Topics(), rate: float | None = None,
              sensitivity: float | None = None, columns: Mapping[str, str] = {},
              on_progress: OnProgress = lambda place: None,
              on_note: Callable[[str], object] = lambda note: None) -> Log:
    """Read a recording or a log file, as `read_recording` or `log.read_log`, by its name."""
    return (read_recording(path, topics, rate, on_progress, on_note) if is_recording(path)
            else read_log(path, sensitivity, rate, columns, topics.axis, on_progress))


def read_recording(path: str | Path, topics: Topics = Topics(), rate: float | None = None,
                   on_progress: OnProgress = lambda place: None,
                   on_note: Callable[[str], object] = lambda note: None) -> Log:
    """
    Read a ROS 2 recording: a folder, or a file .mcap or .db3.

    A sample rate, Hz, replaces the stamps. `on_progress` takes the number of bytes read, `on_note`
    each note on selections and corrections. `LogError` names the topics where the gyro is not
    known.
    """
    contents, found = Contents(), dict[str, _Topic]()
    for message in read_messages(path, contents, on_progress):
        if message.topic not in found:
            axis = 'z' if _is_same_topic(message.topic, topics.reference) else topics.axis
            found[message.topic] = _Topic(
                message.topic, message.kind, contents.definitions[message.kind], axis)
        found[message.topic].add(message)
    try:
        log = _LogBuilder(Path(path).name, topics, contents, found).build(rate)
    except LogError as error:
        raise LogError(f'{path}: {error}') from None
    for note in log.notes:
        on_note(note)
    return replace(log, notes=(*log.notes, *contents.recorder_notes))


class _LogBuilder:
    """Makes a log of the messages of a recording, with notes on selections and corrections."""

    def __init__(self, name: str, topics: Topics, contents: Contents, found: dict[str, _Topic]):
        self._topics, self._contents, self._found = topics, contents, found
        self._notes = [f'ROS 2 recording {name}']

    def build(self, rate: float | None) -> Log:
        found = [topic for topic in self._topics_of_type({cdr.IMU})
                 if not _is_same_topic(topic, self._topics.reference)]
        if self._topics.gyro:
            found = [self._find_topic(self._topics.gyro, 'gyro').name]
        elif len(found) > 1:
            raise LogError(f'several gyros, {_join_names(found)}; select one with --topic')
        elif not found:
            reasons = ''.join(f' ({note})' for note in self._contents.notes)
            others = self._topics_of_type({
                kind for kind, definition in self._contents.definitions.items()
                if kind not in _REFERENCE_TYPES
                and 'rate' in cdr.parse_layout(definition).quantities})
            raise LogError(f'no message of {cdr.IMU} in it{reasons}{self._list_topics()}; ' + (
                f'select {_join_names(others, "or")} with --topic' if others
                else 'record the topic of the gyro'))
        gyro = self._read(self._found[found[0]])
        if not gyro.is_reported('rate'):
            raise LogError(f'{gyro.name} declares that it reports no angular velocity; name '
                           'another by --topic')
        temperature = None
        if self._topics.temperature is not None:
            temperature = self._find_topic(self._topics.temperature, 'temperature')
        elif found := self._topics_of_type({cdr.TEMPERATURE}):
            if len(found) > 1:
                self._notes.append(f'of the temperatures {_join_names(found)}, the one nearest to '
                                   'the topic of the gyro is used')
            temperature = self._found[max(found, key=lambda topic: len(os.path.commonprefix(
                [topic.strip('/'), gyro.name.strip('/')])))]
        temperature = temperature and self._read(temperature)
        reference = None
        if self._topics.reference is not None:
            reference = self._read(self._find_topic(self._topics.reference, 'reference'))
        elif possible := self._topics_of_type(set(_REFERENCE_TYPES) - {cdr.IMU}):
            self._notes.append('no reference was asked for; --reference-topic may be '
                               f'{_join_names(possible)}')
        use_stamps = all(each.has_stamps for each in (gyro, reference) if each is not None)
        if not use_stamps:
            self._notes.append('headers have no stamps: times are those of receipt')
        gyro.use_times(use_stamps)
        self._order_samples(gyro, rate)
        begin = gyro.stamps[0]
        time = (gyro.stamps - begin) / NSEC_PER_SEC
        self._notes.append(f'gyro: {gyro.name} ({gyro.kind}), {len(time)} samples, '
                           f'time_s from {format_seconds(begin)} s on')
        output = gyro.values('rate')
        lost = mask_invalid(output, 'output') | np.isnan(output)
        if lost.any():
            self._notes.append(f'{np.count_nonzero(lost)} samples are not finite and are lost')
            output[lost] = np.nan
        arrays: dict[str, Any] = {'output': output}
        force = gyro.values('force')
        if force.any() and not (gyro.values('force variance') == cdr.NOT_REPORTED).any():
            if mask_invalid(force, 'specific_force').any():
                self._notes.append('the specific force is not finite everywhere and was left out')
            else:
                arrays['specific_force'] = force
        if temperature is not None:
            temperature.use_times(use_stamps and temperature.has_stamps)
            arrays['temperature'] = self._interpolate_temperature(temperature, begin, time)
        if reference is not None:
            if reference.name == gyro.name:
                raise LogError(f'{gyro.name} cannot be its own reference; name another by '
                               '--reference-topic')
            reference.use_times(use_stamps)
            arrays |= self._interpolate_reference(reference, begin, time, output)
        return Log(time=time if rate is None else np.arange(len(time)) / rate, **arrays,
                   notes=(*self._notes, *self._contents.notes))

    def _find_topic(self, wanted: str, role: str) -> _Topic:
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
        if not len(self._found.get(topic, ())):
            raise LogError(f'{topic} has no message that can be read; record again')
        return self._found[topic]

    def _topics_of_type(self, kinds: set[str]) -> list[str]:
        return sorted(name for name, topic in self._found.items()
                      if topic.kind in kinds and len(topic))

    def _list_topics(self) -> str:
        topics = [f'{topic} ({kind})' for topic, kind in sorted(self._contents.topics.items())]
        return f'; there are {_join_names(topics)}' if topics else ', which holds no topic at all'

    def _read(self, topic: _Topic) -> _Topic:
        if topic.damaged_count:
            self._notes.append(f'{topic.damaged_count} messages of {topic.name} are damaged and '
                               'were left out')
        if len(topic.frames) > 1:
            raise LogError(f'messages of the frames {_join_names(sorted(topic.frames))} are on '
                           f'{topic.name}, as of several sensors: record each on a topic of its '
                           'own, or split the recording where the frame changes')
        return topic.in_order_of_receipt()

    def _order_samples(self, gyro: _Topic, rate: float | None) -> None:
        """Sort samples by their stamps, leave out duplicates, and refuse unusable times."""
        latest = np.maximum.accumulate(gyro.stamps)
        back = latest - gyro.stamps
        if rate is not None:
            gyro.rows['stamp'] = latest
        elif back.any():
            if back.max() > NSEC_PER_SEC:
                place = int(np.argmax(back > NSEC_PER_SEC))
                raise LogError(f'the stamps of {gyro.name} step back by '
                               f'{format_seconds(back[place])} s at sample {place + 1}, as after '
                               'setting a clock; split the recording there, or give the sample '
                               'rate with --rate')
            self._notes.append(f'{np.count_nonzero(back)} samples out of order were sorted')
            gyro.rows = gyro.rows[np.argsort(gyro.stamps, kind='stable')]
        doubled = np.diff(gyro.stamps, prepend=gyro.stamps[:1] - 1) == 0
        if rate is None and doubled.any():
            differs = np.diff(gyro.values('rate'), prepend=np.nan) != 0.0
            other = int(np.count_nonzero(doubled & differs))
            if other > 1 + 0.01 * len(doubled):
                raise LogError(f'{other} of {len(doubled)} samples of {gyro.name} have the stamp '
                               'of another sample, so their times are unknown; give the sample '
                               'rate with --rate')
            self._notes.append(f'{np.count_nonzero(doubled)} samples with the stamp of another '
                               'one were left out')
            gyro.rows = gyro.rows[~doubled]
        if (count := len(gyro.rows)) < 2:
            raise LogError(f'{gyro.name} has {count} of 2 samples with a time; record more')

    def _interpolate_temperature(self, topic: _Topic, begin: np.int64,
                                 time: Array) -> Array | None:
        """Return the temperature between readings; before and after them it is constant."""
        topic.rows = topic.rows[~mask_invalid(topic.values('temperature'), 'temperature')]
        topic.sort_by_stamps()
        at = (topic.stamps - begin) / NSEC_PER_SEC
        if (not len(at) or at[0] > time[-1] + _MAX_TEMPERATURE_GAP
                or at[-1] < -_MAX_TEMPERATURE_GAP):
            self._notes.append(f'temperature: {topic.name} has none at the times of the gyro')
            return None
        self._notes.append(f'temperature: {topic.name} ({topic.kind}), {len(at)} readings')
        inside = at[(at >= 0.0) & (at <= time[-1])]
        longest = float(np.diff(np.concatenate([[0.0], inside, time[-1:]])).max())
        if longest > _MAX_TEMPERATURE_GAP:
            self._notes.append(f'no temperature came for up to {longest:.0f} s; '
                               'it was interpolated, or held at the ends')
        return np.interp(time, at, topic.values('temperature'))

    def _interpolate_reference(self, topic: _Topic, begin: np.int64, time: Array,
                               output: Array) -> dict[str, Any]:
        """Return heading and rate of a reference at the samples of the gyro; nan where lost."""
        topic.sort_by_stamps()
        at = (topic.stamps - begin) / NSEC_PER_SEC
        rate = topic.values('rate') if topic.is_reported('rate') else None
        if rate is not None:
            rate = np.where(np.isfinite(rate), rate, np.nan)
        heading = None
        x, y, z, w = (topic.values(f'orientation.{each}') for each in 'xyzw')
        variance = topic.values('orientation variance')
        # declared unknown by an Imu, or left at its default
        if topic.is_reported('orientation.w') and not (
                topic.is_reported('orientation variance') and (
                    (variance == cdr.NOT_REPORTED).all()
                    or not (x.any() or y.any() or z.any() or variance.any())
                    and (w == 1.0).all())):
            heading, by_gyro = unwrap_heading(
                at, np.asarray(cdr.quaternion_heading(x, y, z, w)), time, output)
            if by_gyro:
                self._notes.append('the reference turned by more than half a turn between values; '
                                   'the number of turns is that of the gyro')
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
            raise LogError(f'{topic.name} has no heading and no rate at the times of the gyro; '
                           'name another reference, or check that both clocks agree')
        lost = np.isnan(next(iter(found.values()))).mean()
        self._notes.append(f'reference: {topic.name} ({topic.kind}), {len(at)} values, '
                           f'lost for {100 * lost:.1f} % of the samples')
        return found


def format_seconds(nanoseconds: int | np.int64) -> str:
    return f'{int(nanoseconds) // NSEC_PER_SEC}.{int(nanoseconds) % NSEC_PER_SEC:09d}'


def _join_names(names: Sequence[str], word: str = 'and') -> str:
    if len(names) > 20:  # hundreds of topics would make a message unreadable
        names = [*names[:20], f'{len(names) - 20} more']
    return names[0] if len(names) == 1 else f'{", ".join(names[:-1])} {word} {names[-1]}'
