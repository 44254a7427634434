# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Numbers as people read them, and a diagnosis in plain words, for terminal and report."""

from collections.abc import Iterator, Sequence
import math
import re
import textwrap

from gyro_calibration.diagnosis.causes import CAUSES, NOISE_NAMES
from gyro_calibration.diagnosis.findings import (
    DETECTION_POWER, Diagnosis, Estimate, Finding, MIN_PROBABILITY)
from gyro_calibration.files import to_printable
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.gyro_model import have_same_effects

#: SI unit -> displayed unit and the factor to it, except for degrees instead of radians.
_UNITS = {'1': ('%', 100.0), '1/K': ('%/K', 100.0), 'degC': ('°C', 1.0),
          'rad/√s': ('deg/√h', 60.0 / DEGREE), 'rad/s/√s': ('deg/h/√h', 60.0 ** 3 / DEGREE),
          'K/s': ('K/min', 60.0)}
#: Parameters with another displayed unit than others of the same SI unit.
_PARAMETER_UNITS = {
    **{name: (unit, 3600.0 / DEGREE) for name, unit in (
        ('bias_instability', 'deg/h'), ('rate_ramp', 'deg/s/h'))}, 'k': ('s', 1.0),
    **dict.fromkeys(['unit_error', 'outliers', 'stuck_samples', 'dropped_samples'], ('', 1.0))}
#: Unit -> (value below which a finer unit is used, finer unit, factor to it).
_FINER_UNITS = {'s': (0.5, 'ms', 1e3), '%': (0.01, 'ppm', 1e4)}
#: Largest number of causes in one sentence.
_MAX_NAMED_CAUSES = 3


def display_unit(unit: str, parameter: str = '', size: float = math.inf) -> tuple[str, float]:
    """Return the displayed unit for an SI unit, for values up to a size, and the factor to it."""
    if parameter in _PARAMETER_UNITS:
        return _PARAMETER_UNITS[parameter]
    radians = re.search(r'(/?)rad([²³]?)', unit)
    if unit in _UNITS:
        unit, factor = _UNITS[unit]
    elif radians is not None:
        power = {'': 1, '²': 2, '³': 3}[radians[2]] * (-1 if radians[1] else 1)
        return unit.replace('rad', 'deg'), DEGREE ** -power
    else:
        factor = 1.0
    below, finer, many = _FINER_UNITS.get(unit, (0.0, '', 1.0))
    return (finer, factor * many) if 0.0 < abs(size) * factor < below else (unit, factor)


def format_quantity(estimate: Estimate, parameter: str = '') -> str:
    """Return an estimate as people read it, such as 20.1 (19.8 to 20.4) ms."""
    given = estimate.estimate, *estimate.interval
    largest = max(filter(math.isfinite, map(abs, given)), default=0.0)
    unit, factor = display_unit(estimate.unit, parameter, largest)
    power = _display_power(largest * factor)
    value, low, high = (factor * number / 10.0 ** power for number in given)
    # two digits of the half-width of the interval
    digits = '.4g' if largest * factor < 1e4 else '.0f'  # of counts
    if 0.0 < high - low < math.inf:
        digits = f'.{min(max(0, 1 - math.floor(math.log10(0.5 * (high - low)))), 8)}f'
    interval = (f'({_format_fixed(low, digits)} to {_format_fixed(high, digits)})' if high > low
                else '')
    return _join(_format_fixed(value, digits), interval, _power_suffix(power), unit)


def format_amount(value: float, unit: str, parameter: str = '', digits: int = 3) -> str:
    """Return a value of SI as people read it, such as 0.123 deg/s."""
    name, factor = display_unit(unit, parameter, value)
    return _join(format_number(value * factor, digits), name)


def format_number(value: float, digits: int = 3) -> str:
    """Return a number with so many digits."""
    power = _display_power(abs(value))
    fixed = math.isfinite(value) and not power and abs(value) >= 10.0 ** digits
    return _join(_format_fixed(value / 10.0 ** power, '.0f' if fixed else f'.{digits}g'),
                 _power_suffix(power))


