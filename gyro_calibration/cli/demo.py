"""The verb demo: the whole graph on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path
import secrets
from typing import Any

from gyro_calibration.cli.verb import Answer, UsageError, verb, whole


def add(verbs: Any) -> argparse.ArgumentParser:
    parser = verb(verbs, 'demo', _demo, 'emulated gyro, driver, compensation, self-calibration '
                  'and a drive, on this machine', '--out demo')
    parser.add_argument('--out', default='demo', metavar='DIR',
                        help='where picture, table and log go; default: %(default)s')
    parser.add_argument('--seed', type=whole, help='of the noise; default: another one each time')
    return parser


def _demo(given: argparse.Namespace) -> Answer:
    try:
        from gyro_calibration.demo import run_demo
    except ImportError as error:
        raise UsageError(f'the demo needs ROS 2 and matplotlib ({error}); source ROS 2, or '
                         'install gyro_calibration[ros,plot]') from None
    seed = secrets.randbits(32) if given.seed is None else given.seed
    result = run_demo(Path(given.out), seed)
    return Answer(result.text, result.data)
