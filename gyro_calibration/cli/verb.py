# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Common parts of the verbs: answers, options for logs, errors of usage, progress bars."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from html import escape
import importlib.util
import math
import os
import sys
from threading import Event, Thread
import time
from typing import Any

from gyro_calibration import __version__
from gyro_calibration.files import InputError, MAX_MAGNITUDE, sha256_digest, to_printable
from gyro_calibration.logs.columns import AXES
from gyro_calibration.logs.log import (
    Array, DataRefused, DEGREE, Log, select_rows, unwrap_reference)
from gyro_calibration.logs.recording import read_file, Topics
from gyro_calibration.logs.ros_bag import list_recording_files
from gyro_calibration.model.gyro_model import GyroModel
from tqdm import tqdm

PROGRESS_DELAY = 2.0  # time before progress is shown, s


@contextmanager
def show_progress(activity: str) -> Iterator[Callable[[float | None, str], None]]:
    """Show the present step, its fraction where it is known, and the elapsed time after 2 s."""
    begin, status_text = time.monotonic(), [f'{activity} ...']

    def on_progress(share: float | None, words: str) -> None:
        status_text[0] = (f'{words} ...'
                          if share is None else f'{100.0 * share:3.0f} %  {words} ...')

    finished = Event()

    def show() -> None:
        if finished.wait(PROGRESS_DELAY):
            return
        with tqdm(bar_format='{desc}', leave=False) as bar:
            while not finished.wait(0.5):
                text = f'{status_text[0]}  {time.monotonic() - begin:.0f} s'
                bar.set_description_str(text[:bar.ncols])

    thread = Thread(target=show, daemon=True)
    if sys.stderr.isatty():
        thread.start()
    try:
        yield on_progress
    finally:
        finished.set()
        if thread.is_alive():
            thread.join()


@contextmanager
def _show_bytes_read(path: str) -> Iterator[Callable[[int], object]]:
    size = sum(os.path.getsize(file)
               for file in list_recording_files(path) if os.path.isfile(file)) or None
    words = to_printable(path)
    with show_progress(words) as on_progress:
        yield lambda place: on_progress(place / size if size else None, words)


class PrintedResult:
    """A record with a text, that a notebook shows too."""

    def _repr_html_(self) -> str:
        return f'<pre>{escape(str(self))}</pre>'


@dataclass(frozen=True)
class Answer:
    """The result of a verb: lines for people, data in SI, and the files that were written."""

    lines: Iterable[str]
    data: dict[str, Any]
    files: Iterable[str | None] = ()

    @property
    def text(self) -> str:
        return '\n'.join([*self.lines, *(f'Written to {each}.' for each in self.files if each)])


def add_picture_option(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument('--picture', type=_picture_file, metavar='FILE',
                        help=f'draw {what}, .png or .svg')


def add_log_options(parser: argparse.ArgumentParser, **options: Any) -> None:
    parser.add_argument('log', metavar='LOG', help='file in the log format, .csv or .csv.gz, or a '
                        'ROS 2 recording: folder, .mcap or .db3', **options)
    parser.add_argument('--rate', type=positive_number, metavar='HZ',
                        help='sample rate, for logs without a usable time_s')
    parser.add_argument('--sensitivity', type=degrees, metavar='DPS',
                        help='deg/s per count, for logs with gyro_counts only')
    parser.add_argument('--invert', action='store_true',
                        help='the gyro reports clockwise turns as positive')
    parser.add_argument('--columns', dest='names', type=_parse_columns, default={},
                        metavar='QUANTITY=NAME:UNIT,...',
                        help='columns with other names than in the log format, such as '
                        'time=t:ms,gyro=wz:deg/s,heading=yaw:deg; default unit: SI; '
                        'attitude=qw/qx/qy/qz is a quaternion in place of a heading')
    parser.add_argument('--axis', choices=AXES, default='z', help='axis of the gyro, for columns '
                        'such as gyro_x_dps, an attitude and recordings; default: z')
    parser.add_argument('--unwrap', action='store_true', help='remove jumps by full turns from '
                        'the reference heading')
    parser.add_argument('--from', dest='begin', type=float, default=0.0, metavar='S',
                        help='omit samples before this time, s since the first sample')
    parser.add_argument('--to', dest='end', type=float, default=math.inf, metavar='S',
                        help='omit samples after this time, s since the first sample')
    add_topic_options(parser)


def add_topic_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--topic', metavar='TOPIC', help='topic of the gyro in a recording, '
                        'sensor_msgs/Imu or geometry_msgs/Vector3Stamped; default: the only Imu')
    parser.add_argument('--reference-topic', metavar='TOPIC', help='of the reference: Odometry, '
                        'Imu, PoseStamped, TwistStamped, TransformStamped; default: none')
    parser.add_argument('--temperature-topic', metavar='TOPIC',
                        help='of the temperature; default: the name nearest to that of the gyro')


