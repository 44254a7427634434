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
Measure the coverage of 95 % intervals of calibrations from dwells, for every effect, simulated.

    python benchmarks/recovery.py [RUNS]

Each rate table has eight sweeps of 21 rates up to 100 deg/s both ways, while the temperature goes
from 25 to 47 degC; the mean of a dwell scatters by 0.03 deg/s. The first table has a gyro for each
effect, the second one gyro with several effects for each kind of scatter. Prints tables in
Markdown: the share of the runs (400, or as given) with the truth of each value inside its
interval, the mean over the values of a gyro and the lowest and highest of them, and the same for
the compensated rates over the whole range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import sys

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.compensation import (
    compensate, quadratic_form, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, Channels, CUBIC_NONLINEARITY,
    polynomial_from_matrix, QUADRATIC_NONLINEARITY, SCALE_FACTOR_ASYMMETRY, SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE, SINE_RESPONSE)
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
import numpy as np

#: An effect of clear size each; those of temperature count from 36 degC.
TRUTH = {term.effect.name: term for term in (
    Term(BIAS, (0.002,)), Term(SCALE_FACTOR_ERROR, (0.01,)),
    Term(SCALE_FACTOR_ASYMMETRY, (0.003,)), Term(QUADRATIC_NONLINEARITY, (0.002,)),
    Term(CUBIC_NONLINEARITY, (-0.005,)), Term(SINE_RESPONSE, (0.25, 1.0)),
    Term(BIAS_TEMPERATURE, (36.0, 1e-5)), Term(BIAS_TEMPERATURE_QUADRATIC, (36.0, 1e-6)),
    Term(SCALE_FACTOR_TEMPERATURE, (36.0, 3e-4)))}
#: Orders (3, 2), by the matrix of the paper for deg/s and degC.
POLYNOMIAL = Term(*polynomial_from_matrix([[0, 0, -1e-5, 1e-5], [0, 0, 4e-4, -1e-3],
                                           [-3e-6, 1e-5, 8e-3, 3e-2]]))
LINEAR = tuple(TRUTH[name] for name in ('bias', 'scale_factor_error'))
CUBIC = (*LINEAR, *(TRUTH[name] for name in ('scale_factor_asymmetry', 'cubic_nonlinearity',
                                             'bias_temperature', 'bias_temperature_quadratic',
                                             'scale_factor_temperature')))
SINE = (*LINEAR, *(TRUTH[name] for name in ('quadratic_nonlinearity', 'sine_response',
                                            'bias_temperature', 'scale_factor_temperature')))


@dataclass(frozen=True)
class Table:
    """A simulated rate table."""

    sweeps: int = 8
    rates: int = 21  # in each sweep
    fastest: float = 100.0 * DEGREE
    temperatures: tuple[float, float] = (25.0, 45.0)  # of the first sweep and the last, degC
    one_way: bool = False  # from rest to the fastest rate, one way and the other way in turn
    dwell: float = 0.03 * DEGREE  # scatter of dwells, rad/s
    dwell_scale: float = 0.0  # and of their scale factor, 1
    told: bool = False  # the deviations of dwells differ, by a factor of 1.6 mostly
    sweep_bias: float = 0.0  # what wanders from sweep to sweep, rad/s
    sweep_scale: float = 0.0  # 1

    def measure(self, gyro: GyroModel, generator: np.random.Generator) -> Dwells:
        """Return the dwells of a gyro on the table."""
        sweep = np.repeat(np.arange(self.sweeps), self.rates)
        up = np.linspace(0.0 if self.one_way else -self.fastest, self.fastest, self.rates)
        rate = np.concatenate([up if number % 2 else -up for number in range(self.sweeps)])
        warming = np.tile(np.linspace(0.0, 2.0, self.rates), self.sweeps)
        temperature = np.repeat(np.linspace(*self.temperatures, self.sweeps), self.rates) + warming
        deviation = self.dwell * (np.exp(0.5 * generator.standard_normal(len(rate))) if self.told
                                  else np.ones(len(rate)))
        scale = (self.dwell_scale * generator.standard_normal(len(rate))
                 + self.sweep_scale * generator.standard_normal(self.sweeps)[sweep])
        bias = (deviation * generator.standard_normal(len(rate))
                + self.sweep_bias * generator.standard_normal(self.sweeps)[sweep])
        return Dwells(rate, gyro.output(rate, temperature) + bias + scale * rate, temperature,
                      deviation if self.told else np.full(len(rate), np.nan), sweep,
                      tuple(f'row {row + 1}' for row in range(len(rate))))


