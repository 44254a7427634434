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
Elements of a page, and charts in it: SVG drawn by matplotlib, each with the table of its values.

All text in an element is escaped, so that no text can become an element. Without matplotlib, the
tables of values are there alone.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
from io import StringIO
import math
import re
from typing import Any
import warnings

from gyro_calibration.diagnosis.words import format_number
from gyro_calibration.files import to_printable
from gyro_calibration.logs.log import Array, Mask, NORMAL_QUANTILE_975
import numpy as np


class Markup(str):
    """Text that is HTML already."""


def element(name: str, *children: str | None, **attributes: str | None) -> Markup:
    """
    Return an element.

    Parameters
    ----------
    name : of its tag
    children : elements, or texts, which are escaped; None is left out
    attributes : with _ for -, and one at the end to avoid a word of Python; None is left out

    """
    given = ''.join(f' {key.rstrip("_").replace("_", "-")}="{_escaped(value)}"'
                    for key, value in attributes.items() if value is not None)
    return Markup(f'<{name}{given}>{join_markup(*children)}</{name}>')


def join_markup(*parts: str | None) -> Markup:
    """Return parts one after the other, texts escaped."""
    return Markup(''.join(part if isinstance(part, Markup) else _escaped(part)
                          for part in parts if part is not None))


def _escaped(text: str) -> str:
    return escape(to_printable(text, '\n'))


@dataclass(frozen=True)
class Line:
    """
    One line of a chart.

    Attributes
    ----------
    name : for legend and table
    style : measured, simulated, before or after: colour and stroke
    values : shape (n,), nan where missing
    deviation : of the values, drawn as a band or as bars of 95 %; None where it is not known
    draw_dots : draw dots instead of a line

    """

    name: str
    style: str
    values: Array
    deviation: Array | None = None
    draw_dots: bool = False


@dataclass(frozen=True)
class Chart:
    """
    A chart, in displayed units.

    Attributes
    ----------
    name : of the chart, unique on the page
    title, description : for people, also for screen readers
    x_label, x_unit, x : label, unit and values of the horizontal axis, shape (n,)
    y_label, y_unit, lines : label, unit and lines of the vertical axis
    is_logarithmic : both axes
    x_names : of the horizontal values, if they are numbered from 1 on

    """

    name: str
    title: str
    description: str
    x_label: str
    x_unit: str
    x: Array
    y_label: str
    y_unit: str
    lines: Sequence[Line]
    is_logarithmic: bool = False
    x_names: Sequence[str] = ()


#: Colour in the light theme, its name in the style of the page, and stroke of a style.
_STYLES: dict[str, tuple[str, str, Any]] = {
    'measured': ('#1d2327', 'measured', '-'), 'simulated': ('#59636b', 'simulated', (0, (6, 4))),
    'before': ('#b4480f', 'before', (0, (8, 2))), 'after': ('#0a6c85', 'after', '-'),
    'text': ('#59636a', 'quiet', '-'), 'grid': ('#e9e6df', 'grid', '-')}


def draw_chart(chart: Chart) -> Markup:
    """Return a chart with the table of its values."""
    known = [np.isfinite(chart.x) & np.isfinite(line.values) for line in chart.lines]
    if chart.is_logarithmic:
        known = [each & (chart.x > 0.0) & (line.values > 0.0)
                 for each, line in zip(known, chart.lines)]
    if not any(each.any() for each in known):
        return element('p', f'{chart.title}: there is nothing to draw.', class_='quiet')
    picture = (_draw_svg(chart, known) if find_spec('matplotlib')
               else element('p', 'matplotlib is not installed: no picture', class_='quiet'))
    return element('figure', element('figcaption', chart.title), picture,
                   element('p', chart.description, class_='quiet'), _value_table(chart))


