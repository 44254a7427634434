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
A diagnosis as one page that needs nothing else: no network, no other files.

All text in an element is escaped, so that no text can become an element. Charts are SVG drawn by
matplotlib, each with the table of its values, which is there alone without matplotlib.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib.util import find_spec
from io import StringIO
import math
from pathlib import Path
import re
from string import Template
from typing import Any
import warnings

import gyro_calibration
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.diagnosis.findings import Curve, Diagnosis, Estimate
from gyro_calibration.diagnosis.words import (
    as_sentence, cause_paragraphs, cause_title, display_unit, format_amount, format_number,
    format_quantity, headline, is_model_extended, lists, noise_rows, readable_name, verdict_phrase)
from gyro_calibration.files import to_printable
from gyro_calibration.logs.log import Array, DEGREE, Mask, NORMAL_QUANTILE_975
from gyro_calibration.model.model_file import format_model
from gyro_calibration.model.noise import Noise
import numpy as np

#: Parts of a curve of which only the extremes are drawn.
_THINNED_PARTS = 90

_METHOD_TEXT = (
    '{logs} replayed through the simulation, with motion and temperature as recorded. The '
    'residual, measured less simulated output, was compared with every cause of the catalogue, '
    'under a grid of noises. Causes were added one at a time, the strongest first, each if noise '
    'alone is improbable: of logs without any cause, {share} give an alarm. Then they were '
    'confirmed on held-out stretches. Of causes that explain the data equally well the simplest '
    'is in the model. The gain was measured on held-out parts; intervals are of 95 %.')


def render_report(diagnosis: Diagnosis) -> str:
    """Return the page, HTML in UTF-8."""
    if not is_model_extended(diagnosis):
        diagnosis = _without_extension(diagnosis)
    logs = ', '.join(map(to_printable, diagnosis.logs))
    gyro = ' '.join(filter(None, (str(diagnosis.model.gyro.get(name, ''))
                                  for name in ('name', 'serial_number'))))
    what, gained = headline(diagnosis)
    header = element(
        'header',
        element('p', ' · '.join(filter(None, ['Diagnosis', gyro, logs])), class_='about'),
        element('h1', what), element('p', gained, class_='gained'),
        element('p', verdict_phrase(diagnosis), class_=f'verdict {diagnosis.verdict}'))
    sections = (element('section', element('h2', title), *parts)
                for title, content in _sections(diagnosis) if (parts := list(content)))
    return render_page(f'Diagnosis of {logs or "gyro"}',
                       join_markup(header, element('main', *sections)))


def render_page(title: str, body: Markup) -> str:
    """Return a page with this title and body, HTML in UTF-8."""
    template = Template(Path(__file__).with_name('report.html').read_text(encoding='utf-8'))
    return template.substitute(title=element('title', title), body=body)


