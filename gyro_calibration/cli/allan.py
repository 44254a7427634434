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
Find the noise figures of a gyro in a record at rest, by its Allan deviation.

example: gyro_calibration allan rest.csv --rate 100 --picture allan.png --model model.yaml
--out model.yaml
"""

import argparse
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
from typing import Any

from gyro_calibration.allan.deviation import (
    allan_deviation, AllanChart, build_rest_record, RestRecord)
from gyro_calibration.allan.noise_fit import fit_noise, NoiseFit
from gyro_calibration.cli import verb
from gyro_calibration.cli.plots import draw_allan
from gyro_calibration.cli.verb import Answer, PrintedResult, show_progress
from gyro_calibration.diagnosis.words import display_unit, readable_name
from gyro_calibration.files import InputError
from gyro_calibration.logs.log import DataRefused, DEGREE, Log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import read_model, write_model
from gyro_calibration.model.noise import NOISE_TERMS
import numpy as np

#: Symbol -> usual unit, and the factor from SI to it.
_DISPLAY_UNITS = {**{part.symbol: display_unit(part.unit, part.name) for part in NOISE_TERMS},
                  'Q': ('arcsec', 3600.0 / DEGREE), 'R': ('deg/h/h', 3600.0 ** 2 / DEGREE)}


def add(parser: argparse.ArgumentParser) -> None:
    verb.add_log_options(parser)
    verb.add_picture_option(parser, 'the chart')
    parser.add_argument('--model', metavar='MODEL.yaml', help='with --out: the model to add the '
                        'noise figures to; default: a new one')
    parser.add_argument('--out', metavar='MODEL.yaml',
                        help='write the model with these noise figures')


def run(given: argparse.Namespace) -> Answer:
    if given.model and not given.out:
        raise InputError('--model was given without --out; give the file to write with --out')
    model = read_model(given.model) if given.model else GyroModel()
    whole = verb.read(argparse.Namespace(**{**vars(given), 'begin': 0.0, 'end': math.inf}))
    time = verb.require_time(given, whole)
    # in messages, times are those of --from and --to
    log = verb.cut_to_range(given, replace(whole, time=time - time[0]))
    try:
        with show_progress('noise figures from the Allan deviation'):
            found = find_noise_figures(log)
    except DataRefused as error:
        raise DataRefused(f'{given.log}: {error}') from None
    if given.picture:
        found.plot(given.picture)
    if given.out:
        write_model(given.out, found.put_into(verb.add_origin(given, model)))
    record, chart, fit = found.record, found.chart, found.fit
    figures = {figure.term.name: {'symbol': symbol, 'unit': figure.term.unit,
                                  'value': figure.value, 'lower': figure.lower,
                                  'upper': figure.upper, 'seen': bool(figure.value),
                                  'standard_deviation': figure.standard_deviation}
               for symbol, figure in fit.figures.items()}
    columns = {'time_s': chart.time, 'deviation': chart.deviation, 'lower': chart.lower,
               'upper': chart.upper, 'degrees_of_freedom': chart.degrees_of_freedom,
               'differences': chart.difference_count, 'fit': fit.deviation(chart.time)}
    return Answer([str(found)], {
        'samples': len(record.rate), 'interval_s': record.interval,
        'remarks': list(record.remarks), **figures,
        'floor': {**chart.floor, 'reached': fit.is_floor_reached},
        'fitted_from_s': fit.min_time, 'fitted_to_s': fit.max_time, 'misfit': fit.misfit,
        'rivals': list(fit.alternatives), 'gauss_markov': None if fit.process is None
        else {'standard_deviation': fit.process.standard_deviation,
              'correlation_time_s': fit.process.correlation_time},
        'chart': {name: values.tolist() for name, values in columns.items()},
        'picture': given.picture, 'out': given.out}, (given.picture, given.out))


@dataclass(frozen=True)
class NoiseFigures(PrintedResult):
    """The noise of a gyro at rest: angle random walk, bias instability and so on."""

    record: RestRecord = field(repr=False)  # numbered samples, gaps and delays of the stamps
    chart: AllanChart  # Allan deviations with their bounds
    fit: NoiseFit  # the noise figures

    def __str__(self) -> str:
        record, fit, (unit, factor) = self.record, self.fit, _DISPLAY_UNITS['B']
        lost, (time, *sizes) = np.isnan(record.rate).sum(), self.chart.floor.values()
        deviation, lower, upper = (f'{size * factor:.4g}' for size in sizes)
        floor_line = (f'Lowest Allan deviation: {deviation} {unit} at {time:.4g} s, '
                      f'95 %: {lower} to {upper}.')
        if not fit.is_floor_reached:
            floor_line += ' It still falls at the end of the chart; record longer.'
        lines = [f'{len(record.rate) - lost} samples, one every {1000 * record.interval:.5g} ms, '
                 f'{len(record.rate) * record.interval:.5g} s at rest.',
                 *record.remarks, floor_line]
        for symbol, figure in fit.figures.items():
            unit, factor = _DISPLAY_UNITS[symbol]
            value, low, high = (each * factor for each in (
                figure.value, figure.lower, figure.upper))
            text = (f'{value:.4g} {unit}, 95 %: {low:.4g} to {high:.4g} ({figure.value:.4g} '
                    f'{figure.term.unit}, {figure.lower:.4g} to {figure.upper:.4g})'
                    if figure.value else f'not seen; below {high:.3g} {unit} '
                    f'({figure.upper:.3g} {figure.term.unit})')
            lines.append(f'{readable_name(figure.term.name).capitalize()} {symbol}: {text}.')
        text = (f'The figures describe averaging times from {fit.min_time:.3g} to '
                f'{fit.max_time:.4g} s')
        if fit.min_time > fit.chart.time[0]:
            text += '; shorter ones are affected by filters or interference in the gyro'
        if fit.misfit:
            text += (f'; they leave up to {100 * fit.misfit:.0f} % of the Allan deviation '
                     'unexplained, which the intervals include')
        if fit.alternatives:
            others = ' or '.join(' + '.join(each) for each in fit.alternatives)
            text += f'; {others} fit nearly as well, and a longer record would distinguish them'
        if fit.process:
            size = fit.process.standard_deviation * _DISPLAY_UNITS['B'][1]
            text += (f'; a Gauss-Markov process of {size:.3g} deg/h with a correlation time of '
                     f'{fit.process.correlation_time:.3g} s describes them better than B and K')
        return '\n'.join([*lines, f'{text}.'])

    def put_into(self, model: GyroModel) -> GyroModel:
        return replace(model, noise=self.fit.noise, noise_bounds=self.fit.noise_bounds)

    def plot(self, path: str | Path | None = None) -> Any:
        """Return the Allan chart."""
        return draw_allan(path, self.chart, self.fit, {
            symbol: f'{readable_name(figure.term.name)} {symbol} = '
            f'{figure.value * _DISPLAY_UNITS[symbol][1]:.3g} {_DISPLAY_UNITS[symbol][0]}'
            for symbol, figure in self.fit.figures.items() if figure.value})


def find_noise_figures(log: Log) -> NoiseFigures:
    record = build_rest_record(np.asarray(log.time), np.asarray(log.output), log.moving,
                               log.reference_heading)
    return NoiseFigures(record, allan_deviation(record.rate, record.interval),
                        fit_noise(record.rate, record.interval))
