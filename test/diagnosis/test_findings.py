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
What docs/findings.md says of measured recordings is what the program finds in them.

The tables of the document are read, and its commands are run. A size may differ a little, for
noise that is drawn to fill lost samples differs between releases of numpy; an error by a quarter
of the width of the interval of the improvement.
"""

import json
from pathlib import Path
import re
import shlex

from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.words import format_amount, format_quantity
import pytest

TEXT = (Path(__file__).parents[2] / 'docs/findings.md').read_text()
COMMANDS = re.findall(r'^ +gyro_calibration (.+)$', TEXT, re.MULTILINE)
NUMBER = re.compile(r'−?\d+(?:\.\d+)?(?:e[+-]\d+)?')


def table(title):
    """Return the rows of a table of the document, by the recording that is in their first cell."""
    part = TEXT.split(f'\n## {title}\n')[1].split('\n## ')[0]
    rows = [[cell.strip() for cell in line.strip('|').split('|')]
            for line in part.splitlines() if line.startswith('| `')]
    found = {}
    for name, *cells in rows:
        found.setdefault(name.strip('`'), []).append(cells)
    return found


CAUSES, LEFT, GAINS = table('Causes'), table('What is left'), table('Gains')
RECORDINGS = [shlex.split(command)[shlex.split(command).index('--out') + 1]
              for command in COMMANDS if command.startswith('diagnose')]


def numbers(text):
    """Return the numbers in a text, and the rest of it."""
    return [float(each.replace('−', '-')) for each in NUMBER.findall(text)], NUMBER.sub('#', text)


def agree(written, found):
    """
    Tell whether a quantity is as written: within half of its interval, or 2 %.

    Where the vibration of a stepper is left, the assumed noise moves a delay by 1 %, which is more
    than its interval.
    """
    (mine, form), (theirs, other) = numbers(written), numbers(found)
    half = max(0.5 * (mine[2] - mine[1]) if len(mine) == 3 else 0.0, 0.02 * abs(mine[0]))
    return form == other and abs(mine[0] - theirs[0]) <= half


def shown(finding):
    """Return the size of a cause as the program prints it."""
    name, size = next(iter(finding['parameters'].items()))
    return str(format_quantity(Estimate(size['estimate'], tuple(size['ci95']), size['unit']),
                               name))


#: Recordings of 25 min, which take most of a minute each, and the slower of two by hand.
LONG = 'yaw_slow', 'yaw_fast', 'pitch_slow', 'hand_slow'


@pytest.fixture
def diagnosed(data, run, tmp_path, monkeypatch):
    """Return a function that runs the commands of a recording, and gives what was found."""
    def diagnosed(recording):
        monkeypatch.chdir(tmp_path)
        (tmp_path / 'data').symlink_to(data)
        model = re.search(r'```yaml\n(.*?)```', TEXT, re.DOTALL).group(1)
        (tmp_path / 'none.yaml').write_text(model)
        place = next(place for place, each in enumerate(COMMANDS)
                     if each.endswith(f'--out {recording}'))
        needed = [each for each in COMMANDS[:place]
                  if each.split('--out ')[1] in COMMANDS[place].split()]
        for command in (*needed, COMMANDS[place]):
            code, _, error = run(*shlex.split(command))
            assert code == 0, error
        return json.loads((tmp_path / recording / 'diagnosis.json').read_text())
    return diagnosed


def test_the_tables_are_of_the_recordings_that_are_diagnosed():
    assert RECORDINGS and set(CAUSES) | set(LEFT) | set(GAINS) <= set(RECORDINGS)


@pytest.mark.parametrize('recording', [
    pytest.param(name, marks=[pytest.mark.evidence] if name in LONG else [])
    for name in RECORDINGS])
def test_what_is_written_of_a_recording_is_found_in_it(diagnosed, recording):
    found = diagnosed(recording)
    # several of a kind stay in their order
    causes = sorted(found['findings'], key=lambda each: each['effect'])
    written = sorted(((cause.strip('`'), *cells) for cause, *cells in CAUSES.get(recording, [])),
                     key=lambda each: each[0])
    assert [each['effect'] for each in causes] == [name for name, *_ in written]
    for (name, size, instead), cause in zip(written, causes):
        assert agree(size, shown(cause)), (name, size, shown(cause))
        assert re.findall(r'`(\w+)`', instead) == cause['ambiguous_with']
    left = {each['along']: 100.0 * each['share_of_variance'] for each in found['unexplained']}
    parts = dict(LEFT.get(recording, []))
    assert set(left) == set(parts)
    for along, part in parts.items():
        (size,), _ = numbers(part)
        assert (left[along] < size if part.startswith('less')
                else left[along] == pytest.approx(size, rel=0.1)), along
    gain = found['gain']
    errors = {} if gain is None else {what: gain[f'{what}_rms']
                                      for what in ('rate', 'heading') if gain[f'{what}_rms']}
    assert set(errors) == {what for what, *_ in GAINS.get(recording, [])}
    for what, before, after, won in GAINS.get(recording, []):
        _, *interval = numbers(won)[0]
        assert bool(interval) == (errors[what]['ci95'] is not None)
        width = interval[1] - interval[0] if interval else 0.0
        for text, moment in ((before, 'before'), (after, 'after')):
            (size,), form = numbers(text)
            in_si = {'rate': 'rad/s', 'heading': 'rad'}[what]
            (now,), unit = numbers(format_amount(errors[what][moment], in_si))
            near = abs(now - size) <= max(0.25 * width, 0.03 * size)
            assert unit == form and near, (what, moment, now)
