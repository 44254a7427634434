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
Emulate a gyro on a pseudo-terminal, from a model and a motion or from a log.

example: gyro_calibration emulate --protocol kvh_dsp3000 --model model.yaml --motion robot
--link /tmp/gyro
"""

import argparse
from itertools import count, islice, repeat
import json
import math
import signal

from gyro_calibration.cli import verb
from gyro_calibration.cli.simulate import add_motion_options, simulate_log
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample, Settings
from gyro_calibration.files import InputError, to_printable
from gyro_calibration.logs.log import DataRefused
from gyro_calibration.ros.start import handle_end_signals
import numpy as np


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--protocol', required=True, metavar='NAME',
                        help=f'one of {", ".join(PROTOCOLS)}')
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument('--log', metavar='LOG', help='send a recording')
    source.add_argument('--model', metavar='MODEL.yaml', help='send samples of a simulated gyro')
    add_motion_options(parser, default='rest')
    parser.add_argument('--rate', type=verb.positive_number, metavar='HZ',
                        help='sample rate, for logs without a usable time_s')
    parser.add_argument('--sensitivity', type=verb.degrees, metavar='DPS',
                        help='deg/s per count of the wire format; default: that of the protocol')
    parser.add_argument('--columns', default='time_s,gyro_dps,temperature_degc',
                        help='columns of the protocol csv; default: %(default)s')
    parser.add_argument('--link', metavar='PATH',
                        help='symbolic link to the pseudo-terminal, whose own name varies')
    parser.add_argument('--speed', type=verb.positive_number, default=1.0,
                        help='factor to real time; default: 1')
    parser.add_argument('--wait', action='store_true',
                        help='start when a program has opened the port')
    parser.add_argument('--repeat', action='store_true', help='start again at the end')
    verb.add_topic_options(parser)
    # of the other options that `verb.read` uses
    parser.set_defaults(invert=False, names={}, axis='z', unwrap=False, begin=0.0, end=math.inf)


def run(given: argparse.Namespace) -> None:
    """Print the path at once, since this verb sends until it ends."""
    try:
        protocol, settings = find_protocol(given.protocol), Settings(
            sensitivity=given.sensitivity, columns=tuple(given.columns.split(',')))
        protocol.check_settings(settings)
    except ValueError as error:
        raise InputError(str(error)) from None
    log = verb.read(given) if given.log else simulate_log(given)[0]
    time, output = verb.require_time(given, log), np.asarray(log.output)
    if (known := np.isfinite(output)).sum() < 2:
        raise DataRefused(f'{given.log}: {known.sum()} of {len(output)} samples have an output; '
                          'give a log with two or more')
    # the samples that have an output, once or, on request, again and again
    times, outputs = time[known] - time[known][0], output[known].tolist()
    temperatures = repeat(None) if log.temperature is None else log.temperature[known].tolist()
    starts = count(0.0, float(times[-1] + np.median(np.diff(times))))
    samples = (Sample(value, temperature, start + at)
               for start in islice(starts, None if given.repeat else 1)
               for at, value, temperature in zip(times.tolist(), outputs, temperatures))
    emulator = Emulator(protocol, samples, settings, given.speed, given.link, given.wait)
    handle_end_signals(lambda *_: emulator.stop())
    try:
        emulator.open()
        path = emulator.path if emulator.link is None else str(emulator.link)
        print(json.dumps({'path': path, 'protocol': protocol.name}) if given.json
              else to_printable(path), flush=True)
        emulator.run()
        emulator.wait_for_end_of_reader()
    finally:
        emulator.close()
        # launch sends a second signal, which must not interrupt a program that is about to end
        handle_end_signals(signal.SIG_IGN)
