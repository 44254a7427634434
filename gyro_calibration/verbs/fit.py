"""The verb fit: from logs with a reference to a model, and how good it is."""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from gyro_calibration import __version__, picture
from gyro_calibration.calibration import Calibration, binned, fit_effects
from gyro_calibration.dwells import dwells, join
from gyro_calibration.effects import CATALOGUE, Effect, polynomial_to_matrix, rate_temperature_polynomial
from gyro_calibration.encoder import EncoderCalibration, calibrate_encoder
from gyro_calibration.log import DEGREE, Log
from gyro_calibration.model import GyroModel
from gyro_calibration.model_file import POLYNOMIAL, write_model
from gyro_calibration.scatter import take
from gyro_calibration.selection import TECHNOLOGIES, Selection, select_effects
from gyro_calibration.verbs.verb import Answer, UsageError, add_log, picture_file, read, verb

METHODS = ('dwells', 'likelihood', 'rate')
#: What people read instead of the unit of the file, and the factor to it.
_UNITS = {'rad/s': ('deg/s', 1 / DEGREE), 'rad/s/K': ('deg/s/K', 1 / DEGREE), 'rad/s/K²': ('deg/s/K²', 1 / DEGREE),
          's/rad': ('s/deg', DEGREE), 's²/rad²': ('s²/deg²', DEGREE ** 2)}


def add(verbs: Any) -> argparse.ArgumentParser:
    parser = verb(verbs, 'fit', _fit, 'calibrate from a rate table, a turntable, an encoder, or any log with a reference',
                  'table.csv --out model.yaml')
    add_log(parser, nargs='+')
    parser.add_argument('--out', metavar='MODEL.yaml', help='write the model')
    parser.add_argument('--method', choices=METHODS, help='dwells: means at constant rates; likelihood: the reference heading itself; '
                        'rate: the rate of the reference heading, sample by sample. Default: what the log holds')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--effects', type=_effects, metavar='NAME,...', help=f'fit these of {", ".join(CATALOGUE)}; default: those that '
                      'the data support')
    what.add_argument('--polynomial', type=_orders, nargs='?', const='3,2', metavar='P,Q',
                      help='fit the polynomial over output and temperature of these orders instead; default: 3,2')
    parser.add_argument('--technology', choices=list(TECHNOLOGIES), help='what the gyro is; decides where effects look alike')
    parser.add_argument('--name', dest='gyro_name', metavar='TEXT', help='of the gyro, kept in the model')
    parser.add_argument('--serial-number', metavar='TEXT', help='of the gyro, kept in the model')
    parser.add_argument('--matrix', action='store_true', help='print the polynomial as the matrix C of Ojeda et al., in deg/s and degC')
    parser.add_argument('--picture', type=picture_file, metavar='FILE', help='draw the errors before and after, .png or .svg')
    parser.add_argument('--surface', type=picture_file, metavar='FILE', help='draw the error over rate and temperature, .png or .svg')
    return parser


def _effects(text: str) -> list[Effect]:
    unknown = [name for name in text.split(',') if name not in CATALOGUE]
    if unknown:
        raise argparse.ArgumentTypeError(f'{unknown[0]!r} is no effect; choose from {", ".join(CATALOGUE)}')
    return [CATALOGUE[name] for name in dict.fromkeys(text.split(','))]


def _orders(text: str) -> list[Effect]:
    try:
        rate_order, temperature_order = (int(order) for order in text.split(','))
        if not (0 <= rate_order <= 9 and 0 <= temperature_order <= 9):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r} is not two orders from 0 to 9, such as 3,2') from None
    return [rate_temperature_polynomial(rate_order, temperature_order)]


def _fit(given: argparse.Namespace) -> Answer:
    logs = {path: read(argparse.Namespace(**{**vars(given), 'log': path})) for path in given.log}
    if _method(given, logs) == 'dwells':
        return _fit_dwells(given, logs)
    return _fit_heading(given, logs)


def _method(given: argparse.Namespace, logs: dict[str, Log]) -> str:
    """Return the method that was asked for, or the one for what the logs hold."""
    if given.method:
        return str(given.method)
    chosen = {effect.name for effect in given.effects or ()} - {'bias', 'scale_factor_error'} or given.polynomial
    heading_alone = all(log.time is not None and log.reference_rate is None and log.reference_heading is not None for log in logs.values())
    return 'likelihood' if heading_alone and not chosen else 'dwells'


