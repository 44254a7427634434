# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Documents hold: links, tables and commands agree with the code, and examples run."""

import importlib
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

from gyro_calibration.cli.main import make_parser
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import read_log
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.model_file import POLYNOMIAL, read_model
import numpy as np
import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / 'docs'
DOCUMENTS = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'CHANGELOG.rst',
             *sorted(DOCS.rglob('*.md'))]
LINK = re.compile(r'\[[^\]]*\]\(([^)\s]+)\)')
FILE = re.compile(r'`((?:docs|config|launch|test|benchmarks|gyro_calibration)/[\w./]+\.\w+|'
                  r'[A-Z]+\.(?:md|rst)|Makefile|setup\.py)`')
COMMAND = re.compile(r'^ +gyro_calibration (.+?)(?: +#.*)?$', re.MULTILINE)
IN_PROSE = re.compile(r'`gyro_calibration ([a-z-]+ [^`]+)`')


def found_in_documents(pattern):
    """Yield each document with each match of a pattern in it, continued lines as one."""
    for document in DOCUMENTS:
        for found in pattern.findall(document.read_text().replace('\\\n', ' ')):
            yield document, found


def anchors(document):
    titles = re.findall(r'^#+ (.+)$', document.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-') for title in titles}


def test_every_relative_link_leads_somewhere():
    for document, target in found_in_documents(LINK):
        path, _, anchor = target.partition('#')
        if '://' in target:
            continue
        assert (document.parent / path).exists(), (document, target)
        assert not anchor or anchor in anchors(
            document.parent / path if path else document), (document, target)


def test_every_file_that_is_named_exists():
    assert not [(document, name) for document, name in found_in_documents(FILE)
                if not (ROOT / name).exists() and not (document.parent / name).exists()]


def test_every_command_of_the_documents_is_understood(capsys):
    for document, command in [*found_in_documents(COMMAND), *found_in_documents(IN_PROSE)]:
        words = shlex.split(command)
        try:
            make_parser(words[0]).parse_args(words)
        except SystemExit:
            pytest.fail(f'{document}: {command}\n{capsys.readouterr().err}')


def test_every_document_has_no_line_beyond_140_columns_outside_tables():
    long = [(document.name, line) for document in DOCUMENTS
            for line in document.read_text().splitlines()
            if len(line) > 140 and not line.startswith('|')]
    assert not long


def number(value):
    """Return a number as people write it: a float shows that it is one."""
    text = f'{value:.5g}' if isinstance(value, float) else str(value)
    return f'{text}.0' if isinstance(value, float) and text.isdigit() else text


def row(parameter):
    """Return a parameter as a row of the table in docs/reference/on_a_robot.md."""
    default = parameter.default
    if isinstance(default, str):
        text = f'`{default}`' if default else 'empty'
    elif isinstance(default, bool):
        text = str(default).lower()
    elif isinstance(default, (int, float)):
        text = number(default)
    else:
        text = f'`[{", ".join(default)}]`'
    limits = (' to '.join(map(number, parameter.range or ()))
              or ', '.join(map('`{}`'.format, parameter.choices)))
    return (f'| `{parameter.name}` | {text} | {parameter.unit} | {limits} | '
            f'{"yes" if parameter.dynamic else ""} | '
            + parameter.description.replace('*', r'\*') + ' |')


def flat(values, group=''):
    """Yield the parameters of a file, those of groups with their dots: calibration.drive."""
    for name, value in values.items():
        yield from (flat(value, f'{group}{name}.') if isinstance(value, dict)
                    else [(f'{group}{name}', value)])


@pytest.mark.parametrize('node', ['driver_node', 'compensation_node'])
def test_table_and_configuration_hold_every_parameter_of_a_node_with_its_default(node):
    pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')
    parameters = importlib.import_module(f'gyro_calibration.ros.{node}').PARAMETERS
    table = '\n'.join(map(row, parameters))
    assert table in (DOCS / 'reference/on_a_robot.md').read_text(), (
        f'put this table there:\n{table}')
    files = [yaml.safe_load((ROOT / 'config' / name).read_text())
             for name in ('driver.yaml', 'compensation.yaml')]
    configured = [dict(flat(values['ros__parameters'])) for file in files
                  for values in file.values()]
    wanted = {parameter.name: list(parameter.default) if isinstance(parameter.default, tuple)
              else parameter.default
              for parameter in parameters}
    assert wanted in configured


def test_the_models_in_the_documents_can_be_read(tmp_path):
    page = (DOCS / 'reference/error_model.md').read_text()
    texts = re.findall(r'```yaml\n(.*?)```', page, re.DOTALL)
    models = []
    for number, text in enumerate(texts):
        path = tmp_path / f'{number}.yaml'
        path.write_text(text)
        models.append(read_model(path))
    assert len(models) >= 3
    full = models[-1]
    assert (full.covariance is not None and full.self_calibration is not None and full.gyro
            and full.origin and full.noise.rate_random_walk)


def headline(text):
    """Return the first two sentences of the example's diagnosis, numbers as #, and the numbers."""
    said = re.search(r'Simulation and measurement differ because of warm up:.*? parts\.',
                     ' '.join(text.split()))[0]
    number = r'\d+(?:\.\d+)?'
    return re.sub(number, '#', said), [float(each) for each in re.findall(number, said)]


def test_the_example_of_a_diagnosis_still_says_what_the_pages_show(run, tmp_path, monkeypatch):
    page = (DOCS / 'tutorials/hidden_effect.md').read_text()
    monkeypatch.chdir(tmp_path)
    for name in ('gyro.yaml', 'real.yaml', 'profile.csv'):
        block = re.search(rf'`{name}`[^`]*?:\n\n((?:    .*\n)+)', page)[1]
        (tmp_path / name).write_text(block.replace('\n    ', '\n')[4:])
    simulate, diagnose, compensate = (
        next(shlex.split(each) for each in COMMAND.findall(page) if each.startswith(start))
        for start in ('simulate', 'diagnose drive.csv --model gyro.yaml', 'compensate'))
    assert run(*simulate)[0] == 0
    code, text, _ = run(*diagnose)
    assert code == 0
    words, numbers = headline(text)
    # To some part, for another numpy draws and rounds otherwise.
    assert headline(page) == (words, pytest.approx(numbers, rel=0.25)), text
    assert run(*compensate)[0] == 0


def test_the_quickstarts_run_as_written_and_give_the_numbers_that_are_shown(
        run, tmp_path, monkeypatch):
    for folder in ('samples', 'config'):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    page = (ROOT / 'README.md').read_text()
    answers = {}
    for command in COMMAND.findall(page.replace('\\\n', ' ')):
        code, answers[command.split()[0]], error = run(*shlex.split(command))
        assert code == 0, error
    log = read_log('heading.csv')
    true = log.reference_heading - log.reference_heading[0]
    after, before = (float(np.degrees(np.abs(each - true).mean())) for each in (
        np.array(log.others['heading_rad'], float), integrate(log.time, log.output)))
    shown = re.search(r'falls from ([\d.]+) to ([\d.]+) deg\.', page)
    assert [float(each) for each in shown.groups()] == pytest.approx([before, after], rel=0.1)
    found = re.search(r'Error ([\d.]+) deg/s rms before, .*; ([\d.]+) in sweeps', answers['fit'])
    shown = re.search(r'falls from ([\d.]+) to ([\d.]+) deg/s rms', page)
    assert [float(each) for each in shown.groups()] == pytest.approx(
        [float(each) for each in found.groups()], rel=0.05)
    words, numbers = headline((DOCS / 'tutorials/diagnosis.md').read_text())
    assert headline(answers['diagnose']) == (words, pytest.approx(numbers, rel=0.25))


def test_the_page_of_the_error_model_has_a_row_for_every_effect():
    text = (DOCS / 'reference/error_model.md').read_text()
    assert not [effect for effect in (*CATALOGUE, POLYNOMIAL) if f'\n| `{effect}` |' not in text]


@pytest.mark.parametrize('name', sorted(path.name for path in (DOCS / 'examples').glob('*.py')))
def test_an_example_runs_says_something_and_leaves_models_that_can_be_read(tmp_path, name):
    paths = [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])]
    result = subprocess.run([sys.executable, DOCS / 'examples' / name], cwd=tmp_path, text=True,
                            env=os.environ | {'PYTHONPATH': os.pathsep.join(paths)},
                            capture_output=True, timeout=300)
    assert result.returncode == 0 and not result.stderr, result.stderr
    assert result.stdout.strip()
    assert all(read_model(path).terms or read_model(path).self_calibration
               for path in tmp_path.glob('*.yaml'))