def _join(*parts: str) -> str:
    return ' '.join(filter(None, parts))


def _display_power(largest: float) -> int:
    """Return the power of ten to write after numbers up to this one: 0 if not needed."""
    return (0 if not 0.0 < largest < math.inf or 1e-4 <= largest < 1e6
            else math.floor(math.log10(largest)))


def _format_fixed(value: float, digits: str) -> str:
    if not math.isfinite(value):
        return 'not known' if math.isnan(value) else '∞' if value > 0.0 else '−∞'
    text = f'{value:{digits}}'
    return text.replace('-', '−' if float(text) else '')


def _power_suffix(power: int) -> str:
    raised = str(power).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))
    return f'× 10{raised}' if power else ''


def format_probability(probability: float) -> str:
    """Return a probability in words."""
    if math.isnan(probability):
        return 'not known'
    if probability < MIN_PROBABILITY:
        return f'below 1 in {1.0 / MIN_PROBABILITY:,.0f}'.replace(',', ' ')
    if probability >= 0.1:
        return f'{100.0 * probability:.0f} %'
    return f'1 in {float(f"{1.0 / probability:.2g}"):,.0f}'.replace(',', ' ')


def _format_share(share: float) -> str:
    """Return a share in percent, at least 0.1 %."""
    return ('less than 0.1 %' if share < 1e-3 else f'{100.0 * share:.0f} %' if share >= 0.1
            else f'{format_number(100.0 * share, 2)} %')


def readable_name(name: str) -> str:
    """Return the name of an effect or a parameter as words."""
    return to_printable(name).replace('_', ' ')


def join_list(words: Sequence[str], last: str = 'and') -> str:
    """Return words as a list in a sentence."""
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), *words[-1:]]))


def as_sentence(text: str) -> str:
    """Return a text with a capital and a full stop."""
    text = to_printable(text).strip()
    return text if not text else text[0].upper() + text[1:] + ('' if text[-1] in '.!?' else '.')


# the finding in two sentences

def headline(diagnosis: Diagnosis) -> tuple[str, str]:
    """Return two sentences: what the simulation gets wrong, and what the extended model gains."""
    if diagnosis.verdict == 'mismatched':
        (found,) = diagnosis.findings
        return found.cause, f'No cause can be named until this is corrected: {found.remedy}.'
    gain = _gain_sentence(diagnosis)
    if diagnosis.verdict == 'adequate':
        suspected = join_list([readable_name(each.effect) for each in diagnosis.findings])
        reference_errs = bool(diagnosis.reference and diagnosis.reference.noise)
        verdict = ('No difference is established' if reference_errs or suspected
                   else 'Simulation and measurement differ by no more than noise')
        return (verdict + ' beyond the errors of the reference' * reference_errs
                + f'; suspected: {suspected}' * bool(suspected) + '.', gain)

    parts = []
    established = sorted((each for each in diagnosis.findings if each.status == 'established'),
                         key=lambda each: -(each.share_of_heading_error or 0.0))
    if established:
        parts.append('because of ' + f'{len(established)} causes: ' * (len(established) > 1)
                     + _list_causes(established))
    if unexplained := diagnosis.unexplained:
        most = max(each.share_of_variance for each in unexplained)
        up_to = 'up to ' if len(unexplained) > 1 and most >= 1e-3 else ''
        variables = join_list([readable_name(each.along)
                               for each in unexplained[:_MAX_NAMED_CAUSES]])
        parts.append(f'along {variables} by {"something" if parts else "structure"} that no cause '
                     f'in the catalogue explains ({up_to}{_format_share(most)} of the variance of '
                     'the residual)')
    return f'Simulation and measurement differ {", and ".join(parts)}.', gain


