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
    Change,
    Curve,
    Diagnosis,
    Estimate,
    Finding,
    Gain,
    HeadingCurve,
    NoiseCurve,
    Trace,
)
from gyro_calibration.diagnosis.words import (
    alternatives_sentence,
    as_sentence,
    cause_sentences,
    causes_by_reason,
    certainty_sentences,
    change_phrase,
    detectability_sentence,
    display_unit,
    format_amount,
    format_number,
    format_quantity,
    heading_error_sentence,
    heading_share_rows,
    headline,
    is_model_extended,
    join_list,
    noise_rows,
    parameter_quantities,
    readable_name,
    remedy_sentence,
    sanitize_text,
    structure_sentence,
    time_unit,
    verdict_phrase,
)
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.model_file import format_model
from gyro_calibration.model.noise import Noise
import numpy as np

#: Parts of a curve of which only the extremes are drawn.
_THINNED_PARTS = 90
#: Residuals below this, rad/s, are displayed in deg/h.
_DEG_PER_HOUR_LIMIT = 2e-3 * DEGREE
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
    title = ', '.join(map(sanitize_text, diagnosis.logs)) or 'gyro'
    diagnosis = diagnosis if is_model_extended(diagnosis) else _without_extension(diagnosis)
    body = join_markup(_header(diagnosis), element('main', *_sections(diagnosis)))
    return render_page(f'Diagnosis of {title}', body)


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


def _header(diagnosis: Diagnosis) -> Markup:
    what, gained = headline(diagnosis)
    gyro = ' '.join(sanitize_text(str(diagnosis.model.gyro.get(name, '')))
                    for name in ('name', 'serial_number')).strip()
    about = ' · '.join(
        filter(None, ['Diagnosis', gyro, ', '.join(map(sanitize_text, diagnosis.logs))]))
    shares, gain = heading_error_sentence(diagnosis), diagnosis.gain
    tiles = [] if gain is None else [_tile(*each) for each in _gain_rows(gain)]
    return element('header', element('p', about, class_='about'), element('h1', what),
                   element('p', gained, class_='gained'),
                   element('p', shares, class_='gained') if shares else None,
                   element('p', verdict_phrase(diagnosis), class_=f'verdict {diagnosis.verdict}'),
                   element('div', *tiles, class_='tiles') if tiles else None)


def _tile(what: str, errors: Change, unit: str) -> Markup:
    name, factor = display_unit(unit)
    return element(
        'div', element('p', as_sentence(what).rstrip('.')),
        element('p', format_number(errors.before * factor), element('span', ' → ', class_='quiet'),
                format_number(errors.after * factor), element('span', f' {name}', class_='quiet'),
                class_='big'),
        element('p', f'reduced by {_reduction_text(errors, unit)}', class_='quiet'), class_='tile')


def _reduction_text(errors: Change, unit: str) -> str:
    gained = errors.before - errors.after
    return str(format_quantity(Estimate(gained, errors.interval or (gained, gained), unit)))


