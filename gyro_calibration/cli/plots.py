# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Pictures for people: PNG or SVG, units on the axes, readable in black and white."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gyro_calibration.allan import AllanChart, NoiseFit
from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import Calibration
from gyro_calibration.calibration.turn_error import TurnErrors
from gyro_calibration.files import replacing
from gyro_calibration.logs.log import Array, DEGREE, Mask
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

_STYLES = ('-', '--', '-.', ':', (0, (5, 1, 1, 1, 1, 1)))
#: Grey shades from light to dark; neither end vanishes on paper or in ink.
_GREYS = ('0.78', '0.0')


def draw_headings(path: str | Path, time: Array, true: Array,
                  headings: Mapping[str, Array]) -> None:
    """
    Draw headings against the truth, and their errors below (as figure 10 of Hong and Park).

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    time : s, shape (n,)
    true : rad, shape (n,)
    headings : by name, rad, shape (n,) each

    """
    figure, ((above,), (below,)) = _panels(2, 1, (9, 7), sharex=True, height_ratios=(1, 1.3))
    above.plot(time, true / DEGREE, color='black', linewidth=3, alpha=0.3, label='truth')
    for (name, heading), style in zip(headings.items(), _STYLES * len(headings)):
        above.plot(time, heading / DEGREE, linestyle=style, linewidth=1)
        below.plot(time, (heading - true) / DEGREE, linestyle=style, label=name)
    above.set(ylabel='heading [deg]', title='Heading of the robot by its gyro')
    above.legend(loc='upper right')
    below.axhline(0.0, color='black', linewidth=0.5)
    below.set(xlabel='time [s]', ylabel='heading error [deg]')
    below.legend(loc='best')
    for axes in (above, below):
        axes.grid(alpha=0.3)
    _save(figure, path)


def draw_allan(path: str | Path, chart: AllanChart, fit: NoiseFit,
               names: Mapping[str, str]) -> None:
    """
    Draw an Allan chart: deviation with confidence, parts of the noise and their sum.

    It is drawn as figure 2 of Hong and Park.

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    chart : Allan deviations
    fit : the noise figures in them
    names : of the parts that are seen, by symbol, such as 'angle random walk N = 2.3 deg/√h'

    """
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
    for each, style in zip((each for each in fit.figures.values() if each.value), _PART_STYLES):
        line = each.value * np.sqrt(each.part.variance(times))
        shown = (line > lowest) & (line < highest)
        axes.loglog(times[shown], line[shown] * hour, linestyle=style, linewidth=1.2,
                    color='0.25', label=names[each.part.symbol])
        _mark(axes, each.part.symbol, times[shown], line[shown] * hour)
    axes.set(xlabel='averaging time [s]', ylabel='Allan deviation [deg/h]',
             ylim=(lowest * hour, highest * hour), title='Allan deviation of the gyro at rest')
    axes.grid(which='both', alpha=0.2)
    axes.legend(loc='best')
    _save(figure, path)


#: Of the parts of the noise; a dot and dashes of other lengths tell them apart without colour.
_PART_STYLES = ('--', '-.', ':', (0, (8, 2)), (0, (3, 1, 1, 1, 1, 1)))


#: Where IEEE Std 952 reads angle random walk, s; the others are named along their line.
_READ_AT = 1.0


