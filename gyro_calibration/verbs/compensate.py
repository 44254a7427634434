"""The verb compensate: rates, and for samples in time the heading, beside those of a log."""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from gyro_calibration.compensation import compensate, covariance, quadratic_form, rate_sensitivity
from gyro_calibration.heading import Threshold, filter_rates, integrate_with_deviation
from gyro_calibration.log import DEGREE, Array, DataRefused, Log, write_log
from gyro_calibration.model import GyroModel
from gyro_calibration.model_file import read_model
from gyro_calibration.verbs.verb import Answer, add_log, not_negative, output_of, read, verb


def add(verbs: Any) -> argparse.ArgumentParser:
    parser = verb(verbs, 'compensate', _compensate, 'add compensated rates, and for samples in time the heading, to a log',
                   'drive.csv --model model.yaml --out compensated.csv')
    add_log(parser)
    parser.add_argument('--model', required=True, metavar='MODEL.yaml')
    parser.add_argument('--out', required=True, metavar='OUT.csv', help='.csv or .csv.gz')
    parser.add_argument('--threshold', type=not_negative, default=0.0, metavar='DPS',
                        help='a robot that turns slower stands, as 0.3 in the node; default: 0, off')
    parser.add_argument('--window', type=not_negative, default=0.2, metavar='S', help='of the threshold filter; 0 is single samples')
    return parser


def _compensate(given: argparse.Namespace) -> Answer:
    model, log = read_model(given.model), read(given)
    output = output_of(given, log)
    known = np.isfinite(output)
    if not known.any():
        raise DataRefused(f'{given.log}: no output of the gyro is a number; record again')
    time, temperature = (None if each is None else each[known] for each in (log.time, log.temperature))
    columns = _compensated_columns(given, model, time, output[known], temperature)
    write_log(given.out, log, {name: _at(known, values) for name, values in columns.items()})
    return _compensated_answer(given, log, columns)


def _compensated_columns(given: argparse.Namespace, model: GyroModel, time: Array | None, output: Array,
                         temperature: Array | None) -> dict[str, Array]:
    result, uncertainty = compensate(model, output, temperature), covariance(model)
    sensitivity = rate_sensitivity(model, output, result.rate, result.temperature)
    variance = quadratic_form(uncertainty, sensitivity)
    columns = {'rate_rad_s': result.rate}
    if time is not None:
        variance = variance + model.noise.rate_variance(float(np.median(np.diff(time))))
        threshold = Threshold(given.threshold * DEGREE, given.window, model.noise.angle_random_walk)
        columns['rate_rad_s'] = filter_rates(threshold, time, result.rate)
        columns['heading_rad'], columns['heading_std_rad'] = integrate_with_deviation(
            time, result.rate, columns['rate_rad_s'], sensitivity, uncertainty, model.noise)
    columns['rate_std_rad_s'] = np.sqrt(np.broadcast_to(variance, output.shape))
    columns['temperature_clipped'] = np.broadcast_to(result.temperature_clipped, output.shape)
    columns['beyond_range'] = result.beyond_range
    return columns


def _at(known: Array, values: Array) -> Array:
    """Return the values at the rows where the output is known, and nan at the others."""
    whole = np.full(len(known), np.nan)
    whole[known] = values
    return whole


def _compensated_answer(given: argparse.Namespace, log: Log, columns: dict[str, Array]) -> Answer:
    data: dict[str, Any] = {'out': given.out, 'rows': len(log), 'rows_without_output': len(log) - len(columns['rate_rad_s']),
                            'temperature_known': log.temperature is not None}
    data.update({name: int(columns[name].sum()) for name in ('temperature_clipped', 'beyond_range')})
    lines = [f'{len(log)} rows compensated by {given.model}, written to {given.out}.']
    if 'heading_rad' in columns:
        heading, deviation = (float(columns[name][-1]) for name in ('heading_rad', 'heading_std_rad'))
        data.update(heading_rad=heading, heading_std_rad=None if math.isnan(deviation) else deviation)
        known = '' if math.isnan(deviation) else f' +- {deviation / DEGREE:.2f}'
        lines.append(f'Heading at the end: {heading / DEGREE:.2f}{known} deg.')
    if log.temperature is None:
        lines.append('The log holds no temperature: the model was used at its reference temperature.')
    for name, words in (('rows_without_output', 'rows have no output of the gyro; the heading is integrated across them.'),
                        ('temperature_clipped', 'rows are outside the calibrated temperatures; the nearest end was used.'),
                        ('beyond_range', 'rows are beyond the calibrated rates; the correction is extrapolated.')):
        if data[name]:
            lines.append(f'{data[name]} {words}')
    return Answer('\n'.join(lines), data)
