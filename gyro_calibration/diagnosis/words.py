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

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import math
import re
import textwrap
import unicodedata

from gyro_calibration.diagnosis.findings import (
    Change,
    Diagnosis,
    Estimate,
    Finding,
    MIN_PROBABILITY,
    Unexplained,
)
from gyro_calibration.logs.log import DEGREE, NORMAL_QUANTILE_975
from gyro_calibration.model.gyro_model import GyroModel, have_same_effects

_HOUR = 3600.0

#: SI unit -> displayed unit and the factor to it, except for degrees instead of radians.
_UNITS = {'1': ('%', 100.0), '1/K': ('%/K', 100.0), 'degC': ('°C', 1.0),
          'rad/√s': ('deg/√h', math.sqrt(_HOUR) / DEGREE),
          'rad/s/√s': ('deg/h/√h', _HOUR ** 1.5 / DEGREE), 'K/s': ('K/min', 60.0)}
#: Parameters with another displayed unit than others of the same SI unit.
_PARAMETER_UNITS = {
    'bias_instability': ('deg/h', _HOUR / DEGREE),
    'rate_ramp': ('deg/s/h', _HOUR / DEGREE),
    'k': ('s', 1.0),
    'unit_error': ('', 1.0),
    'outliers': ('', 1.0),
    'stuck_samples': ('', 1.0),
    'dropped_samples': ('', 1.0)}
#: (unit, value below which a finer unit is used, finer unit, factor to it).
_FINER_UNITS = (('s', 0.5, 'ms', 1e3), ('%', 0.01, 'ppm', 1e4))
_RADIANS = re.compile(r'(/?)rad([²³]?)')


def display_unit(unit: str, parameter: str = '') -> tuple[str, float]:
    """Return the displayed unit for an SI unit, and the factor to it."""
    if parameter in _PARAMETER_UNITS or unit in _UNITS:
        return _PARAMETER_UNITS.get(parameter) or _UNITS[unit]
    radians = _RADIANS.search(unit)
    if radians is None:
        return unit, 1.0
    power = {'': 1, '²': 2, '³': 3}[radians[2]] * (-1 if radians[1] else 1)
    return unit.replace('rad', 'deg'), DEGREE ** -power


@dataclass(frozen=True)
class Quantity:
    """
    An estimate as text, in the displayed unit and with its significant digits.

    Attributes
    ----------
    value, interval : both without the power of ten; the interval is empty without one
    power : such as × 10⁻⁵; empty without one
    unit : as displayed

    """

    value: str
    interval: str
    power: str
    unit: str

    def __str__(self) -> str:
        """Return it for a sentence, such as 20.1 (19.8 to 20.4) ms."""
        return _join_words(self.value, f'({self.interval})' if self.interval else '', self.power,
                           self.unit)

    @property
    def estimate(self) -> str:
        """Return the value alone."""
        return _join_words(self.value, self.power, self.unit)

    @property
    def bounds(self) -> str:
        """Return the interval alone, without the unit."""
        return (_join_words(f'({self.interval})', self.power) if self.interval and self.power
                else self.interval)


def _join_words(*parts: str) -> str:
    return ' '.join(filter(None, parts))


def format_quantity(estimate: Estimate, parameter: str = '') -> Quantity:
    """Return an estimate as people read it."""
    unit, factor = display_unit(estimate.unit, parameter)
    given = estimate.estimate, *estimate.interval
    unit, factor = _finer_unit(unit, factor,
                               max(filter(math.isfinite, map(abs, given)), default=0.0), parameter)
    numbers = [factor * number for number in given]
    power = _display_power(
        max((abs(number) for number in numbers if math.isfinite(number)), default=0.0))
    value, low, high = (number / 10.0 ** power for number in numbers)
    width = high - low
    # two digits of the half-width of the interval
    decimals = (min(max(0, 1 - math.floor(math.log10(0.5 * width))), 8) if 0.0 < width < math.inf
                else None)
    interval = (f'{_format_fixed(low, decimals)} to {_format_fixed(high, decimals)}' if width > 0.0
                else '')
    return Quantity(_format_fixed(value, decimals), interval, _power_suffix(power), unit)


def _finer_unit(unit: str, factor: float, value: float, parameter: str) -> tuple[str, float]:
    for name, below, finer, many in _FINER_UNITS:
        if (unit == name and 0.0 < abs(value * factor) < below
                and parameter not in _PARAMETER_UNITS):
            return finer, factor * many
    return unit, factor


def _display_power(largest: float) -> int:
    """Return the power of ten to write after numbers up to this one: 0 if not needed."""
    return 0 if largest == 0.0 or 1e-4 <= largest < 1e6 else math.floor(math.log10(largest))


