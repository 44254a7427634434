"""What the verbs share: their answer, their options for logs, and what they say of a wrong use."""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gyro_calibration import __version__
from gyro_calibration.log import DEGREE, Array, Log, read_log, read_log_blocks


class UsageError(ValueError):
    """The program was called in a way that cannot work; the message is one sentence."""


@dataclass(frozen=True)
class Answer:
    """What a verb found: plain words for people, and the same as data."""

    text: str
    data: dict[str, Any]


def verb(verbs: Any, name: str, function: Callable[[argparse.Namespace], Answer | None], summary: str,
          example: str) -> argparse.ArgumentParser:
    parser = verbs.add_parser(name, help=summary, description=f'{summary[0].upper()}{summary[1:]}.',
                              epilog=f'example: gyro_calibration {name} {example}')
    parser.set_defaults(verb=function, name=name)
    return parser


def add_log(parser: argparse.ArgumentParser, **how: Any) -> None:
    parser.add_argument('log', metavar='LOG', help='file in the log format, .csv or .csv.gz', **how)
    parser.add_argument('--rate', type=positive, metavar='HZ', help='the samples come at this rate; for logs without a usable time_s')
    parser.add_argument('--sensitivity', type=positive, metavar='DPS', help='deg/s a count, for logs that hold gyro_counts alone')
    parser.add_argument('--invert', action='store_true', help='the gyro counts clockwise turns positive')


def positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value


def not_negative(text: str) -> float:
    return 0.0 if float(text) == 0.0 else positive(text)


def whole(text: str) -> int:
    """Return a seed, as a numpy Generator takes it."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'{text} is below 0; a seed is a whole number from 0 on')
    return value


def picture_file(text: str) -> str:
    """Return the name of a picture to draw, if one can be drawn."""
    if not text.endswith(('.png', '.svg')):
        raise argparse.ArgumentTypeError(f'{text}: a picture ends in .png or .svg; name it so')
    if importlib.util.find_spec('matplotlib') is None:
        raise argparse.ArgumentTypeError('a picture needs matplotlib, which is not installed; install it, or leave the picture out')
    return text


def read(given: argparse.Namespace) -> Log:
    """Read the log that a verb was given, as its options say."""
    return _turned(given, read_log(given.log, _sensitivity(given), given.rate))


def bar(items: Iterable[Any], what: str) -> Iterable[Any]:
    """Show on a terminal how far the work on some items is, if it takes longer than two seconds."""
    return tqdm(items, desc=what, delay=2.0, leave=False, disable=None)


def origin_of(paths: Iterable[str]) -> dict[str, Any]:
    """Return what a model file says of where it comes from: logs, date, program."""
    files = [{'name': Path(path).name, 'sha256': hashlib.sha256(Path(path).read_bytes()).hexdigest()} for path in paths]
    return {'files': files, 'date': datetime.now(timezone.utc).isoformat(timespec='seconds'), 'program': f'gyro_calibration {__version__}'}


def read_blocks(given: argparse.Namespace) -> Iterator[Log]:
    """Read the log that a verb was given block by block, with a bar that shows how far it is."""
    size = Path(given.log).stat().st_size if Path(given.log).is_file() else None
    with tqdm(total=size, desc=given.log, unit='B', unit_scale=True, delay=2.0, leave=False, disable=None) as shown:
        for log in read_log_blocks(given.log, _sensitivity(given), given.rate, heard=lambda place: shown.update(place - shown.n)):
            yield _turned(given, log)


def _sensitivity(given: argparse.Namespace) -> float | None:
    return None if given.sensitivity is None else given.sensitivity * DEGREE


def _turned(given: argparse.Namespace, log: Log) -> Log:
    return replace(log, output=-output_of(given, log)) if given.invert else log


def output_of(given: argparse.Namespace, log: Log) -> Array:
    if log.output is None:
        raise UsageError(f'{given.log}: holds gyro_counts alone; say with --sensitivity how many deg/s a count is')
    return log.output


def time_of(given: argparse.Namespace, log: Log) -> Array:
    if log.time is None:
        raise UsageError(f'{given.log}: has no time_s, which {given.name} needs; say with --rate how many samples a second it holds')
    return log.time
