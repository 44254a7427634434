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
Calibrate from a rate table, a turntable, an encoder, or any log with a reference.

example: gyro_calibration fit table.csv --out model.yaml
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
from typing import Any

from gyro_calibration.calibration.dwells import format_list
from gyro_calibration.calibration.encoder import calibrate, EncoderCalibration
from gyro_calibration.calibration.likelihood import MIN_FIT_PROBABILITY
from gyro_calibration.calibration.rate_table import bin_errors, Calibration
from gyro_calibration.calibration.scatter import MIN_SWEEPS, rms
from gyro_calibration.calibration.selection import (
    FALSE_ALARM_RATE, SelectedEffects, TECHNOLOGY_EFFECTS)
from gyro_calibration.cli import plots, verb
from gyro_calibration.cli.verb import Answer, PrintedResult, show_progress
from gyro_calibration.diagnosis.gates import refuse_mismatch
from gyro_calibration.diagnosis.words import as_sentence, display_unit, wrap_line
from gyro_calibration.files import suggest_nearest
from gyro_calibration.logs.log import DEGREE, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import (
    Effect, polynomial_to_matrix, rate_temperature_polynomial, STATIC_EFFECTS)
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import POLYNOMIAL, write_model
import numpy as np
from scipy.stats import chi2


def add(parser: argparse.ArgumentParser) -> None:
    verb.add_log_options(parser, nargs='+')
    parser.add_argument('--out', metavar='MODEL.yaml', help='write the model')
    parser.add_argument('--method', choices=['dwells', 'likelihood', 'course'],
                        help='dwells: means at constant rates; likelihood: by the reference '
                        'heading; course: by a course over ground. Default: by the columns')
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        '--effects', type=_parse_effects, metavar='NAME,...', help='effects to fit, of '
        f'{", ".join(STATIC_EFFECTS)}; default: those that the data support')
    what.add_argument('--polynomial', type=_parse_orders, nargs='?', const='3,2', metavar='P,Q',
                      help='fit the polynomial over output and temperature of these orders '
                      'instead; default: 3,2')
    parser.add_argument('--technology', choices=list(TECHNOLOGY_EFFECTS), help='of the gyro; '
                        'decides where the data do not, and sets the prior with a reference '
                        'heading (default there: mems)')
    parser.add_argument('--name', dest='gyro_name', metavar='TEXT',
                        help='name of the gyro, stored in the model')
    parser.add_argument('--serial-number', metavar='TEXT', help='stored in the model')
    verb.add_picture_option(parser, 'the errors before and after')


def _parse_effects(text: str) -> list[Effect]:
    unknown = [name for name in text.split(',') if name not in STATIC_EFFECTS]
    if unknown:
        raise argparse.ArgumentTypeError(
            f'{unknown[0]!r} is no effect that dwells at steady rates show; choose from '
            f'{", ".join(STATIC_EFFECTS)}{suggest_nearest(unknown[0], STATIC_EFFECTS)}')
    return [STATIC_EFFECTS[name] for name in dict.fromkeys(text.split(','))]


def _parse_orders(text: str) -> list[Effect]:
    try:
        rate_order, temperature_order = (int(order) for order in text.split(','))
        if not (0 <= rate_order <= 9 and 0 <= temperature_order <= 9):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not two orders from 0 to 9, such as 3,2') from None
    return [rate_temperature_polynomial(rate_order, temperature_order)]