def _format_fixed(value: float, decimals: int | None) -> str:
    if not math.isfinite(value):
        return 'not known' if math.isnan(value) else '∞' if value > 0.0 else '−∞'
    text = f'{value:.4g}' if decimals is None else f'{value:.{decimals}f}'
    return text.replace('-', '−' if float(text) else '')


def _power_suffix(power: int) -> str:
    return f'× 10{superscript(power)}' if power else ''


def superscript(power: int) -> str:
    """Return a power as it is written after a ten."""
    return str(power).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))


def format_amount(value: float, unit: str, parameter: str = '', digits: int = 3) -> str:
    """Return a value of SI as people read it, such as 0.123 deg/s."""
    name, factor = display_unit(unit, parameter)
    name, factor = _finer_unit(name, factor, value, parameter)
    return _join_words(format_number(value * factor, digits), name)


def format_number(value: float, digits: int = 3) -> str:
    """Return a number with so many digits."""
    if not math.isfinite(value):
        return _format_fixed(value, None)
    power = _display_power(abs(value))
    text = (f'{value / 10.0 ** power:.{digits}g}' if abs(value) < 10.0 ** digits or power
            else f'{value:.0f}')
    return _join_words(text, _power_suffix(power)).replace('-', '−')


def time_unit(seconds: float) -> tuple[str, float]:
    """Return the unit in which people read times up to this one, and the factor to it."""
    for unit, size, most in (('s', 1.0, 600.0), ('min', 60.0, 4.0 * _HOUR)):
        if seconds <= most:
            return unit, 1.0 / size
    return 'h', 1.0 / _HOUR


def format_probability(probability: float) -> str:
    """Return a probability in words."""
    if math.isnan(probability):
        return 'not known'
    if probability < MIN_PROBABILITY:
        return f'below 1 in {1.0 / MIN_PROBABILITY:,.0f}'.replace(',', ' ')
    if probability >= 0.1:
        return f'{100.0 * probability:.0f} %'
    return f'1 in {float(f"{1.0 / probability:.2g}"):,.0f}'.replace(',', ' ')


#: Largest length of lines for a terminal.
_LINE_WIDTH = 120
#: Largest number of causes in one sentence.
_MAX_NAMED_CAUSES = 3
_NOISE_UNITS = {'angle_random_walk': 'rad/√s', 'bias_instability': 'rad/s',
                'rate_random_walk': 'rad/s/√s'}


def sanitize_text(text: str) -> str:
    """Return a text, such as a file name, without control characters."""
    plain = text.encode(errors='replace').decode()
    return ''.join('\ufffd' if unicodedata.category(each) in ('Cc', 'Cf') else each
                   for each in plain)


def readable_name(name: str) -> str:
    """Return the name of an effect or a parameter as words."""
    return sanitize_text(name).replace('_', ' ')


def join_list(words: Sequence[str], last: str = 'and') -> str:
    """Return words as a list in a sentence."""
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), *words[-1:]]))


def as_sentence(text: str) -> str:
    """Return a text with a capital and a full stop."""
    text = sanitize_text(text).strip()
    return text if not text else text[0].upper() + text[1:] + ('' if text[-1] in '.!?' else '.')


# the finding in two sentences

def headline(diagnosis: Diagnosis) -> tuple[str, str]:
    """Return two sentences: what the simulation gets wrong, and what the extended model gains."""
    if diagnosis.verdict == 'mismatched':
        (found,) = diagnosis.findings
        return found.cause, f'No cause can be named until this is corrected: {found.remedy}.'
    if diagnosis.verdict == 'adequate':
        return ('Simulation and measurement differ by no more than noise.',
                _gain_sentence(diagnosis))
    parts = []
    if established := [each for each in diagnosis.findings if each.status == 'established']:
        parts.append(f'because of {_cause_list_phrase(established)}')
    if unexplained := diagnosis.unexplained:
        most = max(each.share_of_variance for each in unexplained)
        up_to = 'up to ' if len(unexplained) > 1 and most >= 1e-3 else ''
        variables = join_list([readable_name(each.along)
                               for each in unexplained[:_MAX_NAMED_CAUSES]])
        parts.append(f'along {variables} by {"something" if parts else "structure"} that no cause '
                     f'in the catalogue explains ({up_to}{_format_share(most)} of the variance of '
                     'the residual)')
    return f'Simulation and measurement differ {", and ".join(parts)}.', _gain_sentence(diagnosis)


