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
Measure the error of a simulation, name the cause, extend the model, measure the gain.

example: gyro_calibration diagnose drive.csv --model gyro.yaml --out diagnosis
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
import json
from pathlib import Path
import time

from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer, show_progress
from gyro_calibration.diagnosis.findings import Diagnosis, OnProgress
from gyro_calibration.diagnosis.gates import REFERENCE_KINDS
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.report import render_report
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.files import write_atomically
from gyro_calibration.logs.log import Log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import format_model, read_model
import numpy as np


def add(parser: argparse.ArgumentParser) -> None:
    verb.add_log_options(parser, nargs='+')
    parser.add_argument('--model', metavar='MODEL.yaml', help='of the simulation; default: an '
                        'ideal gyro with the bias and scale factor error that fit the logs best')
    parser.add_argument('--reference-kind', choices=REFERENCE_KINDS,
                        help='kind of the reference, if it is not detected right; '
                        'default: detected from the log')
    parser.add_argument('--out', metavar='DIR', help='folder for diagnosis.json, report.html and '
                        'model.yaml, the extended model')
    parser.add_argument('--time-limit', type=verb.positive_number, metavar='S', help='the search '
                        'for causes ends after half of it, s, and what was found is confirmed and '
                        'reported; default: none')
    parser.add_argument('--seed', type=verb.non_negative_integer, default=0, metavar='N',
                        help='seed of the noise that fills gaps of a log; default: 0')


def run(given: argparse.Namespace) -> Answer:
    if given.out:
        verb.require_folder(given.out)
    logs = list(verb.read_each(given))
    model = None if given.model is None else read_model(given.model)
    with show_progress('diagnosis') as on_progress:
        found = diagnose_logs(logs, model, given.seed, given.reference_kind, given.log,
                              on_progress, given.time_limit)
    if found.model is not model:
        origin = {**found.model.origin, **verb.make_origin(found.logs)}
        found = replace(found, model=replace(found.model, origin=origin))
    written = write_diagnosis(given.out, found) if given.out else []
    return Answer([*terminal_lines(found), *written], found.to_dict())


def diagnose_logs(logs: Sequence[Log], model: GyroModel | None, seed: int, kind: str | None = None,
                  names: Sequence[str] = (),
                  on_progress: OnProgress = lambda share, words: None,
                  time_limit: float | None = None) -> Diagnosis:
    """Diagnose logs in time, or a rate table; the search ends after half of a time limit, s."""
    begin = time.monotonic()

    def on_step(share: float | None, words: str) -> bool:
        on_progress(share, words)
        return time_limit is not None and time.monotonic() - begin > 0.5 * time_limit

    return diagnose(logs, np.random.default_rng(seed), model, names=names, on_progress=on_step,
                    reference_kind=kind)


def write_diagnosis(folder: str | Path, found: Diagnosis) -> list[str]:
    """Write all files; their content is made before the first one is written."""
    content = {'diagnosis.json': json.dumps(found.to_dict(), indent=2, allow_nan=False) + '\n',
               'report.html': render_report(found), 'model.yaml': format_model(found.model)}
    for name in content:
        if (Path(folder) / name).is_dir():
            raise IsADirectoryError(f'{Path(folder) / name} is a folder, but must be a file; '
                                    'move it away')
    for name, text in content.items():
        write_atomically(Path(folder) / name, text.encode())
    return [f'Written to {folder}: {", ".join(content)}.']