def _sections(diagnosis: Diagnosis) -> Iterator[Markup | None]:
    implicated, others = _split_curves(diagnosis)
    yield _section('Simulation and measurement', _misfit_charts(diagnosis, implicated or others))
    yield _section('Causes', [_cause_article(place, found, diagnosis)
                              for place, found in enumerate(diagnosis.findings, 1)])
    yield _section('Structure that no cause explains',
                   [_bullet_list(map(structure_sentence, diagnosis.unexplained))]
                   if diagnosis.unexplained else [])
    yield _section('Shares of the heading error',
                   [element('p', 'Parts of the mean square of the heading error over 60 s.'),
                    _responsive_table(['', 'share'], heading_share_rows(diagnosis))]
                   if diagnosis.heading_shares else [])
    yield _section('Gain on held-out parts' if diagnosis.gain is not None else 'Heading',
                   _gain_content(diagnosis))
    noise = _responsive_table(['', 'residual', 'simulation'], noise_rows(diagnosis))
    if diagnosis.noise_curve is not None:
        yield _section('Noise',
                       [_side_by_side([draw_chart(_allan_chart(diagnosis.noise_curve)), noise])])
    elif diagnosis.noise != Noise():
        yield _section('Noise', [noise])
    yield _section('Along the other variables',
                   [_side_by_side(draw_chart(_residual_chart(curve, place))
                                  for place, curve in others)] if implicated and others else [])
    yield _section(
        'What these data cannot show',
        [element('dl', *(join_markup(element('dt', join_list(names)), element('dd', reason))
                         for reason, names in causes_by_reason(diagnosis.cannot_show).items()))]
        if diagnosis.cannot_show else [])
    yield _section('The model', [
        element('p', 'This is the extended model, as model.yaml has it; compensate, simulate and '
                'the compensation node take it as it is.' if is_model_extended(diagnosis)
                else 'The model is as it was.'),
        element('pre', element('code', format_model(diagnosis.model)), tabindex='0',
                class_='scroll')])
    logs = f'{len(diagnosis.logs)} logs were' if len(diagnosis.logs) > 1 else 'The log was'
    yield _section('How this was computed', [
        element('p', as_sentence(diagnosis.method) or _METHOD_TEXT.format(
            logs=logs, share=f'{100.0 * diagnosis.false_alarm_rate:.2g} %')),
        _bullet_list(map(as_sentence, diagnosis.remarks)) if diagnosis.remarks else None,
        element('p', f'gyro_calibration {gyro_calibration.__version__}', class_='quiet')])


def _section(title: str, content: Iterable[Markup | None]) -> Markup | None:
    parts = [part for part in content if part]
    return element('section', element('h2', title), *parts) if parts else None


def _side_by_side(figures: Iterable[Markup]) -> Markup:
    return element('div', *figures, class_='pairs')


def _bullet_list(texts: Iterable[str]) -> Markup:
    return element('ul', *(element('li', text) for text in texts))


# simulation and measurement

NumberedCurve = tuple[int, Curve]


def _split_curves(diagnosis: Diagnosis) -> tuple[list[NumberedCurve], list[NumberedCurve]]:
    """Return the curves along guilty variables, in the order of the causes, and the others."""
    along = [*(found.along for found in diagnosis.findings),
             *(each.along for each in diagnosis.unexplained)]
    curves = list(enumerate(diagnosis.curves))
    implicated = [each for each in curves if each[1].along in along]
    implicated.sort(key=lambda each: along.index(each[1].along))
    return implicated, [each for each in curves if each[1].along not in along]


def _misfit_charts(diagnosis: Diagnosis, implicated: Sequence[NumberedCurve]) -> Iterator[Markup]:
    if implicated or diagnosis.trace is not None:
        yield element('p', 'Point at a chart, or use the arrow keys, to read its values.',
                      class_='quiet hint')
    if diagnosis.trace is not None:
        yield element('p', 'The stretch where they differ most:')
        yield _side_by_side(draw_chart(chart) for chart in _trace_charts(diagnosis.trace))
    for place, curve in implicated:
        before, after = (format_amount(float(np.abs(each[np.isfinite(each)]).max(initial=0.0)),
                                       'rad/s') for each in (curve.before, curve.after))
        yield element('p', f'Along {readable_name(curve.along)}, the error of the simulation is '
                           'up to '
                      f'{before}' + ('.' if _is_unchanged(curve)
                                     else f' before the extension, and up to {after} after it.'))
        yield _side_by_side(
            draw_chart(chart)
            for chart in (_error_chart(curve, place), _residual_chart(curve, place))
            if chart is not None)


def _is_unchanged(curve: Curve) -> bool:
    return bool(np.array_equal(curve.before, curve.after, equal_nan=True))


