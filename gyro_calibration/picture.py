"""Pictures for people: PNG or SVG, units on the axes, readable in black and white."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gyro_calibration.allan import AllanChart, NoiseFit
from gyro_calibration.log import DEGREE, Array

_STYLES = ('-', '--', '-.', ':')


def draw_headings(path: str | Path, time: Array, true: Array, headings: Mapping[str, Array]) -> None:
    """
    Draw headings against the truth, and their errors below (as figure 10 of Hong and Park).

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    time : s, shape (n,)
    true : rad, shape (n,)
    headings : by name, rad, shape (n,) each

    """
    import matplotlib  # not needed on a robot, and slow to load
    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, (above, below) = pyplot.subplots(2, sharex=True, figsize=(9, 7), layout='constrained', height_ratios=(1, 1.3))
    above.plot(time, true / DEGREE, color='black', linewidth=3, alpha=0.3, label='truth')
    for (name, heading), style in zip(headings.items(), _STYLES * len(headings)):
        above.plot(time, heading / DEGREE, style, linewidth=1)
        below.plot(time, (heading - true) / DEGREE, style, label=name)
    above.set(ylabel='heading [deg]', title='Heading of the robot by its gyro')
    above.legend(loc='upper right')
    below.axhline(0.0, color='black', linewidth=0.5)
    below.set(xlabel='time [s]', ylabel='heading error [deg]')
    below.legend(loc='best')
    for axes in (above, below):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def draw_allan(path: str | Path, chart: AllanChart, fit: NoiseFit, names: Mapping[str, str]) -> None:
    """
    Draw an Allan chart with its confidence, the parts of the noise and their sum (as figure 2 of Hong and Park).

    Parameters
    ----------
    path : the ending says which format, .png or .svg
    chart : Allan deviations
    fit : the noise figures in them
    names : of the parts that are seen, by symbol, such as 'angle random walk N = 2.3 deg/√h'

    """
    import matplotlib  # not needed on a robot, and slow to load
    matplotlib.use('Agg')
    from matplotlib import pyplot

    hour = 3600.0 / DEGREE
    figure, axes = pyplot.subplots(figsize=(9, 6.5), layout='constrained')
    axes.fill_between(chart.time, chart.lower * hour, chart.upper * hour, color='black', alpha=0.15, linewidth=0, label='95 % confidence')
    axes.loglog(chart.time, chart.deviation * hour, 'o', color='black', markersize=3.5, label='Allan deviation')
    times = np.geomspace(chart.time[0], chart.time[-1], 200)
    axes.loglog(times, fit.deviation(times) * hour, '-', color='black', linewidth=1, label='sum of the parts')
    lowest, highest = 0.4 * float(chart.lower.min()), 2.5 * float(chart.upper.max())
    for each, style in zip((each for each in fit.figures.values() if each.value), _PART_STYLES):
        line = each.value * np.sqrt(each.part.variance(times))
        shown = (line > lowest) & (line < highest)
        axes.loglog(times[shown], line[shown] * hour, linestyle=style, linewidth=1.2, color='0.25', label=names[each.part.symbol])
        _mark(axes, each.part.symbol, times[shown], line[shown] * hour)
    axes.set(xlabel='averaging time [s]', ylabel='Allan deviation [deg/h]', ylim=(lowest * hour, highest * hour),
             title='Allan deviation of the gyro at rest')
    axes.grid(which='both', alpha=0.2)
    axes.legend(loc='best')
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


#: Of the parts of the noise; a dot and dashes of other lengths tell them apart without colour.
_PART_STYLES = ('--', '-.', ':', (0, (8, 2)), (0, (3, 1, 1, 1, 1, 1)))


def _mark(axes: Any, symbol: str, times: Array, line: Array) -> None:
    """Write the symbol at the place where IEEE Std 952 reads the figure, or at the end of the line that comes nearest to it."""
    at = int(np.argmin(np.abs(np.log(times / {'N': 1.0, 'K': 3.0}.get(symbol, times[len(times) // 2])))))
    axes.annotate(symbol, (times[at], line[at]), xytext=(0, 6), textcoords='offset points', fontsize=13, weight='bold', ha='center')
