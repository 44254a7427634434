# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A diagnosis as one page that needs nothing else: no network, no other files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from string import Template

import gyro_calibration
from gyro_calibration.diagnosis.charts import Chart, draw_chart, element, join_markup, Line, Markup
from gyro_calibration.diagnosis.findings import (
    Curve,
    Diagnosis,
    Estimate,
    HeadingCurve,
    NoiseCurve,
    Trace,
)
from gyro_calibration.diagnosis.words import (
    as_sentence,
    cause_paragraphs,
    cause_title,
    display_unit,
    format_amount,
    format_quantity,
    headline,
    is_model_extended,
    lists,
    noise_rows,
    readable_name,
    verdict_phrase,
)
from gyro_calibration.files import to_printable
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.model_file import format_model
from gyro_calibration.model.noise import Noise
import numpy as np

#: Parts of a curve of which only the extremes are drawn.
_THINNED_PARTS = 90
_DEG_PER_HOUR = 3600.0 / DEGREE
#: The variable of the curve of amplitudes instead of means.
SPECTRUM_VARIABLE = 'frequency'

_METHOD_TEXT = (
    '{logs} replayed through the simulation, with motion and temperature as recorded. The '
    'residual, measured less simulated output, was compared with every cause of the catalogue, '
    'under a noise of angle random walk, flicker and rate random walk that was fitted together '
    'with the causes. A cause is named if its evidence exceeds that of the strongest of all '
    'causes in noise that was simulated for this log, so that {share} of logs without any cause '
    'give an alarm. Causes were added one at a time, refined, exchanged, and removed if another '
    'one explains more. Causes that explain the data equally well are given as a set, of which '
    'the simplest is in the model. Bias and scale factor are fitted in any case. The gain was '
    'measured on held-out parts; intervals are of 95 %.')


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
    heading, trace = diagnosis.heading, diagnosis.trace
    return replace(diagnosis,
                   curves=[replace(curve, after=curve.before) for curve in diagnosis.curves],
                   heading=None if heading is None else replace(heading, after=heading.before),
                   trace=None if trace is None else replace(trace, extended=trace.simulated))


def _sections(diagnosis: Diagnosis) -> Iterator[tuple[str, Iterable[Markup]]]:
    """Give titles with their content."""
    along = [*(found.along for found in diagnosis.findings),
             *(each.along for each in diagnosis.unexplained)]
    curves = sorted((each for each in enumerate(diagnosis.curves) if each[1].along in along),
                    key=lambda each: along.index(each[1].along))
    others = [each for each in enumerate(diagnosis.curves) if each[1].along not in along]
    yield 'Simulation and measurement', _misfit_charts(diagnosis.trace, curves or others)
    yield 'Causes', [element('article', element('h3', f'{place} {cause_title(found)}'),
                             *(element('p', text) for text in cause_paragraphs(found, diagnosis)))
                     for place, found in enumerate(diagnosis.findings, 1)]
    yield 'Heading' if diagnosis.gain is None else 'Gain on held-out parts', _gain(diagnosis)
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
                else 'The model is as it was.'),
        element('pre', element('code', format_model(diagnosis.model)), tabindex='0',
                class_='scroll')]
    logs = f'{len(diagnosis.logs)} logs were' if len(diagnosis.logs) > 1 else 'The log was'
    method = _METHOD_TEXT.format(logs=logs, share=f'{100.0 * diagnosis.false_alarm_rate:.2g} %')
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


def _gain(diagnosis: Diagnosis) -> Iterator[Markup]:
    parts = [] if diagnosis.heading is None else [draw_chart(_heading_chart(diagnosis.heading))]
    if (gain := diagnosis.gain) is not None:
        rows = gain.rows()
        yield element('p', f'Measured on {to_printable(gain.held_out)}, which took no part in the '
                      'choice or the fit.')
        reductions = [Estimate(won, change.interval or (won, won), unit)
                      for _, change, unit in rows for won in [change.before - change.after]]
        parts.append(_table(['rms', 'before', 'after', 'reduction, 95 % interval'], [
            [what, format_amount(change.before, unit), format_amount(change.after, unit),
             format_quantity(reduction)]
            for (what, change, unit), reduction in zip(rows, reductions)]))
    if parts:
        yield _side_by_side(parts)


# charts

def _misfit_charts(trace: Trace | None, curves: Sequence[tuple[int, Curve]]) -> Iterator[Markup]:
    if trace is not None:
        yield element('p', 'The stretch where they differ most:')
        yield _side_by_side(map(draw_chart, _trace_charts(trace)))
    for place, curve in curves:
        before, after = (format_amount(float(np.abs(each[np.isfinite(each)]).max(initial=0.0)),
                                       'rad/s') for each in (curve.before, curve.after))
        unchanged = np.array_equal(curve.before, curve.after, equal_nan=True)
        yield element('p', f'Along {readable_name(curve.along)}, the error of the simulation is '
                      f'up to {before}' + ('.' if unchanged else ' before the extension, and up '
                                           f'to {after} after it.'))
        yield _side_by_side(map(draw_chart, [*_error_charts(curve, place),
                                             _residual_chart(curve, place)]))