def run(given: argparse.Namespace) -> Answer:
    effects = given.effects or given.polynomial or ()
    logs = dict(zip(given.log, verb.read_each(given)))
    with show_progress('fit of effects'):
        for log in logs.values():
            refuse_mismatch(log)
        found = calibrate(logs, effects, given.method, given.technology)
    identity = {'name': given.gyro_name, 'serial_number': given.serial_number,
                'technology': given.technology}
    model = replace(found.model, gyro={name: value for name, value in identity.items() if value},
                    origin=verb.make_origin(given.log))
    if given.out:
        write_model(given.out, model)
    if given.picture:
        Fitted(model, found).plot(given.picture)
    values: dict[str, dict[str, Any]] = {}
    for effect, parameter, value, deviation in model.estimates():
        half_width = NORMAL_QUANTILE_975 * deviation
        values.setdefault(effect, {})[parameter.name] = {
            'estimate': value, 'standard_deviation': deviation,
            'ci95': [value - half_width, value + half_width] if math.isfinite(deviation) else None,
            'unit': parameter.unit}
    data = {'out': given.out, 'effects': values,
            'covariance': None if model.covariance is None else model.covariance.tolist(),
            'rate_range_rad_s': model.rate_range,
            'temperature_range_degc': model.temperature_range,
            'reference_temperature_degc': model.reference_temperature,
            'technology': model.gyro.get('technology')}
    if isinstance(found, SelectedEffects):
        matrix = next((polynomial_to_matrix(term.effect, term.values).tolist()
                       for term in model.terms if term.effect.name == POLYNOMIAL), None)
        lines = list(_dwell_lines(model, found))
        if given.technology and not found.choices:
            lines.append(f'--technology {given.technology} had no influence, since the effects '
                         'were given; it is stored in the model.')
        data |= {'method': 'dwells', **_dwell_data(found), 'matrix_dps': matrix,
                 'remarks': [*found.calibration.dwells.remarks,
                             *_describe_excess(found.calibration)]}
    else:
        ((path, log),), fit = logs.items(), found.fit
        lines = [f'{len(log)} samples of {path}, {found.lost_samples} lost.',
                 *_heading_lines(model, found)]
        data |= {'method': found.method, 'time_offset_s': fit.time_offset,
                 'angle_random_walk_rad_per_root_s': fit.angle_random_walk,
                 'reference_noise_rad': fit.reference_noise, 'lost_samples': found.lost_samples,
                 **{f'{name}_heading_{when}_rad': size
                    for when, residual in (('before', found.residual_before),
                                           ('after', found.residual_after))
                    for name, size in (('rms', rms(residual)),
                                       ('largest', float(np.abs(residual).max())))},
                 'remarks': list(found.remarks)}
    return Answer(lines, data, (given.picture, given.out))


@dataclass(frozen=True)
class Fitted(PrintedResult):
    """A calibration by a rate table, a turntable or a reference heading."""

    model: GyroModel  # model with the fitted effects and their covariance
    #: effects, dwells and residuals, or the fit of a reference heading
    found: SelectedEffects | EncoderCalibration = field(repr=False)

    def __str__(self) -> str:
        return '\n'.join(_dwell_lines(self.model, self.found)
                         if isinstance(self.found, SelectedEffects)
                         else _heading_lines(self.model, self.found))

    def plot(self, path: str | Path | None = None) -> Any:
        """Return a figure of the errors before and after the fit."""
        found = self.found
        if isinstance(found, SelectedEffects):
            return plots.draw_residuals(path, found.calibration)
        motion = found.reference
        true = motion.heading - motion.heading[0]
        return plots.draw_headings(
            path, motion.time, true, {'not calibrated': true + found.residual_before,
                                      'calibrated': true + found.residual_after},
            'course over ground' if found.method == 'course' else 'reference')


def _dwell_data(selection: SelectedEffects) -> dict[str, Any]:
    fit = selection.calibration
    table, scatter = fit.dwells, fit.scatter
    return {
        'dwells': len(table), 'sweeps': len(np.unique(table.sweep)),
        'outlying': [table.location[row] for row in np.flatnonzero(~scatter.inliers)],
        'condition': fit.condition_number, 'folded_beyond_rad_s': fit.min_non_monotonic_rate,
        'rms_before_rad_s': fit.uncorrected_rms, 'rms_residual_rad_s': fit.residual_rms,
        'rms_left_out_rad_s': fit.left_out_rms,
        'scatter': {'dwell_rad_s': scatter.dwell_bias, 'dwell_scale': scatter.dwell_scale,
                    'sweep_bias_rad_s': scatter.sweep_bias, 'sweep_scale': scatter.sweep_scale},
        'choices': [{'effect': choice.effect, 'taken': choice.taken,
                     'left_out_without_rad_s': choice.error_without,
                     'left_out_with_rad_s': choice.error_with, 'chance': choice.p_value,
                     'reason': choice.reason} for choice in selection.choices],
        'look_alikes': [{'taken': pair.taken, 'other': pair.other, 'sigmas': pair.sigmas,
                         'parted': pair.is_distinguishable,
                         'parting_rate_rad_s': pair.distinguishing_rate,
                         'reason': pair.reason} for pair in selection.confounders],
        **{f'by_{name}': [
            {f'from_{unit}': part.low, f'to_{unit}': part.high, 'dwells': part.count,
             'mean_before_rad_s': part.uncorrected, 'mean_residual_rad_s': part.residual,
             'standard_deviation_rad_s': part.deviation, 'rms_rad_s': part.rms}
            for part in ([] if values is None else bin_errors(fit, values))]
            for name, unit, values in (('rate', 'rad_s', table.rate),
                                       ('temperature', 'degc', table.temperature))}}