SCATTERS = {
    'alike for all dwells': Table(),
    'grows with the rate': Table(dwell=0.01 * DEGREE, dwell_scale=7e-4),
    'differs by dwell, told': Table(told=True), '3 sweeps, one temperature each': Table(sweeps=3),
    '4 sweeps': Table(sweeps=4),
    'little from sweep to sweep': Table(sweep_bias=0.006 * DEGREE, sweep_scale=1e-4),
    'from sweep to sweep': Table(sweep_bias=0.02 * DEGREE, sweep_scale=3e-4),
    'much from sweep to sweep': Table(sweep_bias=0.1 * DEGREE, sweep_scale=3e-3),
    'from sweep to sweep, one way': Table(sweep_bias=0.02 * DEGREE, sweep_scale=3e-4,
                                          one_way=True),
    'much from sweep to sweep, one way': Table(sweep_bias=0.05 * DEGREE, sweep_scale=1e-3,
                                               one_way=True),
    '24 sweeps, from sweep to sweep': Table(sweeps=24, sweep_bias=0.02 * DEGREE, sweep_scale=3e-4),
    '24 sweeps, from sweep to sweep, one way': Table(sweeps=24, sweep_bias=0.02 * DEGREE,
                                                     sweep_scale=3e-4, one_way=True),
}


def gyros() -> dict[str, tuple[Term, ...]]:
    """Return a gyro for each effect, with what it needs besides."""
    needed = {'bias': (), 'scale_factor_error': (TRUTH['bias'],),
              'bias_temperature_quadratic': (*LINEAR, TRUTH['bias_temperature'])}
    return {**{name: (*needed.get(name, LINEAR), term) for name, term in TRUTH.items()},
            'polynomial 3,2': (POLYNOMIAL,)}


def expressed(truth: GyroModel, fitted: GyroModel) -> np.ndarray:
    """Return the true values in the fitted model's terms: temperature, centres and scales."""
    rate, temperature = (each.ravel() for each in np.meshgrid(np.linspace(-1.7, 1.7, 11),
                                                              np.linspace(25.0, 47.0, 7)))
    channels = Channels(rate, truth.output(rate, temperature), temperature)
    shapes = {term.effect.name: term.values[:len(term.effect.nonlinear_parameters)]
              for term in truth.terms if term.effect is SINE_RESPONSE}
    terms = [Term(term.effect, (
        *shapes.get(term.effect.name, term.values[:len(term.effect.nonlinear_parameters)]),
        *term.values[len(term.effect.nonlinear_parameters):])) for term in fitted.terms]
    linear = [term for term in terms if term.effect is not SINE_RESPONSE]
    rest = truth.error(channels) - sum(term.error(channels)
                                       for term in terms if term.effect is SINE_RESPONSE)
    columns = np.column_stack([column for term in linear for column in term.columns(channels)])
    found = iter(np.linalg.lstsq(columns, rest, rcond=None)[0].tolist())
    return np.array([value for term in terms for value in (
        term.values[:1] if term.effect is SINE_RESPONSE
        else [next(found) for _ in term.fitted_indices])])


def run(terms: Sequence[Term], table: Table,
        generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the normalized errors of the fitted values, and of the compensated rates."""
    truth = GyroModel(tuple(terms))
    model = fit_effects(table.measure(truth, generator), [term.effect for term in terms]).model
    # the truth here is the mean of all sweeps, not the gyro in another run
    model = replace(model, tolerance=Tolerance())
    found = np.array([term.values[place] for term in model.terms for place in term.fitted_indices])
    errors = (found - expressed(truth, model)) / np.sqrt(np.diag(model.covariance))
    rate, temperature = (each.ravel() for each in np.meshgrid(
        np.linspace(-1.0, 1.0, 5) * table.fastest, np.array(table.temperatures)))
    output = truth.output(rate, temperature)
    given = compensate(model, output, temperature)
    variance = quadratic_form(uncertainty_covariance(model),
                              rate_sensitivity(model, output, given.rate, given.temperature))
    return errors, (given.rate - rate) / np.sqrt(variance)


def coverage(terms: Sequence[Term], table: Table, runs: int,
             seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how often the interval of each value held the truth, and that of each rate."""
    generator = np.random.default_rng(seed)
    errors = [run(terms, table, generator) for _ in range(runs)]
    values, rates = (np.mean(np.abs(each) <= 1.959964, axis=0) for each in zip(*errors))
    return values, rates


def row(name: str, held: tuple[np.ndarray, np.ndarray]) -> str:
    """Return a row of a table in Markdown, in percent."""
    figures = [f'{100 * each.mean():.1f} | {100 * each.min():.1f} to {100 * each.max():.1f}'
               for each in held]
    return f'| {name} | {figures[0]} | {figures[1]} |'


def main(runs: int) -> None:
    header = ('values, % | lowest to highest | rates, % | lowest to highest |\n'
              '|---|---|---|---|---|')
    print(f'| effect | {header}', flush=True)
    for seed, (name, terms) in enumerate(gyros().items()):
        print(row(f'`{name}`' if name in TRUTH else name, coverage(terms, Table(), runs, seed)),
              flush=True)
    print(f'\n| scatter | {header}', flush=True)
    for seed, (name, table) in enumerate(SCATTERS.items()):
        for words, terms in (('cubic', CUBIC), ('sine', SINE),
                             ('polynomial 3,2', (POLYNOMIAL,))):
            print(row(f'{name}; {words}', coverage(terms, table, runs, 100 + seed)), flush=True)


if __name__ == '__main__':
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