def _mark(axes: Any, symbol: str, times: Array, line: Array) -> None:
    at = (int(np.argmin(np.abs(times - _READ_AT))) if symbol == 'N'
          else len(times) * (1 if symbol in 'BQ' else 2) // 3)
    # below what rises, above what falls: away from the sum
    beside = (10, -14) if symbol in 'KR' else (0, 6)
    axes.annotate(symbol, (times[at], line[at]), xytext=beside, textcoords='offset points',
                  fontsize=13, weight='bold', ha='center')


# rate tables

def draw_error_surface(path: str | Path, model: GyroModel, rate_range: tuple[float, float],
                       temperature_range: tuple[float, float],
                       dwells: Dwells | None = None) -> None:
    """
    Draw the error that a model removes, over output and temperature (figure 6 of Ojeda et al.).

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    model : of the gyro
    rate_range : of the output, rad/s
    temperature_range : degC; where it is not finite, a single curve is drawn at the model's
        reference temperature
    dwells : those that were fitted, drawn as dots

    """
    output = np.linspace(*rate_range, 161)
    thermal = bool(np.isfinite(temperature_range).all()
                   and temperature_range[0] < temperature_range[1])
    figure, panels = _panels(1, 2 if thermal else 1, (11, 5) if thermal else (7, 5))
    if thermal:
        _draw_contours(panels[0, 0], model, output, np.linspace(*temperature_range, 81), dwells)
    temperatures = (np.linspace(*temperature_range, 4) if thermal
                    else np.array([model.reference_temperature]))
    axes = panels[0, -1]
    if dwells is not None:
        axes.plot(dwells.output / DEGREE, (dwells.output - dwells.rate) / DEGREE, '.',
                  color='0.6', markersize=3, label='measured')
    for temperature, style in zip(temperatures, _STYLES):
        error = output - model.rate(output, np.full(len(output), temperature))
        name = f'model at {temperature:.1f} °C' if thermal else 'model'
        axes.plot(output / DEGREE, error / DEGREE, linestyle=style, color='black', label=name)
    axes.set(xlabel='gyro output [deg/s]', ylabel='error: output less rate [deg/s]',
             title='Error over the output')
    axes.legend(loc='best')
    axes.grid(alpha=0.3)
    _save(figure, path)


def _draw_contours(axes: Any, model: GyroModel, output: Array, temperature: Array,
                   dwells: Dwells | None) -> None:
    across, up = np.meshgrid(output, temperature)
    error = (across - model.rate(across.ravel(), up.ravel()).reshape(across.shape)) / DEGREE
    levels = _levels(error)
    axes.contourf(across / DEGREE, up, error, levels=levels, cmap='Greys', alpha=0.45,
                  extend='both')
    lines = axes.contour(across / DEGREE, up, error, levels=levels, colors='black', linewidths=0.8)
    if dwells is not None and dwells.temperature is not None:
        axes.plot(dwells.output / DEGREE, dwells.temperature, '.', color='0.35', markersize=2)
    for text in axes.clabel(lines, fontsize=9, manual=_label_places(lines.allsegs)):
        text.set_bbox({'facecolor': 'white', 'edgecolor': 'none', 'pad': 0.8, 'alpha': 0.85})
    axes.set(xlabel='gyro output [deg/s]', ylabel='temperature [°C]',
             title='Error of the model [deg/s]; dots: dwells' if dwells is not None
             else 'Error of the model [deg/s]')


def _levels(error: Array) -> Array:
    """Return about ten round levels."""
    from matplotlib.ticker import MaxNLocator
    low, high = float(error.min()), float(error.max())
    return np.asarray(MaxNLocator(10, steps=[1, 2, 5, 10]).tick_values(
        low, high if high > low else low + 1e-6))


def _label_places(levels: Sequence[Sequence[Array]]) -> list[tuple[float, float]]:
    """Return a place on each contour line, away from its ends and from those of its neighbours."""
    places = []
    for number, lines in enumerate(levels):
        part = (0.35, 0.5, 0.65)[number % 3]
        places += [tuple(line[round(part * (len(line) - 1))].tolist())
                   for line in lines if len(line) > 10]
    return places


def draw_residuals(path: str | Path, calibration: Calibration) -> None:
    """
    Draw the errors of dwells before and after a model, by rate and by temperature.

    They are drawn as figures 5 and 7 of Ojeda et al.

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    calibration : with the dwells, what the model leaves of their errors, and which are outlying

    """
    dwells, kept = calibration.dwells, calibration.scatter.kept
    rate = dwells.rate / DEGREE
    columns = [(rate, 'rate [deg/s]', dwells.temperature, 'temperature [°C]')]
    if dwells.temperature is not None:
        columns.append((dwells.temperature, 'temperature [°C]', rate, 'rate [deg/s]'))
    rows = [(dwells.output - dwells.rate, 'output less rate [deg/s]', 'Before', ''),
            (calibration.residual, 'residual [deg/s]', 'After',
             f', left-out sweeps {_rms(calibration.left_out[kept]):.3g} deg/s')]
    figure, panels = _panels(2, len(columns), (5.5 * len(columns) + 0.5, 8))
    for column, (across, label, shade, shade_label) in enumerate(columns):
        for row, (error, name, when, more) in enumerate(rows):
            axes = panels[row, column]
            dots = _draw_errors(axes, across, error / DEGREE, kept, shade)
            axes.set(xlabel=label, ylabel=name,
                     title=f'{when}: rms {_rms(error[kept]):.3g} deg/s' + more)
        if shade is not None:
            figure.colorbar(dots, ax=panels[:, column], label=shade_label, location='bottom',
                            aspect=40, shrink=0.9)
    _save(figure, path)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values ** 2))) / DEGREE


