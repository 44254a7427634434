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
from gyro_calibration.diagnosis.charts import Chart, draw, element, joined, Line, Markup
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
    alternatives,
    amount,
    certainty,
    change,
    clean,
    divided,
    for_people,
    heading_shares,
    headline,
    hidden,
    listed,
    noise_figures,
    number,
    offered,
    quantity,
    remedy,
    sentence,
    shown_by,
    sizes,
    smallest,
    span,
    spoken,
    unknown,
    verdict,
)
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.model_file import model_text
from gyro_calibration.model.noise import Noise
import numpy as np

#: Parts of a curve of which only the extremes are drawn.
_PARTS = 90
#: Residuals below this, rad/s, are displayed in deg/h.
_SLOW = 2e-3 * DEGREE
#: The variable of the curve of amplitudes instead of means.
SPECTRUM = 'frequency'

_METHOD = (
    '{logs} replayed through the simulation, with motion and temperature as recorded. The '
    'residual, measured less simulated output, was compared with every cause of the catalogue, '
    'under a noise of angle random walk, flicker and rate random walk that was fitted together '
    'with the causes. A cause is named if its evidence exceeds that of the strongest of all '
    'causes in noise that was simulated for this log, so that {share} of logs without any cause '
    'give an alarm. Causes were added one at a time, refined, exchanged, and removed if another '
    'one explains more. Causes that explain the data equally well are given as a set, of which '
    'the simplest is in the model. Bias and scale factor are fitted in any case. The gain was '
    'measured on held-out parts; intervals are of 95 %.')


def report(diagnosis: Diagnosis) -> str:
    """Return the page, HTML in UTF-8."""
    title = ', '.join(map(clean, diagnosis.logs)) or 'gyro'
    diagnosis = diagnosis if offered(diagnosis) else _as_it_was(diagnosis)
    body = joined(_header(diagnosis), element('main', *_sections(diagnosis)))
    return page(f'Diagnosis of {title}', body)


def page(title: str, body: Markup) -> str:
    """Return a page with this title and body, HTML in UTF-8."""
    template = Template(Path(__file__).with_name('report.html').read_text(encoding='utf-8'))
    return template.substitute(title=element('title', title), body=body)