def _trace_charts(trace: Trace) -> Iterator[Chart]:
    time, measured, simulated, extended = _thin_points(
        trace.time, trace.measured, trace.simulated, trace.extended)
    unit, factor = _rate_unit(measured)
    lines = [Line('measured', 'measured', factor * measured),
             Line('simulated', 'simulated', factor * simulated)]
    yield Chart('trace', 'Output of the gyro', 'Measured and simulated output over time.', 'time',
                's', time, 'output', unit, lines)
    unit, factor = _rate_unit(measured - simulated)
    lines = _before_and_after(factor * (measured - simulated), factor * (measured - extended))
    yield Chart('difference', 'Measured less simulated',
                f'What the simulation leaves over time{_stage_phrase(lines)}.', 'time', 's', time,
                'residual', unit, lines)


def _before_and_after(before: Array, after: Array, deviation: Array | None = None) -> list[Line]:
    """Return a line for each, or a single one where nothing was changed."""
    if np.array_equal(before, after, equal_nan=True):
        return [Line('residual', 'before', before, deviation)]
    return [Line('before', 'before', before, deviation), Line('after', 'after', after, deviation)]


def _stage_phrase(lines: Sequence[Line]) -> str:
    return ', before and after the extension' if lines[0].name == 'before' else ''


def _horizontal_unit(curve: Curve) -> tuple[str, float]:
    if curve.along == 'time':
        return time_unit(float(np.ptp(curve.at)) if len(curve.at) else 0.0)
    return display_unit(curve.unit)


def _rate_unit(values: Array) -> tuple[str, float]:
    """Return the unit in which people read rates up to these, and the factor to it."""
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    return (('deg/h', 3600.0 / DEGREE) if 0.0 < largest < _DEG_PER_HOUR_LIMIT
            else ('deg/s', 1.0 / DEGREE))


def _error_chart(curve: Curve, place: int) -> Chart | None:
    """Return the error of the gyro as simulated and as measured."""
    if curve.simulated is None or curve.along == SPECTRUM_VARIABLE:
        return None
    measured = curve.simulated + curve.before
    unit, factor = _rate_unit(measured)
    across, scale = _horizontal_unit(curve)
    lines = [Line('measured', 'measured', factor * measured, factor * curve.deviation,
                  draw_dots=True), Line('simulated', 'simulated', factor * curve.simulated)]
    if not _is_unchanged(curve):
        lines.append(Line('simulated, extended', 'after', factor * (measured - curve.after)))
    along = readable_name(curve.along)
    return Chart(f'predicted-{place}', f'Error of the gyro along {along}',
                 f'Mean of output less true rate along {along}, as measured and as the simulation '
                 'has it.', along, across, scale * curve.at, 'error', unit, lines)


def _residual_chart(curve: Curve, place: int) -> Chart:
    if curve.along == SPECTRUM_VARIABLE:
        return _spectrum_chart(curve, place)
    unit, factor = _rate_unit(np.concatenate([curve.before, curve.after]))
    across, scale = _horizontal_unit(curve)
    lines = _before_and_after(factor * curve.before, factor * curve.after,
                              factor * curve.deviation)
    along = readable_name(curve.along)
    return Chart(f'residual-{place}', f'Residual along {along}',
                 f'Mean of what the simulation leaves along {along}{_stage_phrase(lines)}, with '
                 'bands of 95 % by noise '
                 'alone.', along, across, scale * curve.at, 'residual', unit, lines)


def _spectrum_chart(curve: Curve, place: int) -> Chart:
    """Return the amplitudes of the residual over frequency with those of noise."""
    lines = [*_before_and_after(curve.before / DEGREE, curve.after / DEGREE),
             Line('usual', 'simulated', curve.deviation / DEGREE)]
    return Chart(f'residual-{place}', 'Residual along frequency',
                 'Largest amplitude of the residual in bands of frequency, and the usual one '
                 'there; a line that stands out is a tone.', 'frequency', 'Hz', curve.at,
                 'amplitude', 'deg/s', lines, is_logarithmic=True)


def _thin_points(at: Array, *values: Array) -> list[Array]:
    """Return curves with fewer points: the lowest and the highest of each part, in place."""
    if len(at) <= 4 * _THINNED_PARTS:
        return [at, *values]
    chosen = {0, len(at) - 1}
    for part in np.array_split(np.arange(len(at)), _THINNED_PARTS):
        for each in values:
            known = np.isfinite(each[part])
            if known.any():
                chosen |= {int(part[np.nanargmin(each[part])]),
                           int(part[np.nanargmax(each[part])])}
    kept = np.array(sorted(chosen))
    return [each[kept] for each in (at, *values)]


