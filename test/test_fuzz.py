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
Any bytes: only documented errors are raised, nothing hangs, memory is bounded.

The claims are in `fuzzed`: hypothesis tries them on what the project writes, damaged at random,
and atheris for 10 s, or 10 minutes as evidence, guided by coverage. What they once found is tried
again.
"""

import json
import os
from pathlib import Path
import struct
import subprocess
import sys

from chance import evidence
from fuzzed import SECONDS, TARGETS
import pytest

hypothesis = pytest.importorskip('hypothesis', reason='hypothesis is not installed')
FUZZER = Path(__file__).parents[1] / 'benchmarks' / 'fuzz.py'
#: Target -> how many inputs hypothesis tries; YAML takes ten times as long as the rest.
EXAMPLES = {'model': 40, 'bias table': 20, 'recording .db3': 40}

#: What the fuzzers found: target, input.
FOUND = {
    'a clock of the device that hardly goes on': (
        'sample clock', b'\2\0' + b''.join(struct.pack('<HBBB', *sample) for sample in (
            *((number, 96, 0, 0) for number in range(12)), (1026, 0, 0, 96),
            *((0, late, 0, 96) for late in range(1, 26)),
            *((number, 96, 0, 0) for number in range(12, 16))))),
    'more empty lines at the end than a block has rows': (
        'log', b'gyro_counts,lap\n0.0,a\n1.0,b\n2.0,\n' + 8 * b'\n'),
    'a column whose name has two lines, as some systems end them': ('log', (
        b'gyro_counts,e_dps0.0,"reference_rate_dpsa\r\n'
        b'n,a\n1.0,nan,b\n2.0\n"\n.0,nan,k\n11.0,nan,l\n')),
}


def damaged(seeds):
    """Return a strategy for bytes: any, or a seed with parts cut, added, doubled, replaced."""
    some = hypothesis.strategies
    edits = some.lists(some.tuples(some.floats(0.0, 1.0), some.integers(0, 40),
                                   some.binary(max_size=20), some.integers(1, 3)), max_size=4)

    def damage(seed, edits):
        for place, length, data, times in edits:
            begin = round(place * len(seed))
            seed = seed[:begin] + data * times + seed[begin + length:]
        return seed
    return some.one_of(some.builds(damage, some.sampled_from(seeds), edits),
                       some.binary(max_size=300))


@pytest.mark.parametrize('name', TARGETS)
def test_any_bytes_are_survived(name):
    target = TARGETS[name]

    @hypothesis.settings(max_examples=EXAMPLES.get(name, 80), deadline=1000.0 * SECONDS,
                         database=None, suppress_health_check=[
                             hypothesis.HealthCheck.too_slow,
                             hypothesis.HealthCheck.data_too_large])
    @hypothesis.given(damaged(target.seeds()))
    def survived(data):
        target.check(data)
    survived()


@pytest.mark.parametrize('name', TARGETS)
def test_what_the_project_writes_is_read(name):
    """Else the fuzzers would begin far from what counts."""
    assert any(TARGETS[name].check(data) for data in TARGETS[name].seeds())


@pytest.mark.parametrize(('name', 'data'), FOUND.values(), ids=FOUND)
def test_what_was_found_once_is_survived(name, data):
    TARGETS[name].check(data)


@pytest.mark.parametrize('seconds', [10, evidence(600)])
def test_fuzzing_guided_by_coverage_finds_nothing(seconds):
    pytest.importorskip('atheris', reason='atheris, which has wheels for x86-64, is not installed')
    environment = {**os.environ, 'OPENBLAS_NUM_THREADS': '1'}
    process = subprocess.run([sys.executable, FUZZER, '--seconds', str(seconds), '--json'],
                             capture_output=True, text=True, timeout=2 * seconds + 180,
                             env=environment)
    assert process.stdout, process.stderr
    outcomes = json.loads(process.stdout)
    faults = [f'{each["target"]}: repeat it with python benchmarks/fuzz.py --repeat '
              f'{each["target"]!r} {each["fault"]}\n{each["said"]}'
              for each in outcomes if each['fault']]
    assert not faults and process.returncode == 0, '\n\n'.join(faults) + process.stderr
    assert ({each['target'] for each in outcomes} == set(TARGETS)
            and all(each['inputs'] for each in outcomes))