def _trace_charts(trace: Trace) -> Iterator[Chart]:
    time, measured, simulated, extended = _thin_points(
        trace.time, trace.measured, trace.simulated, trace.extended)
    unit, factor = _rate_unit(measured)
    lines = [Line('measured', 'measured', factor * measured),
             Line('simulated', 'simulated', factor * simulated)]
    yield Chart('trace', 'Output of the gyro', 'Measured and simulated output over time.', 'time',
                's', time, 'output', unit, lines)
    unit, factor = _rate_unit(measured - simulated)
    yield Chart('difference', 'Measured less simulated', 'What the simulation leaves over time.',
                'time', 's', time, 'residual', unit,
                _before_and_after(factor * (measured - simulated), factor * (measured - extended)))


def _before_and_after(before: Array, after: Array, deviation: Array | None = None) -> list[Line]:
    """Return a line for each, or a single one where nothing was changed."""
    if np.array_equal(before, after, equal_nan=True):
        return [Line('residual', 'before', before, deviation)]
    return [Line('before', 'before', before, deviation), Line('after', 'after', after, deviation)]


def _rate_unit(values: Array) -> tuple[str, float]:
    """Return the unit in which people read rates up to these, and the factor to it."""
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    return (('deg/h', _DEG_PER_HOUR) if 0.0 < largest < 2e-3 * DEGREE
            else ('deg/s', 1.0 / DEGREE))


def _time_unit(time: Array) -> tuple[str, float]:
    """Return the unit in which people read times of a log, and the factor to it."""
    duration = float(np.ptp(time)) if len(time) else 0.0
    return (('s', 1.0) if duration <= 600.0 else ('min', 1.0 / 60.0) if duration <= 14400.0
            else ('h', 1.0 / 3600.0))


def _error_charts(curve: Curve, place: int) -> Iterator[Chart]:
    """Give the error of the gyro as simulated and as measured, where it is known."""
    if curve.simulated is None or curve.along == SPECTRUM_VARIABLE:
        return
    measured = curve.simulated + curve.before
    unit, factor = _rate_unit(measured)
    lines = [Line('measured', 'measured', factor * measured, factor * curve.deviation,
                  draw_dots=True), Line('simulated', 'simulated', factor * curve.simulated)]
    if not np.array_equal(curve.before, curve.after, equal_nan=True):
        lines.append(Line('simulated, extended', 'after', factor * (measured - curve.after)))
    yield Chart(f'predicted-{place}', f'Error of the gyro along {readable_name(curve.along)}',
                'Mean of output less true rate, as measured and as the simulation has it.',
                *_horizontal(curve), 'error', unit, lines)


def _horizontal(curve: Curve) -> tuple[str, str, Array]:
    """Return label, unit and values of the horizontal axis."""
    unit, factor = _time_unit(curve.at) if curve.along == 'time' else display_unit(curve.unit)
    return readable_name(curve.along), unit, factor * curve.at


def _residual_chart(curve: Curve, place: int) -> Chart:
    name, title = f'residual-{place}', f'Residual along {readable_name(curve.along)}'
    if curve.along == SPECTRUM_VARIABLE:
        lines = [*_before_and_after(curve.before / DEGREE, curve.after / DEGREE),
                 Line('usual', 'simulated', curve.deviation / DEGREE)]
        return Chart(name, title, 'Largest amplitude of the residual in bands of frequency, and '
                     'the usual one there; a line that stands out is a tone.', *_horizontal(curve),
                     'amplitude', 'deg/s', lines, is_logarithmic=True)
    unit, factor = _rate_unit(np.concatenate([curve.before, curve.after]))
    lines = _before_and_after(factor * curve.before, factor * curve.after,
                              factor * curve.deviation)
    return Chart(name, title, 'Mean of what the simulation leaves, with bands of 95 % by noise '
                 'alone.', *_horizontal(curve), 'residual', unit, lines)


def _heading_chart(curve: HeadingCurve) -> Chart:
    time, before, after = _thin_points(curve.time, curve.before, curve.after)
    unit, factor = _time_unit(time)
    return Chart('heading', 'Heading error over the log', 'Heading error of the simulation.',
                 'time', unit, factor * time, 'heading error', 'deg',
                 _before_and_after(before / DEGREE, after / DEGREE))


def _allan_chart(curve: NoiseCurve) -> Chart:
    lines = [Line('residual', 'measured', _DEG_PER_HOUR * curve.measured, draw_dots=True),
             Line('noise as found', 'after', _DEG_PER_HOUR * curve.fitted)]
    if curve.simulated is not None:
        lines.append(Line('noise of the simulation', 'simulated', _DEG_PER_HOUR * curve.simulated))
    return Chart('noise', 'Allan deviation of the residual',
                 'Allan deviation over averaging time, of the residual and of the noise that is '
                 'simulated.', 'averaging time', 's', curve.averaging_time, 'Allan deviation',
                 'deg/h', lines, is_logarithmic=True)


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
