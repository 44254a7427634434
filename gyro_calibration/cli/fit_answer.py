# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The answer of the verb fit: as data in SI, and in words, in units that people use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
import textwrap
from typing import Any

from gyro_calibration.calibration.dwells import listed
from gyro_calibration.calibration.encoder import EncoderCalibration
from gyro_calibration.calibration.rate_table import Bin, binned, Calibration
from gyro_calibration.calibration.scatter import FEWEST_SWEEPS
from gyro_calibration.calibration.selection import Selection
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import Parameter, polynomial_to_matrix
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import POLYNOMIAL
import numpy as np

#: A larger heading error after calibration gives a warning, rad.
_LARGE_ERROR = 5.0 * DEGREE
#: Lines for people are not longer.
_WIDTH = 120
#: What people read instead of the unit of the file, and the factor to it.
_UNITS = {'rad/s': ('deg/s', 1 / DEGREE), 'rad/s/K': ('deg/s/K', 1 / DEGREE),
          'rad/s/K²': ('deg/s/K²', 1 / DEGREE), 's/rad': ('s/deg', DEGREE),
          's²/rad²': ('s²/deg²', DEGREE ** 2)}


# as data

def model_data(model: GyroModel) -> dict[str, Any]:
    """Return covariance, ranges and technology of a model."""
    return {'covariance': None if model.covariance is None else model.covariance.tolist(),
            'rate_range_rad_s': list(model.rate_range),
            'temperature_range_degc': [_finite(end) for end in model.temperature_range],
            'reference_temperature_degc': model.reference_temperature,
            'technology': model.gyro.get('technology')}


def value_data(model: GyroModel) -> dict[str, dict[str, Any]]:
    """Return the fitted values with their intervals, by effect and parameter."""
    values: dict[str, dict[str, Any]] = {}
    for effect, parameter, value, deviation in _fitted(model):
        known = math.isfinite(deviation)
        values.setdefault(effect, {})[parameter.name] = {
            'estimate': value, 'standard_deviation': deviation if known else None,
            'ci95': [value - 1.96 * deviation, value + 1.96 * deviation] if known else None,
            'unit': parameter.unit}
    return values


def _fitted(model: GyroModel) -> Iterator[tuple[str, Parameter, float, float]]:
    """Give effect name, parameter, value and standard deviation of each fitted value."""
    count = sum(len(term.fitted) for term in model.terms)
    deviations = iter([math.nan] * count if model.covariance is None
                      else np.sqrt(np.diag(model.covariance)).tolist())
    for term in model.terms:
        for place in term.fitted:
            yield (term.effect.name, term.effect.parameters[place], term.values[place],
                   next(deviations))


def dwell_data(selection: Selection) -> dict[str, Any]:
    """Return how good a calibration from dwells is, and why it has these effects."""
    fit = selection.calibration
    table, scatter = fit.dwells, fit.scatter
    return {
        'dwells': len(table), 'sweeps': len(np.unique(table.sweep)),
        'outlying': [table.place[row] for row in np.flatnonzero(~scatter.kept)],
        'condition': fit.condition, 'folded_beyond_rad_s': fit.folded_beyond,
        'rms_before_rad_s': fit.before_rms, 'rms_residual_rad_s': fit.residual_rms,
        'rms_left_out_rad_s': _finite(fit.left_out_rms),
        'scatter': {'dwell_rad_s': scatter.dwell, 'dwell_scale': scatter.dwell_scale,
                    'sweep_bias_rad_s': scatter.sweep_bias, 'sweep_scale': scatter.sweep_scale},
        'choices': [{
            'effect': choice.effect, 'taken': choice.taken,
            'left_out_without_rad_s': _finite(choice.without),
            'left_out_with_rad_s': _finite(choice.with_it), 'chance': _finite(choice.chance),
            'reason': choice.reason} for choice in selection.choices],
        'look_alikes': [{
            'taken': pair.taken, 'other': pair.other, 'sigmas': pair.sigmas,
            'parted': pair.distinguishable, 'parting_rate_rad_s': pair.rate,
            'reason': pair.reason} for pair in selection.confounders],
        'by_rate': [_bin_data(part, 'rad_s') for part in binned(fit, table.rate)],
        'by_temperature': [] if table.temperature is None
        else [_bin_data(part, 'degc') for part in binned(fit, table.temperature)],
    }


