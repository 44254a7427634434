# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The verb fit: from logs with a reference to a model, and how good it is."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from gyro_calibration.calibration.dwells import dwells, join, take
from gyro_calibration.calibration.encoder import (
    calibrate_encoder,
    EncoderCalibration,
    FEWEST_DWELLS,
    is_motion,
)
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.calibration.selection import select_effects, Selection, TECHNOLOGIES
from gyro_calibration.cli import plots
from gyro_calibration.cli.fit_answer import (
    bin_lines,
    choice_lines,
    dwell_data,
    dwell_lines,
    heading_data,
    heading_lines,
    matrix_lines,
    matrix_of,
    model_data,
    quality_lines,
    sentences,
    value_data,
    value_lines,
)
from gyro_calibration.cli.progress import under_way
from gyro_calibration.cli.verb import (
    add_log,
    add_picture,
    Answer,
    origin_of,
    read_each,
    UsageError,
    verb,
    written,
)
from gyro_calibration.logs.log import Log
from gyro_calibration.model.effects import Effect, rate_temperature_polynomial, STEADY
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import write_model

METHODS = ('dwells', 'likelihood', 'course', 'rate')


def add(verbs: Any) -> argparse.ArgumentParser:
    parser = verb(verbs, 'fit', _fit, 'calibrate from a rate table, a turntable, an encoder, '
                  'or any log with a reference',
                  'table.csv --out model.yaml')
    add_log(parser, nargs='+')
    parser.add_argument('--out', metavar='MODEL.yaml', help='write the model')
    parser.add_argument('--method', choices=METHODS, help='dwells: means at constant rates; '
                        'likelihood: maximum likelihood from the reference heading; '
                        'course: a course over ground, as from satellite navigation; '
                        'rate: the rate of the reference heading, sample by sample. '
                        'Default: by the columns of the log')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--effects', type=_effects, metavar='NAME,...', help='effects to fit, of '
                      f'{", ".join(STEADY)}; default: those that the data support')
    what.add_argument('--polynomial', type=_orders, nargs='?', const='3,2', metavar='P,Q',
                      help='fit the polynomial over output and temperature of these orders '
                      'instead; default: 3,2')
    parser.add_argument('--technology', choices=list(TECHNOLOGIES), help='technology of the gyro; '
                        'selects between effects that the data do not distinguish, and the prior '
                        'beside a reference heading (default there: mems)')
    parser.add_argument('--name', dest='gyro_name', metavar='TEXT',
                        help='name of the gyro, stored in the model')
    parser.add_argument('--serial-number', metavar='TEXT', help='stored in the model')
    parser.add_argument('--matrix', action='store_true', help='print the polynomial as the '
                        'matrix C of Ojeda et al., in deg/s and degC')
    add_picture(parser, 'the errors before and after')
    add_picture(parser, 'the error over rate and temperature', '--surface')
    return parser


def _effects(text: str) -> list[Effect]:
    unknown = [name for name in text.split(',') if name not in STEADY]
    if unknown:
        raise argparse.ArgumentTypeError(f'{unknown[0]!r} is an unknown effect; '
                                         f'choose from {", ".join(STEADY)}')
    return [STEADY[name] for name in dict.fromkeys(text.split(','))]


def _orders(text: str) -> list[Effect]:
    try:
        rate_order, temperature_order = (int(order) for order in text.split(','))
        if not (0 <= rate_order <= 9 and 0 <= temperature_order <= 9):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not two orders from 0 to 9, such as 3,2') from None
    return [rate_temperature_polynomial(rate_order, temperature_order)]


def _fit(given: argparse.Namespace) -> Answer:
    logs = dict(zip(given.log, read_each(given)))
    if _method(given, logs) == 'dwells':
        return _fit_dwells(given, logs)
    return _fit_heading(given, logs)


def _method(given: argparse.Namespace, logs: dict[str, Log]) -> str:
    """Return the method, given or by the logs; '' selects it by the reference heading."""
    if given.method:
        return str(given.method)
    chosen = ({effect.name for effect in given.effects or ()} - {'bias', 'scale_factor_error'}
              or given.polynomial)
    heading_alone = all(log.time is not None and log.reference_rate is None
                        and log.reference_heading is not None for log in logs.values())
    return '' if heading_alone and not chosen else 'dwells'