def _cause_list_phrase(findings: Sequence[Finding]) -> str:
    if len(findings) > 1:
        shown = [readable_name(each.effect) + (' (or {})'.format(
            join_list([readable_name(name) for name in each.ambiguous_with], 'or'))
            if each.ambiguous_with else '') for each in findings[:_MAX_NAMED_CAUSES]]
        more = ([f'{len(findings) - _MAX_NAMED_CAUSES} more'] if len(findings) > _MAX_NAMED_CAUSES
                else [])
        return f'{len(findings)} causes: {join_list(shown + more)}'
    (found,) = findings
    size = next(iter(parameter_quantities(found).values()), None)
    if not found.ambiguous_with:
        return readable_name(found.effect) + ('' if size is None else f': {size}')
    taken = '' if size is None else f'; taken as {readable_name(found.effect)} it is {size}'
    names = join_list([readable_name(name) for name in (found.effect, *found.ambiguous_with)],
                      'or')
    return f'{names}, which these data cannot distinguish{taken}'


def verdict_phrase(diagnosis: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if diagnosis.verdict == 'extended':
        return ('Extended: causes were found' if is_model_extended(diagnosis)
                else 'Not extended: causes were found, none was added to the model')
    return {'adequate': 'Adequate: no cause was found',
            'unexplained': 'Unexplained: a difference has no known cause',
            'mismatched': 'Mismatched: gyro and reference do not belong together'}[
                diagnosis.verdict]


def heading_error_sentence(diagnosis: Diagnosis) -> str:
    """Return the shares of refitted values and of named causes in the heading error."""
    shares = diagnosis.heading_shares
    named = {each.effect for each in diagnosis.findings if each.status == 'established'}
    if not (shares and named):
        return ''
    refitted = [name for name in ('bias', 'scale_factor_error')
                if name in shares and name not in named]
    parts = []
    if refitted:
        parts.append(f'{_format_share(sum(shares[name] for name in refitted))} is '
                     f'{join_list(list(map(readable_name, refitted)))}, refitted in any case')
    causes = [shares[name] for name in named & set(shares)]
    parts.append(f'{_format_share(sum(causes))} is of the named causes' if causes
                 else 'no part is of the named causes')
    return f'Of the mean square heading error over 60 s, {", and ".join(parts)}.'


def parameter_quantities(found: Finding) -> dict[str, Quantity]:
    """Return the parameters of a cause as people read them."""
    return {name: format_quantity(value, name) for name, value in found.parameters.items()}


def _format_share(share: float) -> str:
    """Return a share in percent, at least 0.1 %."""
    return ('less than 0.1 %' if share < 1e-3 else f'{100.0 * share:.0f} %' if share >= 0.1
            else f'{format_number(100.0 * share, 2)} %')


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
    model = ('The extended model' if is_extended
             else f'The model, {_model_values_phrase(diagnosis.model)} alone,')
    if gain is None:
        return 'An extended model is offered; its gain was not measured.'
    if gain.heading is None:
        return (f'{model} {change_phrase(gain.rate, "rad/s", "the rate error")}, measured on '
                f'{sanitize_text(gain.held_out)}.')
    what = f'the heading error over {gain.window:g} s'
    return (f'{model} {change_phrase(gain.heading, "rad", what)}, measured on '
            f'{sanitize_text(gain.held_out)}.')


def _model_values_phrase(model: GyroModel) -> str:
    """Return the fitted values of a model with their intervals of 95 %."""
    return ' and '.join(
        f'{readable_name(effect)} '
        f'{format_quantity(Estimate.from_half_width(value, half, parameter.unit), effect)}'
        for effect, parameter, value, deviation in model.estimates()
        for half in [NORMAL_QUANTILE_975 * deviation if math.isfinite(deviation) else 0.0])


def change_phrase(errors: Change, unit: str, what: str) -> str:
    """Return the change of an error, as the end of a sentence."""
    before, after = (format_amount(value, unit) for value in (errors.before, errors.after))
    if errors.interval is None:
        return (f'changes {what} from {before} to {after} rms; one part was held out, so there '
                'is no interval')
    if errors.interval[0] > 0.0:
        return f'reduces {what} from {before} to {after} rms'
    if errors.is_worse:
        return f'increases {what} from {before} to {after} rms'
    return (f'changes {what} from {before} to {after} rms; the 95 % interval of the reduction '
            'includes zero')


# single causes

def cause_sentences(found: Finding) -> list[str]:
    """Return description and evidence of a cause, a sentence each."""
    return [as_sentence(text) for text in (found.cause, found.evidence) if text.strip()]


def certainty_sentences(found: Finding) -> list[str]:
    """Return whether a cause is confirmed, its probability by noise alone, and where it is."""
    status = 'Suspected' if found.status == 'suspected' else 'Established'
    where = '' if found.where is None else ' in {:.4g} to {:.4g} s of the log'.format(*found.where)
    if not found.p_value:  # seen in the samples themselves, without a test
        return [f'{status}{where}.'] if where or found.status == 'suspected' else []
    return [f'{status}{where}; probability by noise alone: {format_probability(found.p_value)}.']


def remedy_sentence(found: Finding, diagnosis: Diagnosis) -> str:
    """Return what to do about a cause, as a sentence; empty where nothing is known."""
    if is_in_extended_model(found, diagnosis):
        return 'It is in the extended model.'
    return f'Remedy: {sanitize_text(found.remedy).rstrip(".")}.' if found.remedy else ''


def alternatives_sentence(found: Finding) -> str:
    """Return the alternatives and the experiment that would distinguish them; '' without any."""
    if not found.ambiguous_with:
        return ''
    others = join_list([readable_name(name) for name in found.ambiguous_with], 'or')
    experiment = sanitize_text(found.separate_by).rstrip('.')
    way = (f' To distinguish them: {experiment}.' if experiment
           else ' No experiment is known that would distinguish them.')
    stated = experiment and experiment in found.remedy
    return f'These data do not exclude {others} instead.{"" if stated else way}'


def detectability_sentence(found: Finding) -> str:
    """Return the smallest detectable size, as a sentence; empty where that has no meaning."""
    if found.minimum_detectable is None or not found.parameters:
        return ''
    name, first = next(iter(found.parameters.items()))
    return f'Smallest detectable: {format_amount(found.minimum_detectable, first.unit, name, 2)}.'


def structure_sentence(each: Unexplained) -> str:
    """Return share and probability of structure that no cause explains."""
    share = _format_share(each.share_of_variance)
    return (f'Along {readable_name(each.along)}: {share} of the variance of the residual; '
            f'probability by noise alone: {format_probability(each.p_value)}.')


def heading_share_rows(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Return each cause, the reference and the rest with their parts of the heading error."""
    names = {'reference': 'errors of the reference', 'left': 'not explained'}
    return [(names.get(name, readable_name(name)), _format_share(share))
            for name, share in sorted(diagnosis.heading_shares.items(), key=lambda each: -each[1])]


def noise_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Return the name of each noise figure, that of the residual, and that of the simulation."""
    def format_value(value: float, name: str) -> str:
        return format_amount(value, _NOISE_UNITS[name], name) if value else 'none'
    return [(readable_name(name), format_value(getattr(diagnosis.noise, name), name),
             format_value(getattr(diagnosis.simulated, name), name)) for name in _NOISE_UNITS]


def causes_by_reason(cannot_show: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the causes that the logs cannot show, by the reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in cannot_show.items():
        reasons.setdefault(as_sentence(reason), []).append(readable_name(name))
    return reasons


# for a terminal

def terminal_lines(diagnosis: Diagnosis) -> Iterator[str]:
    """Give the diagnosis for a terminal: the finding in two sentences, then a short list."""
    yield from map(_wrap_line, headline(diagnosis))
    for place, found in enumerate(diagnosis.findings, 1):
        mark = f'{place}. '
        parameters = [str(size) if name == found.effect else f'{readable_name(name)} {size}'
                      for name, size in parameter_quantities(found).items()]
        yield ''
        yield _wrap_line(f'{mark}{readable_name(found.effect)}{": " if parameters else ""}'
                         f'{", ".join(parameters)}', len(mark))
        for text in (' '.join([*cause_sentences(found), *certainty_sentences(found),
                               detectability_sentence(found)]), alternatives_sentence(found),
                     remedy_sentence(found, diagnosis)):
            if text:
                yield _wrap_line(' ' * len(mark) + text, len(mark))
    for title, items in (('Structure that no cause explains:',
                          map(structure_sentence, diagnosis.unexplained)),
                         ('Shares of the mean square heading error over 60 s'
                          + (', above 100 % where causes cancel each other:'
                             if max(diagnosis.heading_shares.values(), default=0.0) > 1.0
                             else ':'),
                          [f'{name}: {share}' for name, share in heading_share_rows(diagnosis)]),
                         ('These data cannot show:',
                          [f'{join_list(names)}: {reason}'
                           for reason, names in causes_by_reason(diagnosis.cannot_show).items()]),
                         ('Remarks:', map(as_sentence, diagnosis.remarks))):
        if texts := list(items):
            yield from ('', title, *(_wrap_line(f'- {text}', 2) for text in texts))


def _wrap_line(text: str, indent: int = 0) -> str:
    return textwrap.fill(text, _LINE_WIDTH, subsequent_indent=' ' * indent, break_long_words=False,
                         break_on_hyphens=False)