def _dwell_lines(model: GyroModel, selection: SelectedEffects) -> Iterator[str]:
    fit = selection.calibration
    table, sweeps = fit.dwells, len(np.unique(fit.dwells.sweep))
    slowest, fastest = (round(rate / DEGREE, 1) + 0.0  # which makes 0 of -0
                        for rate in (table.rate.min(), table.rate.max()))
    temperatures = ('' if table.temperature is None
                    else f', {table.temperature.min():.1f} to {table.temperature.max():.1f} degC')
    yield (f'{len(table)} dwells in {sweeps} sweep{"s" if sweeps > 1 else ""}, '
           f'{slowest:.1f} to {fastest:.1f} deg/s{temperatures}.')
    if outlying := [f'{table.location[row]} ({fit.residual[row] / DEGREE:+.3f} deg/s)'
                    for row in np.flatnonzero(~fit.scatter.inliers)]:
        yield wrap_line(f'{len(outlying)} outlying, not fitted: {format_list(outlying)}.')
    yield from (wrap_line(as_sentence(remark)) for remark in table.remarks)
    yield from ('', *_value_lines(model), '', *_quality_lines(fit), '')
    for name, unit, factor, values in (('rate', 'deg/s', 1 / DEGREE, table.rate),
                                       ('temperature', 'degC', 1.0, table.temperature)):
        if values is None or np.ptp(values) == 0.0:
            continue
        yield (f'{f"by {name}, {unit}":22s} {"dwells":>6s} {"mean error before":>18s} '
               f'{"residual":>10s} {"+-":>8s} {"rms":>8s}  deg/s')
        for part in bin_errors(fit, values):
            low, high = (round(each * factor, 1) + 0.0 for each in (part.low, part.high))
            yield (f'{f"{low:.1f} to {high:.1f}":22s} '
                   f'{part.count:6d} {part.uncorrected / DEGREE:18.4f} '
                   f'{part.residual / DEGREE:10.4f} {part.deviation / DEGREE:8.4f} '
                   f'{part.rms / DEGREE:8.4f}')
        yield ''
    if selection.choices:
        yield f'{"left-out error, deg/s rms":26s} {"without":>8s} {"with":>8s} {"p-value":>7s}'
    for choice in selection.choices:
        numbers = ' '.join(
            f'{format(value, digits) if math.isfinite(value) else "-":>{width}s}'
            for value, digits, width in ((choice.error_without / DEGREE, '.4f', 8),
                                         (choice.error_with / DEGREE, '.4f', 8),
                                         (choice.p_value, '.1g', 7)))
        yield wrap_line(f'{choice.effect:26s} {numbers}  '
                        f'{"taken" if choice.taken else "not taken"}: {choice.reason}', 54)
    for pair in selection.confounders:
        remedy = ('no rate up to three times the fastest' if pair.distinguishing_rate is None
                  else f'two dwells each way at {pair.distinguishing_rate / DEGREE:.0f} deg/s')
        if not pair.is_distinguishable:
            yield wrap_line(f'These data do not distinguish {pair.taken} from {pair.other}: '
                            f'{pair.reason}. They differ beyond these rates; {remedy} would.')


def _heading_lines(model: GyroModel, found: EncoderCalibration) -> Iterator[str]:
    yield from (*_value_lines(model), '')
    if math.isfinite(found.fit.time_offset):
        yield (f'Delay of the gyro behind the reference: {1000.0 * found.fit.time_offset:.1f} ms; '
               'the errors are corrected for it.')
    for name, residual in (('before', found.residual_before), ('after', found.residual_after)):
        yield (f'Heading error {name}: {rms(residual) / DEGREE:.3f} deg rms, '
               f'{np.abs(residual).max() / DEGREE:.3f} deg at most.')
    if rms(found.residual_after) > 5.0 * DEGREE:
        yield wrap_line('The error is above 5 deg rms. ' + (
            'The reference has errors of this size, or shows another motion: compare its turns '
            'with known ones.' if found.method == 'course' else 'If the gyro is nonlinear or '
            'depends on temperature, use --method dwells, which needs constant rates.'))
    yield from (wrap_line(as_sentence(remark)) for remark in found.remarks)


