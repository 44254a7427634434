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
Pictures: PNG or SVG, units on the axes, readable in black and white.

Each function returns its figure, and writes it where a path is given. Arrays are in SI, of shape
(n,).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import itertools
import math
from pathlib import Path
from textwrap import fill
from typing import Any, TYPE_CHECKING

from gyro_calibration.allan.deviation import AllanChart
from gyro_calibration.allan.noise_fit import NoiseFit
from gyro_calibration.calibration.rate_table import Calibration, TurnErrors
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.files import open_replacement
from gyro_calibration.logs.log import Array, DEGREE
import numpy as np

if TYPE_CHECKING:
    from gyro_calibration.diagnosis.findings import Diagnosis

#: Lines that are distinguished without colour; further ones are thinner.
_LINE_STYLES = ('-', '--', '-.', ':')


def draw_headings(path: str | Path | None, time: Array, true: Array,
                  headings: Mapping[str, Array], name: str = 'reference') -> Any:
    """Draw headings, rad, and their errors against a reference (figure 10 of Hong and Park)."""
    count = len(headings)
    figure, panels = _panels(1 + count, 1, (9, 5 + 2 * count), (1.3, *[1.7 / count] * count))
    above, *below = panels[:, 0]
    above.plot(time, true / DEGREE, color='black', linewidth=3, alpha=0.3, label=name)
    for number, (label, heading) in enumerate(headings.items()):
        repeats, style = divmod(number, len(_LINE_STYLES))
        line = {'linestyle': _LINE_STYLES[style], 'linewidth': 1.5 / (1 + 2 * repeats),
                'color': f'C{number}'}
        above.plot(time, heading / DEGREE, **line, label=label)
        below[number].plot(time, (heading - true) / DEGREE, **line)
        size = rms(heading - true) / DEGREE
        below[number].set_title(f'Gyro {label}, less the {name}: rms {size:.3g} deg')
    above.set(ylabel='heading [deg]', title=f'Heading by the {name} and by the gyro')
    above.legend(loc='best')
    for axes in below:
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set_ylabel('difference [deg]')
    axes.set_xlabel('time [s]')
    return _save_figure(figure, path, 'A slope of a difference is bias; what follows the turns is '
                        'scale factor error; an even band is the resolution of the reference.')


def draw_allan(path: str | Path | None, chart: AllanChart, fit: NoiseFit,
               names: Mapping[str, str]) -> Any:
    """Draw an Allan chart with the parts of the noise, named by symbol (Hong and Park, fig. 2)."""
    hour = 3600.0 / DEGREE
    figure, ((axes,),) = _panels(1, 1, (9, 6.5))
    axes.fill_between(chart.time, chart.lower * hour, chart.upper * hour, color='black',
                      alpha=0.15, linewidth=0, label='95 % confidence')
    axes.loglog(chart.time, chart.deviation * hour, 'o', color='black', markersize=3.5,
                label='Allan deviation')
    times = np.geomspace(chart.time[0], chart.time[-1], 200)
    axes.loglog(times, fit.deviation(times) * hour, '-', color='black', linewidth=1,
                label='sum of the parts')
    lowest, highest = 0.4 * float(chart.lower.min()), 2.5 * float(chart.upper.max())
    for each, style in zip((each for each in fit.figures.values() if each.value),
                           _LINE_STYLES[1:] + _LINE_STYLES):
        line = each.value * np.sqrt(each.term.allan_variance(times))
        shown = (line > lowest) & (line < highest)
        axes.loglog(times[shown], line[shown] * hour, linestyle=style, linewidth=1.2,
                    color='0.25', label=names[each.term.symbol])
    axes.set(xlabel='averaging time [s]', ylabel='Allan deviation [deg/h]',
             ylim=(lowest * hour, highest * hour), title='Allan deviation of the gyro at rest')
    axes.grid(which='both', alpha=0.2)
    axes.legend(loc='best')
    return _save_figure(figure, path, 'Slope -1/2: white noise, N at 1 s. Flat: flicker, at 0.664 '
                        'B. Slope +1/2: random walk of the bias.')