def _written(given: argparse.Namespace, model: GyroModel) -> GyroModel:
    """Return the model with what it comes from, and write it where that is wanted."""
    identity = {'name': given.gyro_name, 'serial_number': given.serial_number, 'technology': given.technology}
    files = [{'name': Path(path).name, 'sha256': hashlib.sha256(Path(path).read_bytes()).hexdigest()} for path in given.log]
    model = replace(model, gyro={name: value for name, value in identity.items() if value},
                    origin={'files': files, 'date': datetime.now(timezone.utc).isoformat(timespec='seconds'),
                            'program': f'gyro_calibration {__version__}'})
    if given.out:
        write_model(given.out, model)
    return model


# dwells

def _fit_dwells(given: argparse.Namespace, logs: dict[str, Log]) -> Answer:
    table = join([dwells(log, name=Path(path).name if len(logs) > 1 else '') for path, log in logs.items()])
    effects = given.effects or given.polynomial
    selection = Selection(fit_effects(table, effects), (), ()) if effects else select_effects(table, given.technology)
    fit = selection.calibration
    model = _written(given, fit.model)
    if given.picture:
        picture.draw_residuals(given.picture, fit)
    if given.surface:
        picture.draw_error_surface(given.surface, model, model.rate_range, model.temperature_range, take(table, fit.scatter.kept))
    matrix = _matrix(model)
    data = {'out': given.out, 'method': 'dwells', **_dwell_data(selection), 'effects': _values(model), **_model_data(model),
            'matrix_dps': matrix, 'remarks': list(table.remarks)}
    lines = [*_dwell_lines(fit), '', *_value_lines(model), '', *_quality_lines(fit), '', *_bin_lines(fit), *_choice_lines(selection)]
    if given.matrix:
        lines += ['', *_matrix_lines(matrix)]
    return Answer('\n'.join(lines + ([f'Written to {given.out}.'] if given.out else [])), data)


def _matrix(model: GyroModel) -> list[list[float]] | None:
    for term in model.terms:
        if term.effect.name == POLYNOMIAL:
            matrix: list[list[float]] = polynomial_to_matrix(term.effect, term.values).tolist()
            return matrix
    return None


def _matrix_lines(matrix: list[list[float]] | None) -> list[str]:
    if matrix is None:
        raise UsageError('--matrix needs --polynomial: other effects have no matrix')
    rows = (' '.join(f'{value: .8e}' for value in row) for row in matrix)
    return ['C of eq. 11 for deg/s and degC, highest powers of temperature above, of the output to the left:', *rows]


