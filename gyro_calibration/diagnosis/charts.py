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
Charts as SVG in a page, with the table of their values that the script of the page shows.

All text in an element is escaped, so that no text can become an element.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
import math

from gyro_calibration.diagnosis.words import format_number, sanitize_text, superscript
from gyro_calibration.logs.log import Array, Mask, NORMAL_QUANTILE_975
import numpy as np

_VOID_ELEMENTS = {'path', 'line', 'circle', 'rect', 'meta', 'br'}


class Markup(str):
    """Text that is HTML already."""


def element(name: str, *children: str | None, **attributes: str | float | None) -> Markup:
    """
    Return an element.

    Parameters
    ----------
    name : of its tag
    children : elements, or texts, which are escaped; None is left out
    attributes : with _ for -, and one at the end to avoid a word of Python; None is left out

    """
    given = {key.rstrip('_').replace('_', '-'): value if isinstance(value, str)
             else f'{value:.2f}'.rstrip('0').rstrip('.')
             for key, value in attributes.items() if value is not None}
    named = ''.join(f' {key}="{_escaped(value)}"' for key, value in given.items())
    inside = ''.join(child if isinstance(child, Markup) else _escaped(child)
                     for child in children if child is not None)
    return Markup(f'<{name}{named}/>' if name in _VOID_ELEMENTS
                  else f'<{name}{named}>{inside}</{name}>')


def join_markup(*parts: str) -> Markup:
    """Return parts one after the other, texts escaped."""
    return Markup(''.join(part if isinstance(part, Markup) else _escaped(part) for part in parts))


def _escaped(text: str) -> str:
    return escape('\n'.join(sanitize_text(line) for line in text.split('\n')))


#: Size of the drawing and of the plot in it: small, so that letters are readable on a phone.
_WIDTH, _HEIGHT = 360.0, 236.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 344.0, 24.0, 196.0
#: Number of letters that fit side by side below an axis.
_MAX_LABEL_LETTERS = 30