def _list_causes(findings: Sequence[Finding]) -> str:
    shown, effects = [], [each.effect for each in findings]
    for found in findings[:_MAX_NAMED_CAUSES]:
        name, others = readable_name(found.effect), [*map(readable_name, found.ambiguous_with)]
        sizes = [format_quantity(value, key) for key, value in found.parameters.items()][:1]
        if len(findings) == 1 and not others:
            return ': '.join([name, *sizes])
        if len(findings) == 1:
            return '; '.join([f'{join_list([name, *others], "or")}, which these data cannot '
                              'distinguish', *(f'taken as {name} it is {each}' for each in sizes)])
        if found.where and effects.count(found.effect) > 1:
            name += f' at {found.where[0]:.4g} s'
        shown.append(name + (f' (or {join_list(others, "or")})' if others else ''))
    return join_list([*shown, *[f'{len(findings) - _MAX_NAMED_CAUSES} more'] * (
        len(findings) > _MAX_NAMED_CAUSES)])


def verdict_phrase(diagnosis: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if diagnosis.verdict == 'extended':
        return ('Extended: causes were found' if is_model_extended(diagnosis)
                else 'Not extended: causes were found, none was added to the model')
    return {'adequate': 'Adequate: no cause was found',
            'unexplained': 'Unexplained: a difference has no known cause',
            'mismatched': 'Mismatched: gyro and reference do not belong together'}[
                diagnosis.verdict]


def is_model_extended(diagnosis: Diagnosis) -> bool:
    """Tell whether the model was extended: its effects, their values or its noise."""
    before, after = diagnosis.before, diagnosis.model
    return ((bool(diagnosis.findings) or before.prior_deviations is not None)
            and not (have_same_effects(before, after) and before.noise == after.noise))


def is_in_extended_model(found: Finding, diagnosis: Diagnosis) -> bool:
    """Tell whether the extended model has a cause: by a new value, and by shapes if several."""
    alone = sum(each.effect == found.effect for each in diagnosis.findings) == 1
    return is_model_extended(diagnosis) and any(
        alone or all(found.parameters[shape.name].estimate == value
                     for shape, value in zip(term.effect.nonlinear_parameters, term.values)
                     if shape.name in found.parameters) for term in diagnosis.model.terms
        if term.effect.name == found.effect and term not in diagnosis.before.terms)


def _gain_sentence(diagnosis: Diagnosis) -> str:
    gain, is_extended = diagnosis.gain, is_model_extended(diagnosis)
    if not is_extended and (
            gain is None or gain.models.get('given') == gain.models.get('extended')):
        return 'No extended model is offered: the model is unchanged.'
    if gain is None:
        return 'An extended model is offered; its gain was not measured.'
    model = 'The extended model'
    if not diagnosis.model.terms:
        model = 'A model with the best bias and scale factor error is not offered: it'
    elif not is_extended:
        model = 'The model, of bias and scale factor error alone,'
    what, change, unit = gain.rows()[0]
    does, note = 'changes', '; the 95 % interval of the reduction includes zero'
    if change.interval is None:
        note = '; one part was held out, so there is no interval'
    elif change.interval[0] > 0.0 or change.is_worse:
        does, note = 'increases' if change.is_worse else 'reduces', ''
    return (f'{model} {does} the {what} from {format_amount(change.before, unit)} to '
            f'{format_amount(change.after, unit)} rms{note}, measured on '
            f'{to_printable(gain.held_out)}.')


# causes, and lists of what else there is to say

def cause_title(found: Finding) -> str:
    """Return the name of a cause with its parameters."""
    parameters = [_join('' if name == found.effect else readable_name(name),
                        format_quantity(value, name)) for name, value in found.parameters.items()]
    return ': '.join(filter(None, [readable_name(found.effect), ', '.join(parameters)]))


def cause_paragraphs(found: Finding, diagnosis: Diagnosis) -> list[str]:
    """Return a cause in words: what it is, how sure it is, its alternatives, and the remedy."""
    status = found.status.capitalize()
    if found.where is not None:
        status += ' in {:.4g} to {:.4g} s of the log'.format(*found.where)
    if found.p_value:
        status += f'; probability by noise alone: {format_probability(found.p_value)}'
    elif status == 'Established':  # seen in the samples themselves, without a test
        status = ''
    detectable = ''
    if found.minimum_detectable is not None and found.parameters:
        name, first = next(iter(found.parameters.items()))
        detectable = ('smallest detectable: '
                      f'{format_amount(found.minimum_detectable, first.unit, name, 2)} in '
                      f'{100.0 * DETECTION_POWER:g} % of logs')
    paragraphs = [_join(*map(as_sentence, (found.cause, found.evidence, status, detectable)))]
    if found.ambiguous_with:
        others = join_list([readable_name(name) for name in found.ambiguous_with], 'or')
        experiment = found.separate_by.rstrip('.')
        way = ('' if experiment and experiment in found.remedy
               else f' To distinguish them: {experiment}.' if experiment
               else ' No experiment is known that would distinguish them.')
        paragraphs.append(as_sentence(f'These data do not exclude {others} instead.{way}'))
    if is_in_extended_model(found, diagnosis):
        paragraphs.append('It is in the extended model.')
    elif found.remedy:
        paragraphs.append(as_sentence(f'remedy: {found.remedy}'))
    return list(filter(None, paragraphs))


def lists(diagnosis: Diagnosis) -> Iterator[tuple[str, list[str]]]:
    """Give titles with sentences: structure without a name, shares, what cannot be shown."""
    if diagnosis.unexplained:
        yield 'Structure that no cause explains', [
            f'Along {readable_name(each.along)}: {_format_share(each.share_of_variance)} of the '
            'variance of the residual; probability by noise alone: '
            f'{format_probability(each.p_value)}.' for each in diagnosis.unexplained]
    if shares := diagnosis.heading_shares:
        names = {'reference': 'errors of the reference', 'left': 'not explained'}
        yield ('Shares of the mean square heading error over 60 s'
               + ', more than 100 % together where causes cancel each other' * (
                   round(sum(shares.values()), 2) > 1.0),
               [f'{names.get(name, readable_name(name))}: {_format_share(share)}'
                for name, share in sorted(shares.items(), key=lambda each: -each[1])])
    if diagnosis.cannot_show:
        reasons: dict[str, list[str]] = {}
        for name, reason in diagnosis.cannot_show.items():
            reasons.setdefault(as_sentence(reason), []).append(readable_name(name))
        yield 'These data cannot show', [f'{join_list(names)}: {reason}'
                                         for reason, names in reasons.items()]
    if diagnosis.remarks:
        yield 'Remarks', list(map(as_sentence, diagnosis.remarks))


def noise_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Return the name of each noise figure, that of the residual, and that of the simulation."""
    def format_value(value: float, name: str) -> str:
        return format_amount(value, CAUSES[name].unit, name) if value else 'none'
    return [(readable_name(name), format_value(getattr(diagnosis.noise, name), name),
             format_value(getattr(diagnosis.simulated, name), name)) for name in NOISE_NAMES]


def terminal_lines(diagnosis: Diagnosis) -> Iterator[str]:
    """Give the diagnosis for a terminal: the finding in two sentences, then a short list."""
    yield from map(wrap_line, headline(diagnosis))
    for place, found in enumerate(diagnosis.findings, 1):
        mark = f'{place}. '
        yield ''
        yield wrap_line(f'{mark}{cause_title(found)}', len(mark))
        for text in cause_paragraphs(found, diagnosis):
            yield wrap_line(' ' * len(mark) + text, len(mark))
    for title, texts in lists(diagnosis):
        yield from ('', f'{title}:', *(wrap_line(f'- {text}', 2) for text in texts))


def wrap_line(text: str, indent: int = 0) -> str:
    """Return a text wrapped to lines of at most 120 characters."""
    return textwrap.fill(text, 120, subsequent_indent=' ' * indent, break_long_words=False,
                         break_on_hyphens=False)