# causes

def _cause_article(place: int, found: Finding, diagnosis: Diagnosis) -> Markup:
    facts = [*certainty_sentences(found), detectability_sentence(found),
             remedy_sentence(found, diagnosis)]
    uncertain = (element('p', alternatives_sentence(found), class_='uncertain')
                 if found.ambiguous_with else None)
    sizes_of = _responsive_table(['', 'estimate', '95 % interval'], [
        [readable_name(name), size.estimate, size.bounds or '–']
        for name, size in parameter_quantities(found).items()]) if found.parameters else None
    title = element(
        'h3',
        element('span', f'{place}', class_='place'),
        ' ',
        readable_name(found.effect),
        ' ',
        element('code', found.effect, class_='quiet')  # as files have it
        if readable_name(found.effect) != sanitize_text(found.effect) else None)
    return element('article', title, *(element('p', text) for text in cause_sentences(found)),
                   sizes_of, uncertain,
                   element('p', ' '.join(filter(None, facts)), class_='quiet'))


def _responsive_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """Return a table whose rows become lists on a narrow screen."""
    body = (element('tr', element('th', row[0], scope='row'), *(
        element('td', cell, data_head=head) for head, cell in zip(heads[1:], row[1:])))
        for row in rows)
    columns = (element('th', head, scope='col') for head in heads)
    table = element('table', element('thead', element('tr', *columns)), element('tbody', *body))
    return element('div', table, class_='fold')


# heading, gain, noise

def _gain_content(diagnosis: Diagnosis) -> Iterator[Markup | None]:
    parts = [] if diagnosis.heading is None else [draw_chart(_heading_chart(diagnosis.heading))]
    if diagnosis.gain is not None:
        errors = _gain_rows(diagnosis.gain)
        changes = [f' The extended model {change_phrase(each, unit, f"the {what}")}.'
                   for what, each, unit in errors]
        yield element('p', f'Measured on {sanitize_text(diagnosis.gain.held_out)}, which took no '
                      'part in the choice or the fit.' + ''.join(changes))
        rows = [[what, format_amount(each.before, unit), format_amount(each.after, unit),
                 _reduction_text(each, unit)] for what, each, unit in errors]
        parts.append(_responsive_table(['rms', 'before', 'after', 'reduction, 95 % interval'],
                                       rows))
    yield _side_by_side(parts) if parts else None


def _gain_rows(gain: Gain) -> list[tuple[str, Change, str]]:
    """Return what was measured before and after, with its unit of SI."""
    heading = ([] if gain.heading is None
               else [(f'heading error over {gain.window:g} s', gain.heading, 'rad')])
    return [*heading, ('rate error', gain.rate, 'rad/s')]


def _heading_chart(curve: HeadingCurve) -> Chart:
    time, before, after = _thin_points(curve.time, curve.before, curve.after)
    unit, factor = time_unit(float(np.ptp(time)) if len(time) else 0.0)
    lines = _before_and_after(before / DEGREE, after / DEGREE)
    return Chart('heading', 'Heading error over the log',
                 f'Heading error of the simulation{_stage_phrase(lines)}.', 'time',
                 unit, factor * time, 'heading error', 'deg', lines)


def _allan_chart(curve: NoiseCurve) -> Chart:
    factor = 3600.0 / DEGREE
    lines = [Line('residual', 'measured', factor * curve.measured, draw_dots=True),
             Line('noise as found', 'after', factor * curve.fitted)]
    if curve.simulated is not None:
        lines.append(Line('noise of the simulation', 'simulated', factor * curve.simulated))
    return Chart('noise', 'Allan deviation of the residual',
                 'Allan deviation over averaging time, of the residual and of the noise that is '
                 'simulated.', 'averaging time', 's', curve.averaging_time, 'Allan deviation',
                 'deg/h', lines, is_logarithmic=True)
