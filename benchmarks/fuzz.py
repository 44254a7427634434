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
Fuzz every target of `test/fuzzed.py` with bytes from libFuzzer (atheris), guided by coverage.

    python benchmarks/fuzz.py --seconds 60              a minute for all targets, as in the tests
    python benchmarks/fuzz.py --seconds 1800 --corpus DIR     longer, from inputs kept in DIR
    python benchmarks/fuzz.py --only 'decoder kvh_1750'       one target
    python benchmarks/fuzz.py --repeat 'model' 7b7d           one input in hex, with its traceback

A fault is an exception that is not the documented one, an input that takes more than 5 s of a
processor, or a gigabyte. Each target runs in a process of its own; it ends at its first fault,
whose input is printed in hex. The exit code is 1 if there is a fault.

The share of lines is that of a target's files reached by the inputs that were kept, when they are
run once more.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import contextlib
from dataclasses import asdict, dataclass
import io
import json
import os
from pathlib import Path
import re
import resource
import sys
import tempfile
import time
import traceback

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))

PACKAGE = Path(__file__).parents[1] / 'gyro_calibration'
GIGABYTE = 1 << 30
#: What reads the bytes of a target, in the package.
FILES = {'decoder': ('driver/protocols/protocol.py',),
         'sample clock': ('driver/timestamps.py',),
         'log': ('logs/log.py',), 'compressed log': ('logs/log.py',),
         'model': ('model/model_file.py', 'model/settings_file.py'),
         'bias table': ('heading/bias_table.py', 'model/settings_file.py'),
         'motion profile': ('model/motion.py',),
         'recording': ('logs/recording.py', 'logs/ros_bag.py', 'logs/cdr.py')}


@dataclass
class Outcome:
    """What came of a target; the times are of a processor, but for that of the clock."""

    target: str
    inputs: int = 0
    clock_s: float = 0.0
    seconds: float = 0.0
    edges: int = 0
    kept: int = 0
    read: int = 0
    slowest_s: float = 0.0
    peak_mb: float = 0.0
    lines: float = 0.0
    fault: str = ''
    said: str = ''


def main() -> int:
    given = _arguments()
    if given.repeat:
        import fuzzed
        name, data = given.repeat
        print(fuzzed.TARGETS[name].check(bytes.fromhex(data)))
        return 0
    begun = time.monotonic()
    targets = _instrumented()
    names = [name for name in targets if not given.only or name in given.only]
    weights = {name: targets[name].weight * (given.decoders if name.startswith('decoder') else 1.0)
               for name in names}
    left = given.seconds - (time.monotonic() - begun)
    outcomes = []
    if not given.json:
        print(HEADER)
    with tempfile.TemporaryDirectory() as scratch:
        corpus = Path(given.corpus or scratch)
        for name in names:
            share = max(left * weights[name] / sum(weights.values()) - 0.6, 1.0)
            outcome = _run(name, targets[name], corpus / name.replace(' ', '_'), share, given.seed)
            outcome.lines = _lines(name, targets[name],
                                   corpus / name.replace(' ', '_')) if given.lines else 0.0
            outcomes.append(outcome)
            if not given.json:
                _show(outcome)
    _sum(outcomes, given.json)
    return int(any(outcome.fault for outcome in outcomes))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description='Fuzz every decoder and reader.')
    parser.add_argument('--seconds', type=float, default=60.0, help='for all targets together')
    parser.add_argument('--only', nargs='+', metavar='TARGET')
    parser.add_argument('--corpus', metavar='DIR', help='keeps inputs that reached something new')
    parser.add_argument('--repeat', nargs=2, metavar=('TARGET', 'HEX'))
    parser.add_argument('--seed', type=int, default=0,
                        help='of libFuzzer; 0 is another one each time')
    parser.add_argument('--decoders', type=float, default=1.0, metavar='TIMES',
                        help='give them so many times as much of the time')
    parser.add_argument('--lines', action='store_true',
                        help='measure the share of lines that was reached; takes time beyond '
                             '--seconds')
    parser.add_argument('--json', action='store_true')
    return parser.parse_args()


def _instrumented():
    """Import the targets, with only their code watched by atheris; watching all takes 20 s."""
    import atheris
    watched = {file for files in FILES.values() for file in files}
    others = [path.relative_to(PACKAGE.parent)
              for path in PACKAGE.rglob('*.py') if str(path.relative_to(PACKAGE)) not in watched]
    exclude = ['.'.join(path.with_suffix('').parts)
               for path in others if path.parent.name != 'protocols']
    # It tells of each module.
    with contextlib.redirect_stderr(io.StringIO()), atheris.instrument_imports(
            include=['gyro_calibration', 'yaml'], exclude=exclude):
        import fuzzed
    return fuzzed.TARGETS


def _run(name, target, corpus: Path, share: float, seed: int) -> Outcome:
    """Fuzz one target in a process of its own."""
    corpus.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(target.seeds()):
        (corpus / f'seed{number}').write_bytes(data)
    with tempfile.TemporaryDirectory() as folder:
        begun, process = time.monotonic(), os.fork()
        if not process:
            try:
                _fuzz(target, corpus, Path(folder), share, seed)
            finally:
                os._exit(1)  # only where libFuzzer did not end the process itself
        _, status, usage = os.wait4(process, 0)
        said = (Path(folder) / 'said').read_text(errors='replace')
        outcome = Outcome(name, 0, time.monotonic() - begun, usage.ru_utime + usage.ru_stime,
                          peak_mb=usage.ru_maxrss / 1024.0)
        _read(outcome, said, Path(folder), status)
    return outcome


