"""Pictures for people: PNG or SVG, units on the axes, readable in black and white."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

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