def draw_residuals(path: str | Path | None, calibration: Calibration) -> Any:
    """Draw the errors of dwells before and after a model (figures 5 and 7 of Ojeda et al.)."""
    dwells, kept = calibration.dwells, calibration.scatter.inliers
    rate = dwells.rate / DEGREE
    columns = [(rate, 'rate [deg/s]', dwells.temperature, 'temperature [°C]')]
    if dwells.temperature is not None:
        columns.append((dwells.temperature, 'temperature [°C]', rate, 'rate [deg/s]'))
    rows = [(dwells.output - dwells.rate, 'output less rate [deg/s]', 'Before', ''),
            (calibration.residual, 'residual [deg/s]', 'After',
             f', left-out sweeps {rms(calibration.left_out_residual[kept]) / DEGREE:.3g} deg/s')]
    figure, panels = _panels(2, len(columns), (5.5 * len(columns) + 0.5, 8))
    for column, (across, label, shade, shade_label) in enumerate(columns):
        for row, (error, name, when, more) in enumerate(rows):
            axes, inside, outlying = panels[row, column], error[kept] / DEGREE, error[~kept]
            dots = _draw_dots(axes, across[kept], inside, None if shade is None else shade[kept],
                              shade is rate)
            # the scale is that of those kept; others beyond it are at the edge
            low, high = float(inside.min()), float(inside.max())
            margin = 0.12 * (high - low) or 1e-3
            axes.set_ylim(low - margin, high + margin)
            if len(outlying):
                shown = np.clip(outlying / DEGREE, low - 0.6 * margin, high + 0.6 * margin)
                beyond = ', at the edge: beyond it' if (shown != outlying / DEGREE).any() else ''
                axes.plot(across[~kept], shown, 'x', color='black', markersize=8,
                          label=f'{len(shown)} outlying{beyond}')
                axes.legend(loc='best')
            axes.axhline(0.0, color='black', linewidth=0.5)
            axes.set(xlabel=label, ylabel=name,
                     title=f'{when}: rms {rms(error[kept]) / DEGREE:.3g} deg/s' + more)
        if shade is not None:
            figure.colorbar(dots, ax=panels[:, column], label=shade_label, location='bottom',
                            aspect=40, shrink=0.9)
    return _save_figure(figure, path, 'Below: dots without a shape are noise; a curve or a band '
                        'of one colour is an effect that the model lacks.')


def draw_turn_errors(path: str | Path | None, errors: TurnErrors, min_rate: float) -> Any:
    """Draw the errors of full turns with a static bias only and with the model."""
    # They are figures 8 and 9 of Ojeda et al.; turns slower than `min_rate`, rad/s, are left out.
    figure, panels = _panels(2, 1, (8.5, 8))
    temperature = errors.turns.temperature
    for axes, error, words in zip(panels[:, 0], (errors.static, errors.modelled),
                                  ('static bias only', 'the model and its static bias')):
        dots = _draw_dots(axes, errors.turns.rate / DEGREE, error / DEGREE, temperature)
        limit = 1.15 * float(np.abs(error).max()) / DEGREE or 1e-3
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set(xlabel='rate [deg/s]', ylabel='error [deg per turn]', ylim=(-limit, limit),
                 title=f'Error of a turn of 360 deg with {words}: '
                 f'largest {np.abs(error).max() / DEGREE:.3g} deg')
    if temperature is not None:
        figure.colorbar(dots, ax=panels[:, 0], label='temperature [°C]', aspect=40, pad=0.02)
    return _save_figure(figure, path, 'Colours: temperature. A step between the senses: scale '
                        'factor error; a curve: nonlinearity; growth towards slow turns: bias or '
                        f'noise. Turns below {min_rate / DEGREE:g} deg/s are left out.')


def draw_diagnosis(path: str | Path | None, diagnosis: Diagnosis) -> Any:
    """Draw the charts of a diagnosis, two in a row."""
    from gyro_calibration.diagnosis.report import draw_axes, main_charts  # only for this one
    charts = main_charts(diagnosis)
    rows = math.ceil(len(charts) / 2) or 1
    figure, panels = _panels(rows, 2, (10, 3.6 * rows))
    for axes, chart in itertools.zip_longest(panels.flat, charts):
        if chart is None:
            axes.remove()
        else:
            draw_axes(axes, chart)
    return _save_figure(figure, path, 'Measured less simulated output; bands are of noise alone, '
                        '95 %. Where a curve leaves its band, the model lacks something.')


def _panels(rows: int, columns: int, inches: tuple[float, float],
            heights: Sequence[float] | None = None) -> tuple[Any, Any]:
    """Return a figure and its panels, shape (rows, columns); with heights they share the time."""
    from matplotlib.figure import Figure  # not needed on a robot, and slow to load
    figure = Figure(figsize=inches, layout='constrained')
    panels = figure.subplots(rows, columns, squeeze=False, sharex=heights is not None,
                             gridspec_kw={'height_ratios': heights} if heights else None)
    for axes in panels.flat:
        axes.grid(alpha=0.3)
    return figure, panels


def _draw_dots(axes: Any, across: Array, up: Array, colour_values: Array | None,
               is_signed: bool = False) -> Any:
    """Draw dots, each in the colour that a quantity gives it; with a sign, white is zero."""
    if colour_values is None:
        return axes.scatter(across, up, s=9, linewidths=0, color='black')
    most = float(np.abs(colour_values).max()) if is_signed else None
    return axes.scatter(  # in colours that the colour-blind distinguish
        across, up, s=14, linewidths=0.3, edgecolors='0.3', c=colour_values,
        cmap='RdBu_r' if is_signed else 'cividis', vmin=most and -most, vmax=most)


def _save_figure(figure: Any, path: str | Path | None, caption: str) -> Any:
    # 13 letters of this size go into an inch
    figure.supxlabel(fill(caption, int(13 * figure.get_figwidth())), fontsize=9)
    if path is not None:
        with open_replacement(path) as file:
            figure.savefig(file, dpi=110, format=Path(path).suffix[1:])
    return figure