def _fuzz(target, corpus: Path, folder: Path, share: float, seed: int) -> None:
    import atheris
    with open(folder / 'said', 'wb') as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    memory = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (memory + GIGABYTE, memory + GIGABYTE))
    words = folder / 'words'
    words.write_text(''.join(f'"{"".join(f"{chr(92)}x{byte:02x}" for byte in word)}"\n'
                             for word in target.words or (b'0',)))
    atheris.Setup(['fuzz', str(corpus), f'-max_total_time={max(round(share), 1)}',
                   f'-max_len={target.longest}', '-print_final_stats=1', '-timeout=60',
                   '-rss_limit_mb=0', f'-artifact_prefix={folder}/', f'-dict={words}',
                   '-verbosity=1', f'-seed={seed}', '-reload=0'], _watched(target.check, folder))
    atheris.Fuzz()


def _watched(check, folder: Path):
    """Return what libFuzzer calls, which notes how long inputs take and which one raised."""
    import fuzzed
    slowest, read = [0.0], [0]

    def one(data: bytes) -> None:
        before = time.process_time()  # not of a busy machine
        try:
            read[0] += bool(check(data))
        except BaseException:
            (folder / 'fault').write_text(f'{data.hex()}\n{traceback.format_exc()}')
            raise
        taken = time.process_time() - before
        if taken > slowest[0]:
            slowest[0] = taken
            (folder / 'slowest').write_text(f'{taken} {data.hex()}')
        if taken > fuzzed.SECONDS:
            (folder / 'fault').write_text(f'{data.hex()}\ntakes {taken:.1f} s')
            raise TimeoutError
    return one


def _read(outcome: Outcome, said: str, folder: Path, status: int) -> None:
    """Take the figures out of what libFuzzer and the target left."""
    found = re.findall(r'^#(\d+)\s.*cov: (\d+) ft: \d+ corp: (\d+)', said, re.MULTILINE)
    if found:
        outcome.inputs, outcome.edges, outcome.kept = map(int, found[-1])
    units = re.search(r'number_of_executed_units: (\d+)', said)
    outcome.inputs = int(units[1]) if units else outcome.inputs
    if (folder / 'slowest').exists():
        outcome.slowest_s = float((folder / 'slowest').read_text().split()[0])
    if (folder / 'fault').exists():
        outcome.fault, _, outcome.said = (folder / 'fault').read_text().partition('\n')
    elif status:
        inputs = [*folder.glob('timeout-*'), *folder.glob('crash-*'), *folder.glob('oom-*')]
        outcome.fault, outcome.said = (inputs[0].read_bytes().hex() if inputs else 'unknown',
                                       said[-2000:])


def _lines(name: str, target, corpus: Path) -> float:
    """Return the share of lines of the files of a target that the kept inputs reach."""
    own = {str(PACKAGE / file): set() for file in FILES[next(
        key for key in sorted(FILES, key=len, reverse=True) if name.startswith(key))]}
    if name.startswith('decoder'):
        own[sys.modules[type(
            target).__module__].WIRES[name.split()[1]].protocol.parser.__module__] = set()

    def trace(frame, event, argument):
        file = frame.f_code.co_filename
        if file not in own:
            return None
        if event == 'line':
            own[file].add(frame.f_lineno)
        return trace
    sys.settrace(trace)
    try:
        for path in sorted(corpus.iterdir())[:2000]:
            target.check(path.read_bytes())
    finally:
        sys.settrace(None)
    every = {file: set(_code_lines(file)) for file in own if os.path.exists(file)}
    return sum(len(own[file] & lines)
               for file, lines in every.items()) / max(sum(map(len, every.values())), 1)


def _code_lines(file: str) -> Iterator[int]:
    """Give the lines inside of functions."""
    codes = [compile(Path(file).read_text(), file, 'exec')]
    while codes:
        code = codes.pop()
        codes += [each for each in code.co_consts if hasattr(each, 'co_code')]
        if code.co_name not in ('<module>',) and code.co_flags & 2:  # a function, not a class
            yield from (line for _, _, line in code.co_lines() if line
                        and line != code.co_firstlineno)


HEADER = (f'{"target":22} {"inputs":>10} {"a second":>9} {"edges":>6} {"kept":>5} {"lines":>6} '
          f'{"slowest":>9} {"memory":>8}')


def _show(outcome: Outcome) -> None:
    print(f'{outcome.target:22} {outcome.inputs:10} '
          f'{outcome.inputs / max(outcome.seconds, 1e-9):9.0f} {outcome.edges:6} {outcome.kept:5} '
          f'{100 * outcome.lines:5.0f}% {1000 * outcome.slowest_s:6.0f} ms {outcome.peak_mb:5.0f} '
          'MB', flush=True)
    if outcome.fault:
        print(f'\nFAULT in {outcome.target!r}. Repeat it with:\n    python benchmarks/fuzz.py '
              f'--repeat {outcome.target!r} {outcome.fault}\n{outcome.said}', flush=True)


def _sum(outcomes: list[Outcome], as_json: bool) -> None:
    if as_json:
        print(json.dumps([asdict(outcome) for outcome in outcomes]))
        return
    inputs, seconds, clock = (sum(getattr(each, name) for each in outcomes)
                              for name in ('inputs', 'seconds', 'clock_s'))
    print(f'{inputs} inputs in {clock:.0f} s, of which a processor had {seconds:.0f} s for them: '
          f'{inputs / seconds:.0f} a second; {sum(bool(each.fault) for each in outcomes)} faults.')


if __name__ == '__main__':
    sys.exit(main())
