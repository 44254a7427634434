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
Compare published numbers of the sources with those reproduced here.

example: gyro_calibration reproduce hong_park
"""

import argparse

from gyro_calibration.cli.verb import Answer, non_negative_integer, show_progress
from gyro_calibration_reproduction import SOURCES
from gyro_calibration_reproduction.finding import render_page
import numpy as np


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('source', nargs='?', choices=list(SOURCES), metavar='SOURCE',
                        help=f'one of {", ".join(SOURCES)}; default: all')
    parser.add_argument('--seed', type=non_negative_integer, default=0,
                        help='seed of the noise; default: 0, as in '
                        'docs/explanation/reproduction.md')


def run(given: argparse.Namespace) -> Answer:
    """Reproduce each source with a generator of its own, independent of the other sources."""
    names = [given.source] if given.source else list(SOURCES)
    found = {}
    for name in names:
        with show_progress(name):
            found[name] = SOURCES[name](np.random.default_rng(given.seed))
    text = '\n\n'.join(render_page(reproduction) for reproduction in found.values())
    return Answer([text],
                  {'seed': given.seed,
                   'sources': {name: reproduction.data() for name, reproduction in found.items()}})