def _as_it_was(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis without curves after the extension."""
    heading, trace = diagnosis.heading, diagnosis.trace
    return replace(diagnosis,
                   curves=[replace(curve, after=curve.before) for curve in diagnosis.curves],
                   heading=None if heading is None else replace(heading, after=heading.before),
                   trace=None if trace is None else replace(trace, extended=trace.simulated))


def _header(diagnosis: Diagnosis) -> Markup:
    what, gained = headline(diagnosis)
    gyro = ' '.join(clean(str(diagnosis.model.gyro.get(name, '')))
                    for name in ('name', 'serial_number')).strip()
    about = ' · '.join(filter(None, ['Diagnosis', gyro, ', '.join(map(clean, diagnosis.logs))]))
    return element('header', element('p', about, class_='about'), element('h1', what),
                   element('p', gained, class_='gained'),
                   element('p', parts, class_='gained') if (parts := divided(diagnosis)) else None,
                   element('p', verdict(diagnosis), class_=f'verdict {diagnosis.verdict}'),
                   None if diagnosis.gain is None else element(
                       'div', *(_tile(*each) for each in _errors(diagnosis.gain)),
                       class_='tiles'))


def _tile(what: str, errors: Change, unit: str) -> Markup:
    name, factor = for_people(unit)
    return element('div', element('p', sentence(what).rstrip('.')), element(
        'p', number(errors.before * factor), element('span', ' → ', class_='quiet'),
        number(errors.after * factor), element('span', f' {name}', class_='quiet'),
        class_='big'), element('p', f'reduced by {_gained(errors, unit)}', class_='quiet'),
        class_='tile')


def _gained(errors: Change, unit: str) -> str:
    gained = errors.before - errors.after
    return str(quantity(Estimate(gained, errors.interval or (gained, gained), unit)))


def _sections(diagnosis: Diagnosis) -> Iterator[Markup | None]:
    guilty, others = _curves(diagnosis)
    yield _section('Simulation and measurement', _misfit(diagnosis, guilty or others))
    yield _section('Causes', [_cause(place, found, diagnosis)
                              for place, found in enumerate(diagnosis.findings, 1)])
    yield _section('Structure that no cause explains',
                   [_items(map(unknown, diagnosis.unexplained))] if diagnosis.unexplained else [])
    yield _section('Shares of the heading error', [
        element('p', 'Parts of the mean square of the heading error over 60 s.'),
        _folding(['', 'share'], heading_shares(diagnosis))] if diagnosis.heading_shares else [])
    yield _section('Gain on held-out parts' if diagnosis.gain is not None else 'Heading',
                   _gain(diagnosis))
    noise = _folding(['', 'residual', 'simulation'], noise_figures(diagnosis))
    if diagnosis.noise_curve is not None:
        yield _section('Noise', [_pairs([draw(_allan(diagnosis.noise_curve)), noise])])
    elif diagnosis.noise != Noise():
        yield _section('Noise', [noise])
    yield _section('Along the other variables', [_pairs(
        draw(_residual(curve, place)) for place, curve in others)] if guilty and others else [])
    yield _section('What these data cannot show', [element('dl', *(
        joined(element('dt', listed(names)), element('dd', reason))
        for reason, names in hidden(diagnosis.cannot_show).items()))]
        if diagnosis.cannot_show else [])
    yield _section('The model', [
        element('p', 'This is the extended model, as model.yaml has it; compensate, simulate and '
                'the compensation node take it as it is.' if offered(diagnosis)
                else 'The model is as it was.'),
        element('pre', element('code', model_text(diagnosis.model)), tabindex='0',
                class_='scroll')])
    logs = f'{len(diagnosis.logs)} logs were' if len(diagnosis.logs) > 1 else 'The log was'
    yield _section('How this was computed', [
        element('p', sentence(diagnosis.method) or _METHOD.format(
            logs=logs, share=f'{100.0 * diagnosis.false_alarm_rate:.2g} %')),
        _items(map(sentence, diagnosis.remarks)) if diagnosis.remarks else None,
        element('p', f'gyro_calibration {gyro_calibration.__version__}', class_='quiet')])


def _section(title: str, content: Iterable[Markup | None]) -> Markup | None:
    parts = [part for part in content if part]
    return element('section', element('h2', title), *parts) if parts else None


def _pairs(figures: Iterable[Markup]) -> Markup:
    return element('div', *figures, class_='pairs')


def _items(texts: Iterable[str]) -> Markup:
    return element('ul', *(element('li', text) for text in texts))


# simulation and measurement

Numbered = tuple[int, Curve]


def _curves(diagnosis: Diagnosis) -> tuple[list[Numbered], list[Numbered]]:
    """Return the curves along guilty variables, in the order of the causes, and the others."""
    along = [*(found.along for found in diagnosis.findings),
             *(each.along for each in diagnosis.unexplained)]
    curves = list(enumerate(diagnosis.curves))
    guilty = [each for each in curves if each[1].along in along]
    guilty.sort(key=lambda each: along.index(each[1].along))
    return guilty, [each for each in curves if each[1].along not in along]


def _misfit(diagnosis: Diagnosis, guilty: Sequence[Numbered]) -> Iterator[Markup]:
    if guilty or diagnosis.trace is not None:
        yield element('p', 'Point at a chart, or use the arrow keys, to read its values.',
                      class_='quiet hint')
    if diagnosis.trace is not None:
        yield element('p', 'The stretch where they differ most:')
        yield _pairs(draw(chart) for chart in _trace(diagnosis.trace))
    for place, curve in guilty:
        before, after = (amount(float(np.abs(each[np.isfinite(each)]).max(initial=0.0)), 'rad/s')
                         for each in (curve.before, curve.after))
        yield element('p', f'Along {spoken(curve.along)}, the error of the simulation is up to '
                      f'{before}' + ('.' if _same(curve)
                                     else f' before the extension, and up to {after} after it.'))
        yield _pairs(draw(chart) for chart in (_predicted(curve, place), _residual(curve, place))
                     if chart is not None)


def _same(curve: Curve) -> bool:
    return bool(np.array_equal(curve.before, curve.after, equal_nan=True))


def _trace(trace: Trace) -> Iterator[Chart]:
    time, measured, simulated, extended = _thinned(trace.time, trace.measured, trace.simulated,
                                                   trace.extended)
    unit, factor = _rate_unit(measured)
    lines = [Line('measured', 'measured', factor * measured),
             Line('simulated', 'simulated', factor * simulated)]
    yield Chart('trace', 'Output of the gyro', 'Measured and simulated output over time.', 'time',
                's', time, 'output', unit, lines)
    unit, factor = _rate_unit(measured - simulated)
    lines = _before_and_after(factor * (measured - simulated), factor * (measured - extended))
    yield Chart('difference', 'Measured less simulated',
                f'What the simulation leaves over time{_when(lines)}.', 'time', 's', time,
                'residual', unit, lines)


def _before_and_after(before: Array, after: Array, deviation: Array | None = None) -> list[Line]:
    """Return a line for each, or a single one where nothing was changed."""
    if np.array_equal(before, after, equal_nan=True):
        return [Line('residual', 'before', before, deviation)]
    return [Line('before', 'before', before, deviation), Line('after', 'after', after, deviation)]


def _when(lines: Sequence[Line]) -> str:
    return ', before and after the extension' if lines[0].name == 'before' else ''


def _across(curve: Curve) -> tuple[str, float]:
    if curve.along == 'time':
        return span(float(np.ptp(curve.at)) if len(curve.at) else 0.0)
    return for_people(curve.unit)


def _rate_unit(values: Array) -> tuple[str, float]:
    """Return the unit in which people read rates up to these, and the factor to it."""
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    return ('deg/h', 3600.0 / DEGREE) if 0.0 < largest < _SLOW else ('deg/s', 1.0 / DEGREE)


def _predicted(curve: Curve, place: int) -> Chart | None:
    """Return the error of the gyro as simulated and as measured."""
    if curve.simulated is None or curve.along == SPECTRUM:
        return None
    measured = curve.simulated + curve.before
    unit, factor = _rate_unit(measured)
    across, scale = _across(curve)
    lines = [Line('measured', 'measured', factor * measured, factor * curve.deviation, dots=True),
             Line('simulated', 'simulated', factor * curve.simulated)]
    if not _same(curve):
        lines.append(Line('simulated, extended', 'after', factor * (measured - curve.after)))
    along = spoken(curve.along)
    return Chart(f'predicted-{place}', f'Error of the gyro along {along}',
                 f'Mean of output less true rate along {along}, as measured and as the simulation '
                 'has it.', along, across, scale * curve.at, 'error', unit, lines)


def _residual(curve: Curve, place: int) -> Chart:
    if curve.along == SPECTRUM:
        return _spectrum(curve, place)
    unit, factor = _rate_unit(np.concatenate([curve.before, curve.after]))
    across, scale = _across(curve)
    lines = _before_and_after(factor * curve.before, factor * curve.after,
                              factor * curve.deviation)
    along = spoken(curve.along)
    return Chart(f'residual-{place}', f'Residual along {along}',
                 f'Mean of what the simulation leaves along {along}{_when(lines)}, with bands of '
                 '95 % by noise alone.', along, across, scale * curve.at, 'residual', unit, lines)


def _spectrum(curve: Curve, place: int) -> Chart:
    """Return the amplitudes of the residual over frequency with those of noise."""
    lines = [*_before_and_after(curve.before / DEGREE, curve.after / DEGREE),
             Line('usual', 'simulated', curve.deviation / DEGREE)]
    return Chart(f'residual-{place}', 'Residual along frequency',
                 'Largest amplitude of the residual in bands of frequency, and the usual one '
                 'there; a line that stands out is a tone.', 'frequency', 'Hz', curve.at,
                 'amplitude', 'deg/s', lines, logarithmic=True)


def _thinned(at: Array, *values: Array) -> list[Array]:
    """Return curves with fewer points: the lowest and the highest of each part, in place."""
    if len(at) <= 4 * _PARTS:
        return [at, *values]
    chosen = {0, len(at) - 1}
    for part in np.array_split(np.arange(len(at)), _PARTS):
        for each in values:
            known = np.isfinite(each[part])
            if known.any():
                chosen |= {int(part[np.nanargmin(each[part])]),
                           int(part[np.nanargmax(each[part])])}
    kept = np.array(sorted(chosen))
    return [each[kept] for each in (at, *values)]


# causes

def _cause(place: int, found: Finding, diagnosis: Diagnosis) -> Markup:
    facts = [*certainty(found), smallest(found), remedy(found, diagnosis)]
    uncertain = (element('p', alternatives(found), class_='uncertain') if found.ambiguous_with
                 else None)
    sizes_of = _folding(['', 'estimate', '95 % interval'], [
        [spoken(name), size.estimate, size.bounds or '–']
        for name, size in sizes(found).items()]) if found.parameters else None
    title = element('h3', element('span', f'{place}', class_='place'), ' ', spoken(found.effect),
                    ' ', element('code', found.effect, class_='quiet')  # as files have it
                    if spoken(found.effect) != clean(found.effect) else None)
    return element('article', title, *(element('p', text) for text in shown_by(found)),
                   sizes_of, uncertain,
                   element('p', ' '.join(filter(None, facts)), class_='quiet'))


def _folding(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """Return a table whose rows become lists on a narrow screen."""
    body = (element('tr', element('th', row[0], scope='row'), *(
        element('td', cell, data_head=head) for head, cell in zip(heads[1:], row[1:])))
        for row in rows)
    table = element('table', element('thead', element('tr', *(
        element('th', head, scope='col') for head in heads))), element('tbody', *body))
    return element('div', table, class_='fold')


# heading, gain, noise

def _gain(diagnosis: Diagnosis) -> Iterator[Markup | None]:
    parts = [] if diagnosis.heading is None else [draw(_heading(diagnosis.heading))]
    if diagnosis.gain is not None:
        errors = _errors(diagnosis.gain)
        yield element('p', ' '.join([
            f'Measured on {clean(diagnosis.gain.held_out)}, which took no part in the choice or '
            'the fit.', *(f'The extended model {change(each, unit, f"the {what}")}.'
                          for what, each, unit in errors)]))
        parts.append(_folding(['rms', 'before', 'after', 'reduction, 95 % interval'], [
            [what, amount(each.before, unit), amount(each.after, unit), _gained(each, unit)]
            for what, each, unit in errors]))
    yield _pairs(parts) if parts else None


def _errors(gain: Gain) -> list[tuple[str, Change, str]]:
    """Return what was measured before and after, with its unit of SI."""
    heading = ([] if gain.heading is None
               else [(f'heading error over {gain.window:g} s', gain.heading, 'rad')])
    return [*heading, ('rate error', gain.rate, 'rad/s')]


def _heading(curve: HeadingCurve) -> Chart:
    time, before, after = _thinned(curve.time, curve.before, curve.after)
    unit, factor = span(float(np.ptp(time)) if len(time) else 0.0)
    lines = _before_and_after(before / DEGREE, after / DEGREE)
    return Chart('heading', 'Heading error over the log',
                 f'Heading error of the simulation{_when(lines)}.', 'time',
                 unit, factor * time, 'heading error', 'deg', lines)


def _allan(curve: NoiseCurve) -> Chart:
    factor = 3600.0 / DEGREE
    lines = [Line('residual', 'measured', factor * curve.measured, dots=True),
             Line('noise as found', 'after', factor * curve.fitted)]
    if curve.simulated is not None:
        lines.append(Line('noise of the simulation', 'simulated', factor * curve.simulated))
    return Chart('noise', 'Allan deviation of the residual',
                 'Allan deviation over averaging time, of the residual and of the noise that is '
                 'simulated.', 'averaging time', 's', curve.averaging_time, 'Allan deviation',
                 'deg/h', lines, logarithmic=True)