def _parse_columns(text: str) -> dict[str, str]:
    """Return quantity -> column, or column:unit, of an argument."""
    pairs = [each.partition('=')[::2] for each in text.split(',')]
    if any(not name or not column for name, column in pairs):
        raise argparse.ArgumentTypeError(f'{text}: wanted QUANTITY=NAME, such as '
                                         'time=t,gyro=wz:deg/s')
    return {name.strip(): column.strip() for name, column in pairs}


def _number(kind: type[Any], low: float, high: float = math.inf,
            unit: str = '') -> Callable[[str], Any]:
    """Return a parser of numbers of a kind within bounds."""
    def parse(text: str) -> Any:
        value = kind(text)
        if not low <= value <= high:
            wanted = (f'from {low:g} to {high:g}' if high < MAX_MAGNITUDE
                      else 'above 0' if 0.0 < low < 1.0 else f'of {low:g} or more')
            raise argparse.ArgumentTypeError(f'{value:g}{unit} is out of range; give a number '
                                             f'{wanted}{unit}')
        return value
    return parse


positive_number = _number(float, 1.0 / MAX_MAGNITUDE, MAX_MAGNITUDE)
non_negative_number = _number(float, 0.0, MAX_MAGNITUDE)
degrees_celsius = _number(float, -273.15, 1e4, ' degC')
positive_integer = _number(int, 1)
non_negative_integer = _number(int, 0)  # as seeds of numpy


def degrees(text: str) -> float:
    """Return a positive number of deg in rad."""
    return float(positive_number(text)) * DEGREE


def _picture_file(text: str) -> str:
    if not text.endswith(('.png', '.svg')):
        raise argparse.ArgumentTypeError(f'{text} is no picture file; give a name that ends in '
                                         '.png or .svg')
    if importlib.util.find_spec('matplotlib') is None:
        raise argparse.ArgumentTypeError('a picture needs matplotlib, which is not installed; '
                                         'install it or omit the option')
    return text


def read(given: argparse.Namespace) -> Log:
    """Read the log of a verb by its options; it has an output."""
    with _show_bytes_read(given.log) as on_progress:
        topics = Topics(given.topic, given.reference_topic, given.temperature_topic, given.axis)
        log = read_file(given.log, topics, given.rate, given.sensitivity, given.names, on_progress,
                        print_message)
    if log.output is None:
        raise InputError(f'{given.log}: has gyro_counts only; set --sensitivity, deg/s a count')
    log = replace(log, output=-log.output) if given.invert else log
    if given.unwrap and log.reference_heading is not None:
        require_time(given, log)
        log = unwrap_reference(log)
    return cut_to_range(given, log)


def read_each(given: argparse.Namespace) -> Iterator[Log]:
    for path in given.log:
        yield read(argparse.Namespace(**{**vars(given), 'log': path}))


def cut_to_range(given: argparse.Namespace, log: Log) -> Log:
    if given.begin <= 0.0 and given.end == math.inf:
        return log
    since = require_time(given, log) - require_time(given, log)[0]
    rows = (since >= given.begin) & (since <= given.end)
    if not rows.any():
        raise DataRefused(f'{given.log}: --from {given.begin:g} --to {given.end:g} leaves no '
                          'sample; give a range within the log')
    return select_rows(log, rows)


def print_message(text: object) -> None:
    print(f'gyro_calibration: {to_printable(text)}', file=sys.stderr, flush=True)


def make_origin(paths: Iterable[str]) -> dict[str, Any]:
    """Return the origin of a model, for its file: logs, date, program."""
    files = [{'name': to_printable(file.name), 'sha256': sha256_digest(file)}
             for path in paths for file in list_recording_files(path)]
    return {'files': files, 'date': datetime.now(timezone.utc).isoformat(timespec='seconds'),
            'program': f'gyro_calibration {__version__}'}


def add_origin(given: argparse.Namespace, model: GyroModel) -> GyroModel:
    """Return a model of --model unchanged, or a new one with the log as its origin."""
    return model if given.model else replace(model, origin=make_origin([given.log]))


def require_folder(path: str) -> None:
    if os.path.exists(path) and not os.path.isdir(path):
        raise InputError(f'{path}: is a file, but must be a folder; give another name')


def require_time(given: argparse.Namespace, log: Log) -> Array:
    if log.time is None:
        raise InputError(f'{given.log}: has no time_s, which {given.name} needs; name its column, '
                         'as by --columns time=NAME:s, or give the sample rate with --rate')
    return log.time