def _dwell_data(selection: Selection) -> dict[str, Any]:
    fit = selection.calibration
    return {
        'dwells': len(fit.dwells), 'sweeps': len(np.unique(fit.dwells.sweep)),
        'outlying': [fit.dwells.place[row] for row in np.flatnonzero(~fit.scatter.kept)],
        'condition': fit.condition,
        'rms_before_rad_s': fit.before_rms, 'rms_residual_rad_s': fit.residual_rms, 'rms_left_out_rad_s': _finite(fit.left_out_rms),
        'scatter': {'dwell_rad_s': fit.scatter.dwell, 'dwell_scale': fit.scatter.dwell_scale,
                    'sweep_bias_rad_s': fit.scatter.sweep_bias, 'sweep_scale': fit.scatter.sweep_scale},
        'choices': [{name: _finite(value) for name, value in vars(choice).items()} for choice in selection.choices],
        'look_alikes': [{**vars(twins), 'parted': twins.parted} for twins in selection.twins],
        'by_rate': [vars(part) for part in binned(fit, fit.dwells.rate)],
        'by_temperature': [] if fit.dwells.temperature is None else [vars(part) for part in binned(fit, fit.dwells.temperature)],
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _model_data(model: GyroModel) -> dict[str, Any]:
    return {'covariance': None if model.covariance is None else model.covariance.tolist(), 'rate_range_rad_s': list(model.rate_range),
            'temperature_range_degc': [_finite(end) for end in model.temperature_range],
            'reference_temperature_degc': model.reference_temperature, 'technology': model.gyro.get('technology')}


def _fitted(model: GyroModel) -> Iterator[tuple[str, Any, float, float]]:
    """Give the name of the effect, the parameter, its value and its standard deviation, for each fitted value."""
    count = sum(len(term.fitted) for term in model.terms)
    deviations = iter([math.nan] * count if model.covariance is None else np.sqrt(np.diag(model.covariance)).tolist())
    for term in model.terms:
        for place in term.fitted:
            yield term.effect.name, term.effect.parameters[place], term.values[place], next(deviations)


def _values(model: GyroModel) -> dict[str, dict[str, Any]]:
    values: dict[str, dict[str, Any]] = {}
    for effect, parameter, value, deviation in _fitted(model):
        known = math.isfinite(deviation)
        values.setdefault(effect, {})[parameter.name] = {
            'estimate': value, 'standard_deviation': deviation if known else None,
            'ci95': [value - 1.96 * deviation, value + 1.96 * deviation] if known else None, 'unit': parameter.unit}
    return values


def _value_lines(model: GyroModel) -> Iterator[str]:
    counted = {term.values[0] for term in model.terms if term.effect.parameters[0].name == 'reference_temperature'}
    yield f'{"value":38s} {"estimate":>12s} {"std. dev.":>10s}   {"95 % interval":27s} unit'
    for effect, parameter, value, deviation in _fitted(model):
        unit, factor = _UNITS.get(parameter.unit, (parameter.unit, 1.0))
        name = effect if parameter.name == effect else f'{effect} {parameter.name}'
        low, high = ((value + sign * 1.96 * deviation) * factor for sign in (-1, 1))
        yield f'{name:38s} {value * factor:12.5g} {deviation * factor:10.2g}   {f"{low:.5g} to {high:.5g}":27s} {unit}'
    for temperature in counted:
        yield f'Temperatures are counted from {temperature:g} degC.'


def _dwell_lines(fit: Calibration) -> Iterator[str]:
    table = fit.dwells
    slowest, fastest = (rate / DEGREE for rate in (table.rate.min(), table.rate.max()))
    temperatures = '' if table.temperature is None else f', {table.temperature.min():.1f} to {table.temperature.max():.1f} degC'
    yield f'{len(table)} dwells in {len(np.unique(table.sweep))} sweeps, {slowest:.1f} to {fastest:.1f} deg/s{temperatures}.'
    outlying = np.flatnonzero(~fit.scatter.kept)
    if len(outlying):
        named = ', '.join(f'{table.place[row]} ({fit.residual[row] / DEGREE:+.3f} deg/s)' for row in outlying[:5])
        more = f' and {len(outlying) - 5} more' if len(outlying) > 5 else ''
        yield f'{len(outlying)} outlying, not fitted: {named}{more}.'
    yield from (f'{remark[0].upper()}{remark[1:]}.' for remark in table.remarks)


def _quality_lines(fit: Calibration) -> Iterator[str]:
    yield (f'Error {fit.before_rms / DEGREE:.4f} deg/s rms before, {fit.residual_rms / DEGREE:.4f} after; '
           + (f'{fit.left_out_rms / DEGREE:.4f} in sweeps that were left out.' if math.isfinite(fit.left_out_rms)
              else 'what a sweep that was left out would show cannot be told: only one shows some of the values.'))
    scatter = fit.scatter
    yield (f'Dwells scatter by {scatter.dwell / DEGREE:.4f} deg/s and {100.0 * scatter.dwell_scale:.3f} % of the rate, sweeps by '
           f'{scatter.sweep_bias / DEGREE:.4f} deg/s and {100.0 * scatter.sweep_scale:.3f} %. Condition number {fit.condition:.1f}.')
    excess = fit.misfit / fit.freedom if fit.freedom else 1.0
    if excess > 1.5:
        yield (f'These effects leave {math.sqrt(excess):.1f} times the scatter of the dwells about a smooth surface: something is missing. '
               'The intervals are widened by that.')
    if not fit.freedom:
        yield 'There are as many values as dwells, so nothing says how sure they are: add dwells.'


def _bin_lines(fit: Calibration) -> Iterator[str]:
    table = fit.dwells
    for name, unit, factor, values in (('rate', 'deg/s', 1 / DEGREE, table.rate), ('temperature', 'degC', 1.0, table.temperature)):
        if values is None or np.ptp(values) == 0.0:
            continue
        yield f'{f"by {name}, {unit}":22s} {"dwells":>6s} {"mean error before":>18s} {"residual":>10s} {"+-":>8s} {"rms":>8s}  deg/s'
        for part in binned(fit, values):
            place = f'{part.low * factor:.1f} to {part.high * factor:.1f}'
            before, residual, deviation, rms = (value / DEGREE for value in (part.before, part.residual, part.deviation, part.rms))
            yield f'{place:22s} {part.count:6d} {before:18.4f} {residual:10.4f} {deviation:8.4f} {rms:8.4f}'
        yield ''


def _choice_lines(selection: Selection) -> Iterator[str]:
    if selection.choices:
        yield f'{"left-out error, deg/s rms":28s} {"without":>9s} {"with":>9s} {"chance":>9s}'
    for choice in selection.choices:
        numbers = ' '.join(f'{value:>9s}' for value in (*(_shown(value / DEGREE, '.4f') for value in (choice.without, choice.with_it)),
                                                        _shown(choice.chance, '.1g')))
        yield f'{choice.effect:28s} {numbers}  {"taken" if choice.taken else "not taken"}: {choice.reason}'
    for twins in selection.twins:
        if not twins.parted:
            yield (f'These data hardly part {twins.taken} from {twins.other}; {twins.reason}. It matters beyond the calibrated rates; '
                   + ('no rate up to three times the fastest would part them.' if twins.rate is None
                      else f'two dwells each way at {twins.rate / DEGREE:.0f} deg/s would part them.'))


def _shown(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else '-'


# a reference heading

def _fit_heading(given: argparse.Namespace, logs: dict[str, Log]) -> Answer:
    if len(logs) > 1:
        raise UsageError(f'--method {given.method or "likelihood"} takes one log; give the logs one by one, or use --method dwells')
    if _names(given.effects) - {'bias', 'scale_factor_error'} or given.polynomial or given.surface or given.matrix:
        raise UsageError('a reference heading gives bias and scale_factor_error; for other effects, --matrix and --surface use '
                         '--method dwells')
    (path, log), = logs.items()
    found = calibrate_encoder(log, 'rate' if given.method == 'rate' else 'likelihood')
    model = _written(given, found.model)
    if given.picture:
        picture.draw_headings(given.picture, *_headings(log, found))
    data = {'out': given.out, 'method': found.method, 'effects': _values(model), **_model_data(model), **_heading_data(found),
            'remarks': list(found.remarks)}
    lines = [f'{len(log)} samples of {path}, {found.lost_samples} lost.', *_value_lines(model), '', *_heading_lines(found),
             *(f'{remark[0].upper()}{remark[1:]}.' for remark in found.remarks)]
    return Answer('\n'.join(lines + ([f'Written to {given.out}.'] if given.out else [])), data)


def _names(effects: Sequence[Effect] | None) -> set[str]:
    return {effect.name for effect in effects or ()}


def _headings(log: Log, found: EncoderCalibration) -> tuple[Any, Any, dict[str, Any]]:
    """Return time, true heading, and the heading before and after, for a picture."""
    assert log.reference_heading is not None
    true = log.reference_heading[np.isfinite(log.reference_heading)]
    true = true - true[0]
    return found.time, true, {'without calibration': true + found.before.heading, 'calibrated': true + found.after.heading}


def _heading_data(found: EncoderCalibration) -> dict[str, Any]:
    fit = found.fit
    return {'time_offset_s': _finite(fit.time_offset), 'angle_random_walk_rad_per_root_s': _finite(fit.angle_random_walk),
            'reference_noise_rad': _finite(fit.reference_noise), 'lost_samples': found.lost_samples,
            'rms_heading_before_rad': found.before.rms, 'rms_heading_after_rad': found.after.rms,
            'largest_heading_before_rad': found.before.largest, 'largest_heading_after_rad': found.after.largest}


def _heading_lines(found: EncoderCalibration) -> Iterator[str]:
    if math.isfinite(found.fit.time_offset):
        yield f'The gyro lags the reference by {1000.0 * found.fit.time_offset:.1f} ms; that is taken out.'
    for name, residual in (('before', found.before), ('after', found.after)):
        yield f'Heading error {name}: {residual.rms / DEGREE:.3f} deg rms, {residual.largest / DEGREE:.3f} deg at most.'