def _bin_data(part: Bin, unit: str) -> dict[str, Any]:
    return {f'from_{unit}': part.low, f'to_{unit}': part.high, 'dwells': part.count,
            'mean_before_rad_s': part.before, 'mean_residual_rad_s': part.residual,
            'standard_deviation_rad_s': part.deviation, 'rms_rad_s': part.rms}


def matrix_of(model: GyroModel) -> list[list[float]] | None:
    """Return the polynomial of a model as the matrix C of Ojeda et al., eq. 11, or None."""
    for term in model.terms:
        if term.effect.name == POLYNOMIAL:
            matrix: list[list[float]] = polynomial_to_matrix(term.effect, term.values).tolist()
            return matrix
    return None


def heading_data(found: EncoderCalibration) -> dict[str, Any]:
    """Return how good a calibration from a reference heading is."""
    fit = found.fit
    return {'time_offset_s': _finite(fit.time_offset),
            'angle_random_walk_rad_per_root_s': _finite(fit.angle_random_walk),
            'reference_noise_rad': _finite(fit.reference_noise),
            'lost_samples': found.lost_samples,
            'rms_heading_before_rad': found.before.rms, 'rms_heading_after_rad': found.after.rms,
            'largest_heading_before_rad': found.before.largest,
            'largest_heading_after_rad': found.after.largest}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# in words

def sentences(remarks: Sequence[str]) -> Iterator[str]:
    """Give remarks as sentences."""
    yield from (_wrapped(f'{remark[0].upper()}{remark[1:]}.') for remark in remarks)


def _wrapped(text: str, indent: int = 0) -> str:
    return textwrap.fill(text, _WIDTH, subsequent_indent=' ' * indent, break_long_words=False,
                         break_on_hyphens=False)


def value_lines(model: GyroModel) -> Iterator[str]:
    """Give the table of fitted values."""
    yield f'{"value":38s} {"estimate":>12s} {"std. dev.":>10s}   {"95 % interval":27s} unit'
    for effect, parameter, value, deviation in _fitted(model):
        unit, factor = _UNITS.get(parameter.unit, (parameter.unit, 1.0))
        name = effect if parameter.name == effect else f'{effect} {parameter.name}'
        low, high = ((value + sign * 1.96 * deviation) * factor for sign in (-1, 1))
        sure = (f'{deviation * factor:10.2g}   {f"{low:.5g} to {high:.5g}":27s}'
                if math.isfinite(deviation) else f'{"-":>10s}   {"-":27s}')
        yield f'{name:38s} {value * factor:12.5g} {sure} {unit}'
    for temperature in {term.values[0] for term in model.terms
                        if term.effect.parameters[0].name == 'reference_temperature'}:
        yield f'Temperatures are counted from {temperature:g} degC.'


def dwell_lines(fit: Calibration) -> Iterator[str]:
    """Give the dwells that were measured, and those that were not fitted."""
    table = fit.dwells
    slowest, fastest = (rate / DEGREE for rate in (table.rate.min(), table.rate.max()))
    temperatures = ('' if table.temperature is None else
                    f', {table.temperature.min():.1f} to {table.temperature.max():.1f} degC')
    sweeps = len(np.unique(table.sweep))
    yield (f'{len(table)} dwells in {sweeps} sweep{"s" if sweeps > 1 else ""}, '
           f'{slowest:.1f} to {fastest:.1f} deg/s{temperatures}.')
    outlying = np.flatnonzero(~fit.scatter.kept)
    if len(outlying):
        named = listed([f'{table.place[row]} ({fit.residual[row] / DEGREE:+.3f} deg/s)'
                        for row in outlying])
        yield _wrapped(f'{len(outlying)} outlying, not fitted: {named}.')
    yield from sentences(table.remarks)