def _draw_errors(axes: Any, across: Array, error: Array, kept: Mask, shade: Array | None) -> Any:
    """Draw errors as shaded dots, on the scale of those kept; others beyond it at the edge."""
    dots = _draw_dots(axes, across[kept], error[kept], None if shade is None else shade[kept])
    low, high = float(error[kept].min()), float(error[kept].max())
    margin = 0.12 * (high - low) or 1e-3
    axes.set_ylim(low - margin, high + margin)
    if not kept.all():
        shown = np.clip(error[~kept], low - 0.6 * margin, high + 0.6 * margin)
        beyond = ', at the edge: beyond it' if (shown != error[~kept]).any() else ''
        axes.plot(across[~kept], shown, 'x', color='black', markersize=8,
                  label=f'{len(shown)} outlying{beyond}')
        axes.legend(loc='best')
    axes.axhline(0.0, color='black', linewidth=0.5)
    axes.grid(alpha=0.3)
    return dots


def draw_turn_errors(path: str | Path, errors: TurnErrors, slowest: float) -> None:
    """
    Draw the errors of full turns with a static bias only and with the model.

    Each has its own scale (figures 8 and 9 of Ojeda et al.).

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    errors : of turns
    slowest : of the turns, rad/s

    """
    figure, panels = _panels(2, 1, (8.5, 8))
    temperature = errors.temperature
    for axes, error, words in zip(panels[:, 0], (errors.static, errors.modelled),
                                  ('static bias only', 'the model and its static bias')):
        dots = _draw_dots(axes, errors.rate / DEGREE, error / DEGREE, temperature)
        limit = 1.15 * float(np.abs(error).max()) / DEGREE or 1e-3
        axes.axvspan(-slowest / DEGREE, slowest / DEGREE, facecolor='none', edgecolor='0.7',
                     hatch='///', linewidth=0)
        axes.axhline(0.0, color='black', linewidth=0.5)
        axes.set(xlabel='rate [deg/s]', ylabel='error [deg per turn]', ylim=(-limit, limit),
                 title=f'Error of a turn of 360 deg with {words}: '
                 f'largest {np.abs(error).max() / DEGREE:.3g} deg')
        percent = axes.secondary_yaxis('right', functions=(lambda degrees: degrees / 3.6,
                                                           lambda percents: percents * 3.6))
        percent.set_ylabel('error [% of a turn]')
        axes.grid(alpha=0.3)
    figure.supxlabel(f'hatched: slower than {slowest / DEGREE:g} deg/s, left out', fontsize=9)
    if temperature is not None:
        figure.colorbar(dots, ax=panels[:, 0], label='temperature [°C]', aspect=40, pad=0.02)
    _save(figure, path)


def _panels(rows: int, columns: int, inches: tuple[float, float], **how: Any) -> tuple[Any, Any]:
    """Return a figure and its panels, shape (rows, columns)."""
    import matplotlib  # not needed on a robot, and slow to load
    matplotlib.use('Agg')
    from matplotlib import pyplot
    return pyplot.subplots(rows, columns, figsize=inches, layout='constrained', squeeze=False,
                           **how)


def _draw_dots(axes: Any, across: Array, up: Array, shade: Array | None) -> Any:
    """Draw dots, each in the shade of grey that a quantity gives it."""
    from matplotlib.colors import LinearSegmentedColormap
    shades = {'color': 'black'} if shade is None else {
        'c': shade, 'cmap': LinearSegmentedColormap.from_list('greys', _GREYS)}
    return axes.scatter(across, up, s=9, linewidths=0, **shades)


def _save(figure: Any, path: str | Path) -> None:
    from matplotlib import pyplot
    with replacing(path) as file:
        figure.savefig(file, dpi=110, format=Path(path).suffix[1:])
    pyplot.close(figure)