@dataclass(frozen=True)
class Line:
    """
    One line of a chart.

    Attributes
    ----------
    name : for legend and table
    style : measured, simulated, before or after; the page defines colour and stroke for each
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
    name : of the chart, unique on the page, for links inside it
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


@dataclass(frozen=True)
class _Axis:
    """From values to places in the drawing."""

    low: float
    high: float
    low_position: float
    high_position: float
    is_logarithmic: bool = False
    unit: str = ''

    def to_positions(self, values: Array) -> Array:
        """Return places in the drawing."""
        with np.errstate(divide='ignore', invalid='ignore'):
            scaled, low, high = (np.log10(each) if self.is_logarithmic else each
                                 for each in (values, self.low, self.high))
        return np.asarray(self.low_position + (scaled - low) / (high - low)
                          * (self.high_position - self.low_position))

    def ticks(self, count: int) -> list[tuple[float, str]]:
        """Return about so many values with their labels: round, of degrees parts of a turn."""
        if self.is_logarithmic:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            every = max(1, math.ceil((len(powers) - 2) / count))
            ticks = [(part * 10.0 ** power, f'{part * 10.0 ** power:g}' if -4 < power < 5
                      else f'{"" if part == 1 else f"{part} × "}10{superscript(power)}')
                     for power in powers if power % every == 0
                     for part in ((1, 2, 5) if len(powers) < 4 else (1,))]
            return [tick for tick in ticks if self.low <= tick[0] <= self.high]
        least = (self.high - self.low) / count
        power = 10.0 ** math.floor(math.log10(least))
        steps = ((30.0, 45.0, 90.0, 180.0, 360.0) if self.unit == 'deg' and 20.0 < least <= 360.0
                 else (power, 2.0 * power, 5.0 * power, 10.0 * power))
        step = next(step for step in steps if step >= least * (1.0 - 1e-9))
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        values = step * np.arange(math.ceil(self.low / step - 1e-9),
                                  math.floor(self.high / step + 1e-9) + 1)
        return [(float(value), f'{value + 0.0:.{decimals}f}'.replace('-', '−'))
                for value in values]


def draw_chart(chart: Chart) -> Markup:
    """Return a chart with its legend, its table of values, and a cursor for the values."""
    shown = [_drawable_points(chart, line) for line in chart.lines]
    if not any(each.any() for each in shown):
        return element('p', f'{chart.title}: there is nothing to draw.', class_='quiet')
    names = (_axis_label(chart.x_label, chart.x_unit), _axis_label(chart.y_label, chart.y_unit))
    across, up = _make_axes(chart, shown)
    at, marks, dots = across.to_positions(chart.x), [], []
    for line, known in zip(chart.lines, shown):
        places = up.to_positions(line.values)
        marks.append(_draw_line(line, at, places, up, known))
        # the script moves these to the values pointed at; they are hidden without it
        dots.append(element('circle', r=4.5, class_=line.style,
                            data_up=_format_positions(np.where(known, places, np.nan))))
    picture = element('svg', element('title', chart.title, id=f'{chart.name}-title'),
                      element('desc', chart.description, id=f'{chart.name}-description'),
                      *_grid_elements(chart, names, across, up), *marks,
                      element('g', element('line', y1=_TOP, y2=_BOTTOM), *dots, class_='cursor'),
                      viewBox=f'0 0 {_WIDTH:g} {_HEIGHT:g}', role='img', tabindex='0',
                      aria_labelledby=f'{chart.name}-title {chart.name}-description',
                      data_at=_format_positions(at))
    return element('figure', element('figcaption', chart.title), picture,
                   element('ul', *map(_legend_entry, chart.lines), class_='legend'),
                   element('p', chart.description, class_='readout', aria_live='polite'),
                   _value_table(chart), class_='chart')


def _drawable_points(chart: Chart, line: Line) -> Mask:
    known = np.isfinite(chart.x) & np.isfinite(line.values)
    return known & (chart.x > 0.0) & (line.values > 0.0) if chart.is_logarithmic else known


def _make_axes(chart: Chart, shown: Sequence[Mask]) -> tuple[_Axis, _Axis]:
    """Return the axes; linear ones include zero vertically."""
    at, ends = [], [] if chart.is_logarithmic else [np.zeros(1)]
    for line, known in zip(chart.lines, shown):
        deviation = (0.0 if line.deviation is None or chart.is_logarithmic
                     else NORMAL_QUANTILE_975 * np.nan_to_num(line.deviation))
        at.append(chart.x[known])
        ends += [(line.values - deviation)[known], (line.values + deviation)[known]]
    across = np.array([0.5, len(chart.x_names) + 0.5]) if chart.x_names else np.concatenate(at)
    return (_Axis(*_padded_range(across, chart.is_logarithmic, 0.0), _LEFT, _RIGHT,
                  chart.is_logarithmic, chart.x_unit),
            _Axis(*_padded_range(np.concatenate(ends), chart.is_logarithmic, 0.06), _BOTTOM, _TOP,
                  chart.is_logarithmic, chart.y_unit))


def _padded_range(values: Array, logarithmic: bool, margin: float) -> tuple[float, float]:
    """Return the ends of an axis, a little beyond the values."""
    low, high = float(values.min()), float(values.max())
    if logarithmic:
        return low / 1.3, high * 1.3
    if high <= low:
        return low - (abs(low) or 1.0), high + (abs(high) or 1.0)
    return low - margin * (high - low), high + margin * (high - low)


def _format_positions(values: Array) -> str:
    return ' '.join(f'{value:.1f}' if math.isfinite(value) else '-' for value in values)


def _grid_elements(chart: Chart, names: tuple[str, str], across: _Axis,
                   up: _Axis) -> Iterator[Markup]:
    apart = math.ceil(sum(map(len, chart.x_names)) / _MAX_LABEL_LETTERS) or 1
    named = [(float(place), text) for place, text in enumerate(chart.x_names, 1)][::apart]
    for value, label in named or across.ticks(6):
        x = float(across.to_positions(np.array(value)))
        yield element('line', x1=x, x2=x, y1=_TOP, y2=_BOTTOM, class_='grid')
        yield element('text', label, x=x, y=_BOTTOM + 15.0, text_anchor='middle')
    for value, label in up.ticks(5):
        y = float(up.to_positions(np.array(value)))
        yield element('line', x1=_LEFT, x2=_RIGHT, y1=y, y2=y,
                      class_='zero' if value == 0.0 else 'grid')
        yield element('text', label, x=_LEFT - 5.0, y=y + 4.0, text_anchor='end')
    yield element('text', names[0], x=0.5 * (_LEFT + _RIGHT), y=_HEIGHT - 6.0,
                  text_anchor='middle', class_='label')
    yield element('text', names[1], x=4.0, y=13.0, class_='label')


def _axis_label(name: str, unit: str) -> str:
    return f'{name} [{unit}]' if unit else name


def _draw_line(line: Line, at: Array, places: Array, up: _Axis, shown: Mask) -> Markup:
    """Return a line that breaks where there is no value, or dots, with what they deviate by."""
    x, y = at[shown], places[shown]
    parts = []
    if line.deviation is not None:
        half = NORMAL_QUANTILE_975 * np.nan_to_num(line.deviation)
        above, below = (up.to_positions(line.values + side)[shown] for side in (half, -half))
        if line.draw_dots:
            path = ''.join(f'M{each:.1f} {a:.1f}V{b:.1f}' for each, a, b in zip(x, above, below))
            parts.append(element('path', d=path, class_='bars'))
        else:
            corners = [*zip(x, above), *zip(x[::-1], below[::-1])]
            path = 'L'.join(f'{each:.1f} {value:.1f}' for each, value in corners)
            parts.append(element('path', d=f'M{path}Z', class_='band'))
    if line.draw_dots:
        parts += [element('circle', cx=float(each), cy=float(value), r=2.6)
                  for each, value in zip(x, y)]
    else:
        begins = (shown & ~np.concatenate([[False], shown[:-1]]))[shown]
        path = ''.join(f'{"M" if begin else "L"}{each:.1f} {value:.1f}'
                       for each, value, begin in zip(x, y, begins))
        parts.append(element('path', d=path, class_='stroke'))
    return element('g', *parts, class_=line.style)


def _legend_entry(line: Line) -> Markup:
    mark = (element('circle', cx=12.0, cy=6.0, r=3.0) if line.draw_dots
            else element('path', d='M1 6H23', class_='stroke'))
    spread = ([] if line.deviation is None
              else [element('path', d='M12 0V12', class_='bars') if line.draw_dots
                    else element('rect', x=1.0, y=1.0, width=22.0, height=10.0, class_='band')])
    swatch = element('svg', element('g', *spread, mark, class_=line.style),
                     viewBox='0 0 24 12', class_='swatch', aria_hidden='true')
    return element('li', swatch, line.name + ('' if line.deviation is None else ', 95 %'))


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
    titles = (element('th', _axis_label(name, unit), scope='col', data_name=name, data_unit=unit)
              for name, unit in heads)
    labels = [chart.x_names[round(at) - 1] if chart.x_names else format_number(at, 4)
              for at in chart.x.tolist()]
    rows = (element('tr', element('td', label),
                    *(element('td', value(line, row)) for line in chart.lines))
            for row, label in enumerate(labels))
    table = element('table', element('caption', join_markup(chart.title, ', ', chart.y_label)),
                    element('thead', element('tr', *titles)), element('tbody', *rows))
    return element('details', element('summary', 'Values'),
                   element('div', table, class_='scroll', tabindex='0'))