def quality_lines(fit: Calibration) -> Iterator[str]:
    """Give the size of the errors, and warnings."""
    scatter, several = fit.scatter, len(np.unique(fit.dwells.sweep)) >= FEWEST_SWEEPS
    part = 'sweeps' if several else 'blocks of time'
    yield (f'Error {fit.before_rms / DEGREE:.4f} deg/s rms before, '
           f'{fit.residual_rms / DEGREE:.4f} after; '
           + (f'{fit.left_out_rms / DEGREE:.4f} in {part} left out of the fit.'
              if math.isfinite(fit.left_out_rms)
              else f'no cross-validation, since some values depend on one of the {part} only.'))
    wander = (f'sweeps by {scatter.sweep_bias / DEGREE:.4f} deg/s '
              f'and {100.0 * scatter.sweep_scale:.3f} %' if several
              else f'the scatter of sweeps needs at least {FEWEST_SWEEPS} sweeps')
    yield _wrapped(f'Dwells scatter by {scatter.dwell / DEGREE:.4f} deg/s '
                   f'and {100.0 * scatter.dwell_scale:.3f} % of the rate, {wander}. '
                   f'Condition number {fit.condition:.1f}.')
    excess = math.sqrt(fit.misfit / fit.freedom) if fit.freedom else 1.0
    if excess > 1.2:
        yield _wrapped(f'The residual is {excess:.1f} times the scatter of the dwells about a '
                       'smooth surface: the model lacks an effect. The intervals are widened by '
                       'this factor.')
    if fit.folded_beyond is not None:
        yield _wrapped(f'Above {fit.folded_beyond / DEGREE:.0f} deg/s the modelled output does '
                       'not increase with the rate, so one output has two rates: do not use the '
                       'model there.')
    if not fit.freedom:
        yield _wrapped('There are as many values as dwells, so their standard deviations are '
                       'unknown: add dwells.')


def bin_lines(fit: Calibration) -> Iterator[str]:
    """Give the tables of residuals by rate and by temperature."""
    table = fit.dwells
    for name, unit, factor, values in (('rate', 'deg/s', 1 / DEGREE, table.rate),
                                       ('temperature', 'degC', 1.0, table.temperature)):
        if values is None or np.ptp(values) == 0.0:
            continue
        yield (f'{f"by {name}, {unit}":22s} {"dwells":>6s} {"mean error before":>18s} '
               f'{"residual":>10s} {"+-":>8s} {"rms":>8s}  deg/s')
        for part in binned(fit, values):
            place = f'{part.low * factor:.1f} to {part.high * factor:.1f}'
            before, residual, deviation, rms = (
                value / DEGREE for value in (part.before, part.residual, part.deviation, part.rms))
            yield (f'{place:22s} {part.count:6d} {before:18.4f} {residual:10.4f} '
                   f'{deviation:8.4f} {rms:8.4f}')
        yield ''


def choice_lines(selection: Selection) -> Iterator[str]:
    """Give the reason why each effect was taken or not, and effects not distinguished."""
    if selection.choices:
        yield f'{"left-out error, deg/s rms":26s} {"without":>8s} {"with":>8s} {"chance":>7s}'
    for choice in selection.choices:
        without, with_it = (f'{_shown(value / DEGREE, ".4f"):>8s}'
                            for value in (choice.without, choice.with_it))
        numbers = f'{without} {with_it} {_shown(choice.chance, ".1g"):>7s}'
        yield _wrapped(f'{choice.effect:26s} {numbers}  '
                       f'{"taken" if choice.taken else "not taken"}: {choice.reason}', 54)
    for pair in selection.confounders:
        remedy = ('no rate up to three times the fastest' if pair.rate is None
                  else f'two dwells each way at {pair.rate / DEGREE:.0f} deg/s')
        if not pair.distinguishable:
            yield _wrapped(f'These data do not distinguish {pair.taken} from {pair.other}: '
                           f'{pair.reason}. They differ beyond the calibrated rates; {remedy} '
                           'would distinguish them.')


def _shown(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else '-'


def matrix_lines(matrix: list[list[float]]) -> Iterator[str]:
    """Give the matrix C of Ojeda et al."""
    yield ('C of eq. 11 for deg/s and degC, highest powers of temperature above, '
           'of the output to the left:')
    yield from (' '.join(f'{value: .8e}' for value in row) for row in matrix)


def heading_lines(found: EncoderCalibration) -> Iterator[str]:
    """Give the errors of the heading before and after calibration."""
    if math.isfinite(found.fit.time_offset):
        yield (f'Delay of the gyro behind the reference: {1000.0 * found.fit.time_offset:.1f} ms; '
               'the errors are corrected for it.')
    for name, residual in (('before', found.before), ('after', found.after)):
        yield (f'Heading error {name}: {residual.rms / DEGREE:.3f} deg rms, '
               f'{residual.largest / DEGREE:.3f} deg at most.')
    if found.after.rms > _LARGE_ERROR:
        yield _wrapped(f'The error is above {_LARGE_ERROR / DEGREE:g} deg rms. If the gyro is '
                       'nonlinear or depends on temperature, use --method dwells; it needs '
                       'stretches of constant rate in the log.')