def _draw_svg(chart: Chart, known: Sequence[Mask]) -> Markup:
    """Return the picture, in the colours of the page."""
    import matplotlib  # not needed without a page, and slow to load
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator
    text, grid = _STYLES['text'][0], _STYLES['grid'][0]
    style: dict[Any, Any] = {
        'svg.fonttype': 'none', 'svg.hashsalt': chart.name, 'font.size': 11,
        'font.family': 'sans-serif', 'font.sans-serif': ['DejaVu Sans'], 'text.color': text,
        'axes.edgecolor': grid, 'axes.labelcolor': text, 'grid.color': grid,
        'xtick.color': text, 'ytick.color': text, 'legend.frameon': False}
    file = StringIO()
    with matplotlib.rc_context(style), warnings.catch_warnings():
        warnings.simplefilter('ignore')  # of letters that the font lacks
        # small, so that letters are readable on a phone
        figure = Figure(figsize=(5.0, 3.4), layout='constrained', facecolor='none')
        axes = figure.add_subplot(facecolor='none', xmargin=0.0,
                                  xlabel=_plain(_with_unit(chart.x_label, chart.x_unit)),
                                  ylabel=_plain(_with_unit(chart.y_label, chart.y_unit)))
        axes.grid(True)
        if chart.is_logarithmic:
            axes.set(xscale='log', yscale='log')
        else:
            axes.axhline(0.0, color=text, linewidth=0.8)
            axes.ticklabel_format(axis='y', useOffset=False)
        for line, shown in zip(chart.lines, known):
            _draw_line(axes, line, np.where(shown, chart.x, np.nan))
        if chart.x_names:
            apart = math.ceil(sum(map(len, chart.x_names)) / 30) or 1
            axes.set_xticks(range(1, len(chart.x_names) + 1, apart))
            axes.set_xticklabels([_plain(name) for name in chart.x_names[::apart]])
            axes.set_xlim(0.5, len(chart.x_names) + 0.5)
        elif chart.x_unit == 'deg':
            axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.8, 3, 4.5, 9, 10]))
        axes.legend(loc='lower center', bbox_to_anchor=(0.5, 1.0), ncol=2)
        figure.savefig(file, format='svg', metadata=dict.fromkeys(
            ('Creator', 'Date', 'Format', 'Type')))
    # of the names, which other charts have too, only markers and clipping paths are used
    svg = re.sub(r' id="(?![mp][0-9a-f]{10}")[^"]+"', '', file.getvalue().partition('<svg ')[2])
    for colour, name, _ in _STYLES.values():
        svg = svg.replace(colour, f'var(--{name})')
    size = re.search(r'viewBox="[^"]+"', svg)
    assert size is not None
    label = _escaped(f'{chart.title}. {chart.description}')
    return Markup(f'<svg {size[0]} role="img" aria-label="{label}" '
                  f'xmlns:xlink="http://www.w3.org/1999/xlink"{svg[svg.index(">"):].rstrip()}')


def _draw_line(axes: Any, line: Line, x: Array) -> None:
    """Draw a line, which breaks where there is no value, or dots, with their intervals."""
    colour, _, stroke = _STYLES[line.style]
    name = _plain(line.name) + ('' if line.deviation is None else ', 95 %')
    half = (None if line.deviation is None
            else NORMAL_QUANTILE_975 * np.nan_to_num(line.deviation))
    if line.draw_dots:
        axes.errorbar(x, line.values, half, fmt='o', color=colour, markersize=4, elinewidth=1,
                      label=name)
        return
    axes.plot(x, line.values, color=colour, linestyle=stroke, linewidth=1.5, label=name)
    if half is not None:
        axes.fill_between(x, line.values - half, line.values + half, color=colour, alpha=0.18,
                          linewidth=0)


def _plain(text: str) -> str:
    """Return a text that matplotlib does not take for a formula."""
    return to_printable(text).replace('$', r'\$')


def _with_unit(name: str, unit: str) -> str:
    return f'{name} [{unit}]' if unit else name


def _value_table(chart: Chart) -> Markup:
    def value(line: Line, row: int) -> str:
        """Return a value with the half of its interval."""
        if not math.isfinite(line.values[row]):
            return '–'
        text = format_number(float(line.values[row]))
        if line.deviation is None:
            return text
        return f'{text} ± {format_number(NORMAL_QUANTILE_975 * float(line.deviation[row]), 2)}'

    heads = [(chart.x_label, chart.x_unit), *((each.name, chart.y_unit) for each in chart.lines)]
    titles = (element('th', _with_unit(*head), scope='col') for head in heads)
    labels = [chart.x_names[round(at) - 1] if chart.x_names else format_number(at, 4)
              for at in chart.x.tolist()]
    rows = (element('tr', element('td', label),
                    *(element('td', value(line, row)) for line in chart.lines))
            for row, label in enumerate(labels))
    table = element('table', element('caption', f'{chart.title}, {chart.y_label}'),
                    element('thead', element('tr', *titles)), element('tbody', *rows))
    return element('details', element('summary', 'Values'),
                   element('div', table, class_='scroll', tabindex='0'))