def _value_lines(model: GyroModel) -> Iterator[str]:
    yield f'{"value":38s} {"estimate":>12s} {"std. dev.":>10s}   {"95 % interval":27s} unit'
    for effect, parameter, value, deviation in model.estimates():
        unit, factor = (('ppm/K', 1e6) if parameter.unit == '1/K'
                        else display_unit(parameter.unit))
        name = effect if parameter.name == effect else f'{effect} {parameter.name}'
        low, high = ((value + sign * NORMAL_QUANTILE_975 * deviation) * factor for sign in (-1, 1))
        uncertainty = (f'{deviation * factor:10.2g}   {f"{low:.5g} to {high:.5g}":27s}'
                       if math.isfinite(deviation) else f'{"-":>10s}   {"-":27s}')
        yield f'{name:38s} {value * factor:12.5g} {uncertainty} {unit}'
    for temperature in {term.values[0] for term in model.terms
                        if term.effect.parameters[0].name == 'reference_temperature'}:
        yield f'Temperatures are counted from {temperature:g} degC.'


def _describe_excess(fit: Calibration) -> Iterator[str]:
    """Give a sentence where the residual exceeds the scatter, or the noise that is known."""
    if not fit.dof:
        return
    excess, used = math.sqrt(fit.misfit / fit.dof), fit.used
    if excess > 1.2 and fit.fit_p_value < FALSE_ALARM_RATE:
        yield (f'The residual is {excess:.1f} times the scatter of the dwells about a smooth '
               'surface: the model lacks an effect. The intervals are widened by this factor.')
    # where most rates occur once, nothing shows the scatter of dwells beyond their own noise
    places = np.rint(used.rate / max(0.005 * float(np.abs(used.rate).max()), 1e-9))
    squares = float(np.sum((fit.residual[fit.scatter.inliers] / used.deviation) ** 2))
    if 2 * len(np.unique(places)) > len(used) and (
            chi2.sf(squares, fit.dof) < MIN_FIT_PROBABILITY):
        yield (f'The residual is {math.sqrt(squares / fit.dof):.1f} times the noise within the '
               'dwells: they scatter, or the model lacks an effect, whose error is not in the '
               'intervals; repeat the rates in a second sweep.')


def _quality_lines(fit: Calibration) -> Iterator[str]:
    scatter, sweeps = fit.scatter, len(np.unique(fit.dwells.sweep))
    part = 'sweeps' if sweeps >= MIN_SWEEPS else 'blocks of time'
    yield (f'Error {fit.uncorrected_rms / DEGREE:.4f} deg/s rms before, '
           f'{fit.residual_rms / DEGREE:.4f} after; '
           + (f'{fit.left_out_rms / DEGREE:.4f} in {part} left out of the fit.'
              if math.isfinite(fit.left_out_rms)
              else f'no cross-validation, since some values depend on one of the {part} only.'))
    sweep_scatter = (f'sweeps by {scatter.sweep_bias / DEGREE:.4f} deg/s '
                     f'and {100.0 * scatter.sweep_scale:.3f} %' if sweeps > 1
                     else 'the scatter of sweeps needs a second sweep')
    yield wrap_line(f'Dwells scatter by {scatter.dwell_bias / DEGREE:.4f} deg/s '
                    f'and {100.0 * scatter.dwell_scale:.3f} % of the rate, {sweep_scatter}. '
                    f'Condition number {fit.condition_number:.1f}.')
    yield from map(wrap_line, _describe_excess(fit))
    if fit.min_non_monotonic_rate is not None:
        yield wrap_line(f'Above {fit.min_non_monotonic_rate / DEGREE:.0f} deg/s one modelled '
                        'output has two rates: do not use the model there.')
    if not fit.dof:
        yield wrap_line('There are as many values as dwells, so their standard deviations are '
                        'unknown: add dwells.')
