# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Pictures: units on every axis, and a line that says what to see."""

from dataclasses import replace
from functools import cache

from gyro_calibration.calibration.dwells import Dwells, select_dwells
from gyro_calibration.calibration.rate_table import compute_turn_errors, fit_effects, MIN_TURN_RATE
from gyro_calibration.cli.plots import (
    draw_headings, draw_residuals, draw_turn_errors)
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR, SINE_RESPONSE
import numpy as np
import pytest


def table():
    """Return six sweeps with a sine response at -10 to 40 degC and two outlying dwells."""
    generator = np.random.default_rng(1)
    rate = np.tile(np.concatenate([[0.0], np.arange(-100.0, 101.0, 20.0)]) * DEGREE, 6)
    temperature = np.repeat(np.linspace(-10.0, 40.0, 6), 12) + generator.normal(0.0, 0.3, 72)
    output = (np.sin(0.25 * rate) / 0.25 + (0.002 + 1e-4 * temperature) + 1e-4 * temperature * rate
              + generator.normal(0.0, 3e-4, 72))
    output[[20, 50]] += np.array([30.0, -3.0]) * DEGREE
    return Dwells(rate, output, temperature, np.full(72, np.nan), np.repeat(np.arange(6), 12),
                  tuple(map(str, range(72))))


MEASURED = table()


@cache
def warm():
    return fit_effects(MEASURED, (BIAS, SCALE_FACTOR_ERROR, SINE_RESPONSE,
                                  CATALOGUE['scale_factor_temperature']))


@cache
def without_temperature():
    return fit_effects(replace(MEASURED, temperature=None), (BIAS, SCALE_FACTOR_ERROR))


def draw_turns(path, fit):
    kept = fit.scatter.inliers
    return draw_turn_errors(path, compute_turn_errors(select_dwells(fit.dwells, kept),
                                                      fit.left_out_rate[kept]),
                            MIN_TURN_RATE)


def draw_drive(path):
    time = np.linspace(0.0, 10.0, 50)
    return draw_headings(path, time, np.sin(time), {'pure integration': np.sin(time) + 0.01 * time,
                                                    'compensated': np.sin(time) + 0.001 * time})


PICTURES = {
    'turns': lambda path: draw_turns(path, warm()),
    'turns without temperature': lambda path: draw_turns(path, without_temperature()),
    'residuals': lambda path: draw_residuals(path, warm()),
    'residuals without temperature': lambda path: draw_residuals(path, without_temperature()),
    'headings': draw_drive}


@pytest.fixture(scope='module')
def pyplot():
    pytest.importorskip('matplotlib', reason='matplotlib is not installed').use('Agg')
    from matplotlib import pyplot
    return pyplot


@pytest.mark.parametrize('draw', PICTURES.values(), ids=PICTURES)
def test_every_axis_has_a_unit_and_a_line_says_what_to_see(pyplot, tmp_path, draw):
    figure = draw(tmp_path / 'picture.png')
    assert figure.get_supxlabel().endswith('.')
    panels = [axes for axes in figure.axes if axes.get_label() != '<colorbar>']
    assert panels and all('[' in axes.get_ylabel() for axes in panels)
    assert all('[' in axes.get_xlabel()
               for axes in panels if axes.xaxis.get_tick_params()['labelbottom'])
    assert all('[' in (axes.get_xlabel() or axes.get_ylabel())
               for axes in figure.axes if axes.get_label() == '<colorbar>')


def test_a_picture_is_svg_where_its_name_says_so_and_does_not_stay_in_memory(pyplot, tmp_path):
    before = pyplot.get_fignums()
    draw_drive(tmp_path / 'picture.svg')
    text = (tmp_path / 'picture.svg').read_text()
    assert '<svg' in text and 'deg' in text and text.rstrip().endswith('</svg>')
    assert pyplot.get_fignums() == before