def _stored(given: argparse.Namespace, model: GyroModel) -> GyroModel:
    """Return the model with its origin, and write it where --out is given."""
    identity = {'name': given.gyro_name, 'serial_number': given.serial_number,
                'technology': given.technology}
    model = replace(model, gyro={name: value for name, value in identity.items() if value},
                    origin=origin_of(given.log))
    if given.out:
        write_model(given.out, model)
    return model


# dwells

def _fit_dwells(given: argparse.Namespace, logs: dict[str, Log]) -> Answer:
    if given.matrix and not given.polynomial:
        raise UsageError('--matrix needs --polynomial: other effects have no matrix')
    effects = given.effects or given.polynomial
    with under_way('dwells') as on_progress:
        table = join([dwells(log, name=Path(path).name if len(logs) > 1 else '')
                      for path, log in logs.items()])
        if not effects and given.method is None and is_motion(list(logs.values()), table):
            return _fit_heading(given, logs)
        on_progress(None, 'fit of effects')
        selection = (Selection(fit_effects(table, effects), (), ()) if effects
                     else select_effects(table, given.technology))
    fit = selection.calibration
    model = _stored(given, fit.model)
    if given.picture:
        plots.draw_residuals(given.picture, fit)
    if given.surface:
        plots.draw_error_surface(given.surface, model, model.rate_range,
                                 model.temperature_range, take(table, fit.scatter.kept))
    matrix = matrix_of(model)
    data = {'out': given.out, 'method': 'dwells', **dwell_data(selection),
            'effects': value_data(model), **model_data(model), 'matrix_dps': matrix,
            'remarks': list(table.remarks)}
    lines = [*dwell_lines(fit), '', *value_lines(model), '', *quality_lines(fit), '',
             *bin_lines(fit), *choice_lines(selection)]
    if effects and given.technology:
        lines.append(f'--technology {given.technology} is stored in the model; it had no '
                     'influence, since the effects were given.')
    if given.matrix and matrix is not None:
        lines += ['', *matrix_lines(matrix)]
    return Answer('\n'.join([*lines, *written(given.out)]), data)


# a reference heading, or a reference rate without dwells

def _fit_heading(given: argparse.Namespace, logs: dict[str, Log]) -> Answer:
    if len(logs) > 1:
        raise UsageError(f'--method {given.method or "likelihood"} takes one log; '
                         'give one log, or use --method dwells')
    others = {effect.name for effect in given.effects or ()} - {'bias', 'scale_factor_error'}
    if others or given.polynomial or given.surface or given.matrix:
        raise UsageError('a reference heading determines bias and scale_factor_error only; for '
                         'other effects, --matrix and --surface use --method dwells')
    (path, log), = logs.items()
    with under_way('fit of scale factor error, bias and delay'):
        found = calibrate_encoder(log, given.method, technology=given.technology or 'mems')
    model = _stored(given, found.model)
    if given.picture:
        plots.draw_reference(given.picture, *headings(log, found))
    remarks = (*_of_motion(log), *found.remarks)
    data = {'out': given.out, 'method': found.method, 'effects': value_data(model),
            **model_data(model), **heading_data(found), 'remarks': list(remarks)}
    lines = [f'{len(log)} samples of {path}, {found.lost_samples} lost.', *value_lines(model), '',
             *heading_lines(found), *sentences(remarks)]
    return Answer('\n'.join([*lines, *written(given.out)]), data)


def _of_motion(log: Log) -> Iterator[str]:
    """Give the remark on a reference without headings."""
    if log.reference_heading is None:
        yield (f'the log has a reference rate, and fewer than {FEWEST_DWELLS} stretches of '
               'constant rate; so the rate is integrated, and headings are compared. For other '
               'effects than bias and scale factor error, hold each rate for some seconds')


def headings(log: Log, found: EncoderCalibration) -> tuple[Any, Any, Any, Any, str]:
    """Return what `plots.draw_reference` takes."""
    name = ('course over ground' if found.method == 'course' else
            'reference' if log.reference_heading is None else 'encoder')
    motion = found.reference
    return (motion.time, motion.heading - motion.heading[0], found.before.heading,
            found.after.heading, name)
