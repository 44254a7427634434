# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The program ``gyro_calibration``: it runs one verb, prints its answer and sets its exit code."""

import argparse
import ast
from collections.abc import Sequence
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path
import re
import sys
from typing import Any, NoReturn

# The matrices of a fit are small; synchronization of threads makes it ten times slower on a busy
# machine. NumPy reads the variable once.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# ruff: noqa: E402
from gyro_calibration import __version__
from gyro_calibration.cli.verb import print_message
from gyro_calibration.diagnosis.causes import register_causes
from gyro_calibration.files import (
    describe_error, format_json, InputError, remedy, to_printable)
from gyro_calibration.logs.log import DataRefused
from gyro_calibration.model.effects import add_effects
import numpy as np


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb, print its answer, and return 0 (done), 1 (no answer) or 2 (wrong use)."""
    words = sys.argv[1:] if arguments is None else arguments
    given = make_parser(str(words[0]) if words else '').parse_args(words)
    try:
        for name, value in vars(given).items():
            if value == '' or isinstance(value, list) and '' in value:  # a variable of the shell
                raise InputError(f'{name.replace("_", "-")} is empty; give a value or omit it')
        # Only the command line names Python files to be run; models and logs cannot.
        for path in given.catalogue:
            spec = spec_from_file_location('effects_of_the_user', path)
            if spec is None or spec.loader is None or not Path(path).is_file():
                raise InputError(f'{path} is not a Python file; wanted .py with a list EFFECTS')
            module = module_from_spec(spec)
            try:
                spec.loader.exec_module(module)
                add_effects(module.EFFECTS)
                register_causes(module.EFFECTS)
            except Exception as error:
                raise InputError(f'{path} cannot be used as a catalogue ({type(error).__name__}: '
                                 f'{error}); wanted EFFECTS, a list of '
                                 'gyro_calibration.model.effects.Effect') from None
        answer = given.run(given)
        text = (None if answer is None else answer.text if not given.json
                else format_json(answer.data))
    except DataRefused as error:
        print_message(error)
        return 1
    except (ArithmeticError, np.linalg.LinAlgError, MemoryError) as error:
        print_message(f'the values exceed the range of computation ({describe_error(error)}); '
                      'check columns and units')
        return 1
    except InputError as error:
        print_message(error)
        return 2
    except OSError as error:
        path = error.filename
        print_message(error if path is None or not error.strerror else
                      f'{path}: {describe_error(error)}; {remedy(error, str(path))}')
        return 2
    if text is not None:
        encoding = sys.stdout.encoding or 'utf-8'  # a file name may not be text
        text = to_printable(text, allowed='\n').encode(encoding, 'backslashreplace').decode(
            encoding)
        try:
            print(text, flush=True)
        except BrokenPipeError:  # such as of `head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


class _Parser(argparse.ArgumentParser):
    """Reports wrong arguments, without the control characters that names of files may contain."""

    def _print_message(self, message: str, file: Any = None) -> None:
        super()._print_message(to_printable(message, allowed='\n'), file)

    def error(self, message: str) -> NoReturn:
        """End with 2 and one sentence."""
        message = re.sub(r'invalid \w+ value: (.*)', r'\1 is no number', message)
        self.exit(2, f'{self.prog}: {message}; see {self.prog} --help\n')


def find_verbs() -> dict[str, str]:
    """Return the docstring of each verb, which are the files with a function ``run``."""
    texts = {path.stem: path.read_text('utf-8')
             for path in sorted(Path(__file__).parent.glob('*.py'))}
    return {name.replace('_', '-'): ast.get_docstring(ast.parse(text)) or name
            for name, text in texts.items() if '\ndef run(' in text}


def make_parser(called: str) -> argparse.ArgumentParser:
    """Return the parser of the verbs; only the called one is imported, and has its arguments."""
    parser = _Parser(prog='gyro_calibration',
                     description='Calibrate, compensate and diagnose gyros with one axis.')
    parser.add_argument('--version', action='version', version=__version__)
    verbs = parser.add_subparsers(required=True, metavar='VERB')
    for name, text in find_verbs().items():
        summary, example = (' '.join(part.split()) for part in text.split('\n\n'))
        verb = verbs.add_parser(name, help=f'{summary[0].lower()}{summary[1:-1]}',
                                description=summary, epilog=example)
        if name == called:
            module = import_module(f'gyro_calibration.cli.{name.replace("-", "_")}')
            module.add(verb)
            verb.set_defaults(run=module.run, name=name)
            verb.add_argument('--json', action='store_true',
                              help='print one JSON object and nothing else')
            verb.add_argument('--catalogue', action='append', default=[], metavar='FILE.py',
                              help='Python file, which is executed, with EFFECTS, a list of '
                              'further effects for models and diagnoses')
    return parser