def _without_extension(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis without curves after the extension."""
    heading, trace = (each and replace(each, after=each.before)
                      for each in (diagnosis.heading, diagnosis.trace))
    return replace(diagnosis, heading=heading, trace=trace,
                   curves=[replace(each, after=each.before) for each in diagnosis.curves])


def _divide_curves(diagnosis: Diagnosis) -> tuple[list[tuple[int, Curve]], ...]:
    """Return the numbered curves along variables of what is found, and the others."""
    along = [*(found.along for found in diagnosis.findings),
             *(each.along for each in diagnosis.unexplained)]
    curves = sorted((each for each in enumerate(diagnosis.curves) if each[1].along in along),
                    key=lambda each: along.index(each[1].along))
    return curves, [each for each in enumerate(diagnosis.curves) if each[1].along not in along]


def main_charts(diagnosis: Diagnosis) -> list[Chart]:
    """Return the residual along the variables of what is found, or along all, and the heading."""
    if not is_model_extended(diagnosis):
        diagnosis = _without_extension(diagnosis)
    curves, others = _divide_curves(diagnosis)
    return [*(_residual_chart(curve, place) for place, curve in curves or others),
            *([] if diagnosis.heading is None else [_heading_chart(diagnosis.heading)])]


def _sections(diagnosis: Diagnosis) -> Iterator[tuple[str, Iterable[Markup]]]:
    curves, others = _divide_curves(diagnosis)
    misfit: list[Markup] = []
    if diagnosis.trace is not None:
        misfit.append(_side_by_side(map(draw_chart, _trace_charts(diagnosis.trace))))
    for place, curve in curves or others:
        before, after = (format_amount(float(np.abs(each[np.isfinite(each)]).max(initial=0.0)),
                                       'rad/s') for each in (curve.before, curve.after))
        unchanged = np.array_equal(curve.before, curve.after, equal_nan=True)
        misfit += [element('p', f'Along {readable_name(curve.along)}, the error of the simulation '
                           f'is up to {before}' + ('.' if unchanged else ' before the extension, '
                                                   f'and up to {after} after it.')),
                   _side_by_side(map(draw_chart, [*_error_charts(curve, place),
                                                  _residual_chart(curve, place)]))]
    yield 'Simulation and measurement', misfit
    yield 'Causes', [element('article', element('h3', f'{place}. {cause_title(found)}'),
                             *(element('p', text) for text in cause_paragraphs(found, diagnosis)))
                     for place, found in enumerate(diagnosis.findings, 1)]
    parts = [] if diagnosis.heading is None else [draw_chart(_heading_chart(diagnosis.heading))]
    if (gain := diagnosis.gain) is None:
        yield 'Heading', [_side_by_side(parts)] if parts else []
    else:
        rows = []
        for what, change, unit in gain.rows():
            won = change.before - change.after
            rows.append([what, format_amount(change.before, unit),
                         format_amount(change.after, unit),
                         format_quantity(Estimate(won, change.interval or (won, won), unit))])
        yield 'Gain on held-out parts', [
            element('p', f'Measured on {to_printable(gain.held_out)}, which took no part in the '
                    'choice or the fit.'),
            _side_by_side([*parts, _table(
                ['rms', 'before', 'after', 'reduction, 95 % interval'], rows)])]
    if diagnosis.noise_curve is not None or diagnosis.noise != Noise():
        charts = ([] if diagnosis.noise_curve is None
                  else [draw_chart(_allan_chart(diagnosis.noise_curve))])
        yield 'Noise', [_side_by_side([
            *charts, _table(['', 'residual', 'simulation'], noise_rows(diagnosis))])]
    if curves and others:
        yield 'Along the other variables', [_side_by_side(
            draw_chart(_residual_chart(curve, place)) for place, curve in others)]
    for title, texts in lists(diagnosis):
        yield title, [element('ul', *(element('li', text) for text in texts))]
    yield 'The model', [
        element('p', 'This is the extended model, as model.yaml has it; compensate, simulate and '
                'the compensation node take it as it is.' if is_model_extended(diagnosis)
                else 'The model is unchanged.'),
        element('pre', element('code', format_model(diagnosis.model)), tabindex='0',
                class_='scroll')]
    logs = f'{len(diagnosis.logs)} logs were' if len(diagnosis.logs) > 1 else 'The log was'
    method = _METHOD_TEXT.format(logs=logs, share=f'{100.0 * FALSE_ALARM_RATE:.2g} %')
    yield 'How this was computed', [
        element('p', as_sentence(diagnosis.method) or method),
        element('p', f'gyro_calibration {gyro_calibration.__version__}', class_='quiet')]


def _side_by_side(figures: Iterable[Markup]) -> Markup:
    return element('div', *figures, class_='pairs')


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """Return a table whose rows become lists on a narrow screen."""
    body = (element('tr', element('th', row[0], scope='row'), *(
        element('td', cell, data_head=head) for head, cell in zip(heads[1:], row[1:])))
        for row in rows)
    columns = (element('th', head, scope='col') for head in heads)
    table = element('table', element('thead', element('tr', *columns)), element('tbody', *body))
    return element('div', table, class_='fold')


# charts

def _trace_charts(trace: Curve) -> Iterator[Chart]:
    time, before, after, simulated = _thin_points(
        trace.at, trace.before, trace.after, np.asarray(trace.simulated))
    measured = simulated + before
    unit, factor = _rate_unit(measured)
    lines = [Line('measured', 'measured', factor * measured),
             Line('simulated', 'simulated', factor * simulated)]
    yield Chart('trace', 'Output of the gyro', 'Measured and simulated output over time.', 'time',
                's', time, 'output', unit, lines)
    unit, factor = _rate_unit(before)
    yield Chart('difference', 'Measured less simulated', 'Residual over time.',
                'time', 's', time, 'residual', unit,
                _before_and_after(factor * before, factor * after))


def _before_and_after(before: Array, after: Array, deviation: Array | None = None) -> list[Line]:
    """Return a line for each, or a single one where nothing was changed."""
    if np.array_equal(before, after, equal_nan=True):
        return [Line('residual', 'before', before, deviation)]
    return [Line('before', 'before', before, deviation), Line('after', 'after', after, deviation)]


def _rate_unit(values: Array) -> tuple[str, float]:
    """Return the unit in which people read rates up to these, and the factor to it."""
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    return display_unit('rad/s', 'bias_instability' if 0.0 < largest < 2e-3 * DEGREE else '')


def _time_unit(time: Array) -> tuple[str, float]:
    """Return the unit in which people read times of a log, and the factor to it."""
    duration = float(np.ptp(time)) if len(time) else 0.0
    return (('s', 1.0) if duration <= 600.0 else ('min', 1.0 / 60.0) if duration <= 14400.0
            else ('h', 1.0 / 3600.0))


def _error_charts(curve: Curve, place: int) -> Iterator[Chart]:
    """Give the error of the gyro as simulated and as measured, where it is known."""
    if curve.simulated is None:
        return
    measured = curve.simulated + curve.before
    unit, factor = _rate_unit(measured)
    lines = [Line('measured', 'measured', factor * measured, factor * np.asarray(curve.deviation),
                  draw_dots=True), Line('simulated', 'simulated', factor * curve.simulated)]
    if not np.array_equal(curve.before, curve.after, equal_nan=True):
        lines.append(Line('simulated, extended', 'after', factor * (measured - curve.after)))
    yield Chart(f'predicted-{place}', f'Error of the gyro along {readable_name(curve.along)}',
                'Mean of output less true rate, measured and simulated.',
                *_horizontal(curve), 'error', unit, lines)


def _horizontal(curve: Curve) -> tuple[str, str, Array]:
    """Return label, unit and values of the horizontal axis."""
    unit, factor = _time_unit(curve.at) if curve.along == 'time' else display_unit(curve.unit)
    return readable_name(curve.along), unit, factor * curve.at


def _residual_chart(curve: Curve, place: int) -> Chart:
    name, title = f'residual-{place}', f'Residual along {readable_name(curve.along)}'
    if curve.along == 'frequency':  # amplitudes instead of means
        lines = [*_before_and_after(curve.before / DEGREE, curve.after / DEGREE),
                 Line('usual', 'simulated', np.asarray(curve.deviation) / DEGREE)]
        return Chart(name, title, 'Largest amplitude of the residual in bands of frequency, and '
                     'the usual one there; a line that stands out is a tone.', *_horizontal(curve),
                     'amplitude', 'deg/s', lines, is_logarithmic=True)
    unit, factor = _rate_unit(np.concatenate([curve.before, curve.after]))
    lines = _before_and_after(factor * curve.before, factor * curve.after,
                              factor * np.asarray(curve.deviation))
    return Chart(name, title, 'Mean of the residual, with 95 % bands of noise alone.',
                 *_horizontal(curve), 'residual', unit, lines)


def _heading_chart(curve: Curve) -> Chart:
    time, before, after = _thin_points(curve.at, curve.before, curve.after)
    unit, factor = _time_unit(time)
    return Chart('heading', 'Heading error over the log', 'Heading error of the simulation.',
                 'time', unit, factor * time, 'heading error', 'deg',
                 _before_and_after(before / DEGREE, after / DEGREE))


def _allan_chart(curve: Curve) -> Chart:
    unit, factor = display_unit('rad/s', 'bias_instability')
    lines = [Line('residual', 'measured', factor * curve.before, draw_dots=True),
             Line('noise as found', 'after', factor * curve.after)]
    if curve.simulated is not None:
        lines.append(Line('noise of the simulation', 'simulated', factor * curve.simulated))
    return Chart('noise', 'Allan deviation of the residual',
                 'Allan deviation over averaging time, of the residual and of the noise that is '
                 'simulated.', 'averaging time', 's', curve.at, 'Allan deviation',
                 unit, lines, is_logarithmic=True)


def _thin_points(at: Array, *values: Array) -> list[Array]:
    """Return curves with fewer points: the lowest and the highest of each part, in place."""
    if len(at) <= 4 * _THINNED_PARTS:
        return [at, *values]
    chosen = {0, len(at) - 1}
    for part in np.array_split(np.arange(len(at)), _THINNED_PARTS):
        for each in values:
            if np.isfinite(each[part]).any():
                chosen |= {int(part[np.nanargmin(each[part])]),
                           int(part[np.nanargmax(each[part])])}
    kept = np.array(sorted(chosen))
    return [each[kept] for each in (at, *values)]


# elements, and charts in them

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
    """One line of a chart."""

    name: str  # for legend and table
    style: str  # measured, simulated, before or after: colour and stroke
    values: Array  # shape (n,), nan where missing
    # of the values, drawn as a band or as bars of 95 %; None where it is not known
    deviation: Array | None = None
    draw_dots: bool = False  # draw dots instead of a line


@dataclass(frozen=True)
class Chart:
    """A chart, in displayed units."""

    name: str  # of the chart, unique on the page
    # title, description: for people, also for screen readers
    title: str
    description: str
    # x_label, x_unit, x: label, unit and values of the horizontal axis, shape (n,)
    x_label: str
    x_unit: str
    x: Array
    # y_label, y_unit, lines: label, unit and lines of the vertical axis
    y_label: str
    y_unit: str
    lines: Sequence[Line]
    is_logarithmic: bool = False  # both axes
    x_names: Sequence[str] = ()  # of the horizontal values, if they are numbered from 1 on


#: Style, by its name in the style of the page -> colour in the light theme and stroke.
_STYLES: dict[str, tuple[str, Any]] = {
    'measured': ('#1d2327', '-'), 'simulated': ('#59636b', (0, (6, 4))),
    'before': ('#b4480f', (0, (8, 2))), 'after': ('#0a6c85', '-'),
    'quiet': ('#59636a', '-'), 'grid': ('#e9e6df', '-')}


def draw_chart(chart: Chart) -> Markup:
    """Return a chart with the table of its values."""
    if not any(each.any() for each in _drawable(chart)):
        return element('p', f'{chart.title}: there is nothing to draw.', class_='quiet')
    picture = (_draw_svg(chart) if find_spec('matplotlib')
               else element('p', 'matplotlib is not installed: no picture', class_='quiet'))
    heads = [(chart.x_label, chart.x_unit), *((each.name, chart.y_unit) for each in chart.lines)]
    rows = []
    for row, at in enumerate(chart.x.tolist()):
        cells = [chart.x_names[round(at) - 1] if chart.x_names else format_number(at, 4)]
        for line in chart.lines:  # a value with the half of its interval
            is_known = math.isfinite(line.values[row])
            cells.append(format_number(float(line.values[row])) if is_known else '–')
            if is_known and line.deviation is not None:
                half = NORMAL_QUANTILE_975 * float(line.deviation[row])
                cells[-1] += f' ± {format_number(half, 2)}'
        rows.append(element('tr', *(element('td', cell) for cell in cells)))
    titles = (element('th', _with_unit(*head), scope='col') for head in heads)
    table = element('table', element('caption', f'{chart.title}, {chart.y_label}'),
                    element('thead', element('tr', *titles)), element('tbody', *rows))
    return element('figure', element('figcaption', chart.title), picture,
                   element('p', chart.description, class_='quiet'),
                   element('details', element('summary', 'Values'),
                           element('div', table, class_='scroll', tabindex='0')))


def _drawable(chart: Chart) -> list[Mask]:
    """Tell which values of each line can be drawn."""
    known = [np.isfinite(chart.x) & np.isfinite(line.values) for line in chart.lines]
    if not chart.is_logarithmic:
        return known
    return [each & (chart.x > 0.0) & (line.values > 0.0) for each, line in zip(known, chart.lines)]


def draw_axes(axes: Any, chart: Chart) -> None:
    """Draw a chart into axes of matplotlib."""
    from matplotlib.ticker import MaxNLocator  # not needed without a page, and slow to load
    axes.set(xlabel=_plain(_with_unit(chart.x_label, chart.x_unit)),
             ylabel=_plain(_with_unit(chart.y_label, chart.y_unit)))
    axes.margins(x=0.0)
    axes.grid(True)
    if chart.is_logarithmic:
        axes.set(xscale='log', yscale='log')
    else:
        axes.axhline(0.0, color=_STYLES['quiet'][0], linewidth=0.8)
        axes.ticklabel_format(axis='y', useOffset=False)
    for line, shown in zip(chart.lines, _drawable(chart)):
        # a line breaks where there is no value
        (colour, stroke), x = _STYLES[line.style], np.where(shown, chart.x, np.nan)
        name = _plain(line.name) + ('' if line.deviation is None else ', 95 %')
        half = (None if line.deviation is None
                else NORMAL_QUANTILE_975 * np.nan_to_num(line.deviation))
        if line.draw_dots:
            axes.errorbar(x, line.values, half, fmt='o', color=colour, markersize=4, elinewidth=1,
                          label=name)
            continue
        axes.plot(x, line.values, color=colour, linestyle=stroke, linewidth=1.5, label=name)
        if half is not None:
            axes.fill_between(x, line.values - half, line.values + half, color=colour, alpha=0.18,
                              linewidth=0)
    if chart.x_names:
        apart = math.ceil(sum(map(len, chart.x_names)) / 30) or 1
        axes.set_xticks(range(1, len(chart.x_names) + 1, apart))
        axes.set_xticklabels([_plain(name) for name in chart.x_names[::apart]])
        axes.set_xlim(0.5, len(chart.x_names) + 0.5)
    elif chart.x_unit == 'deg':
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.8, 3, 4.5, 9, 10]))
    axes.legend(loc='lower center', bbox_to_anchor=(0.5, 1.0), ncol=2)


def _draw_svg(chart: Chart) -> Markup:
    """Return the picture, in the colours of the page."""
    import matplotlib  # not needed without a page, and slow to load
    from matplotlib.figure import Figure
    text, grid = _STYLES['quiet'][0], _STYLES['grid'][0]
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
        draw_axes(figure.add_subplot(facecolor='none'), chart)
        figure.savefig(file, format='svg', metadata=dict.fromkeys(
            ('Creator', 'Date', 'Format', 'Type')))
    # of the names, which other charts have too, only markers and clipping paths are used
    svg = re.sub(r' id="(?![mp][0-9a-f]{10}")[^"]+"', '', file.getvalue().partition('<svg ')[2])
    for name, (colour, _) in _STYLES.items():
        svg = svg.replace(colour, f'var(--{name})')
    size = re.search(r'viewBox="[^"]+"', svg)
    assert size is not None
    label = _escaped(f'{chart.title}. {chart.description}')
    return Markup(f'<svg {size[0]} role="img" aria-label="{label}" '
                  f'xmlns:xlink="http://www.w3.org/1999/xlink"{svg[svg.index(">"):].rstrip()}')


def _plain(text: str) -> str:
    """Return a text that matplotlib does not take for a formula."""
    return to_printable(text).replace('$', r'\$')


def _with_unit(name: str, unit: str) -> str:
    return f'{name} [{unit}]' if unit else name
