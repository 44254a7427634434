"""
From dwells to a gyro's model: the values of given effects, how well they are known, and how well they predict sweeps left out.

The error of a dwell, output less rate, is the sum of the effects and of three scatters: its own, that of its sweep's bias, and that of its
sweep's scale factor (a bias that wanders, a temperature that the sensor does not show). How large they are is found by restricted
likelihood, so that thirty dwells of one sweep do not count as thirty independent ones.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.stats import t as student

from gyro_calibration.dwells import Dwells
from gyro_calibration.effects import Channels, Effect, Parameter
from gyro_calibration.likelihood import _robust_residual
from gyro_calibration.log import Array, DataRefused, Mask
from gyro_calibration.model import GyroModel, Term

#: A dwell beyond this many robust standard deviations is outlying, and is not fitted.
OUTLYING = 6.0
#: Beyond this condition number of the columns, each of length one, the data do not part the effects.
LARGEST_CONDITION = 1e3
#: With a smaller spread, K, a sensor's own error looks like a change of temperature.
SMALLEST_TEMPERATURE_SPREAD = 1.0
#: With fewer, what the dwells of a sweep have in common cannot be told from chance.
_FEWEST_SWEEPS = 4
#: With fewer, an outlying dwell cannot be told from a gyro that is not linear.
_FEWEST_DWELLS = 12


class EffectsNotParted(DataRefused):
    """
    Some effects look alike in these data.

    Attributes
    ----------
    effects : the names of those that look alike

    """

    def __init__(self, message: str, effects: Sequence[str]):
        super().__init__(message)
        self.effects = tuple(effects)


@dataclass(frozen=True)
class Scatter:
    """
    How dwells scatter about a surface over rate and temperature that is as smooth as their number allows, as standard deviations.

    It does not depend on the effects that are fitted: a scatter found beside too few of them would take in what they leave.

    Attributes
    ----------
    dwell : of a dwell, beyond its own deviation, rad/s
    dwell_scale : of the scale factor from dwell to dwell, 1; a table's speed is no better than that
    sweep_bias : of the bias from sweep to sweep, rad/s
    sweep_scale : of the scale factor from sweep to sweep, 1
    kept : which dwells are not outlying, shape (n,)

    """

    dwell: float
    dwell_scale: float
    sweep_bias: float
    sweep_scale: float
    kept: Mask


@dataclass(frozen=True)
class Calibration:
    """
    A model fitted to dwells, and what the fit shows.

    Attributes
    ----------
    model : effects with values, covariance and valid range; the covariance is wide enough for 1.96 standard deviations to hold 95 %
    dwells : all of them
    scatter : of the dwells, and which were fitted
    residual : error of each dwell that the effects do not explain, rad/s, shape (n,)
    left_out : the same for a fit without the dwell's sweep, rad/s, shape (n,); nan at outlying dwells, infinite where nothing predicts it
    deviation : standard deviation of each dwell, rad/s, shape (n,)
    condition : number of the columns, each of length one
    freedom : dwells less fitted values
    misfit : sum of the whitened squared residuals; about `freedom` where the effects are all there is

    """

    model: GyroModel
    dwells: Dwells
    scatter: Scatter
    residual: Array
    left_out: Array
    deviation: Array
    condition: float
    freedom: int
    misfit: float

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the effects of the model."""
        return tuple(term.effect for term in self.model.terms)

    @property
    def before_rms(self) -> float:
        """Return the root mean square of output less rate of what was fitted, rad/s."""
        return _rms((self.dwells.output - self.dwells.rate)[self.scatter.kept])

    @property
    def residual_rms(self) -> float:
        """Return the root mean square of the residual of what was fitted, rad/s."""
        return _rms(self.residual[self.scatter.kept])

    @property
    def left_out_rms(self) -> float:
        """Return the root mean square of the errors of sweeps left out, rad/s."""
        return _rms(self.left_out[self.scatter.kept])

    def predicted_misfit(self) -> Array:
        """Return the mean squared error of each sweep when it is left out, in variances of a dwell, shape (sweeps,)."""
        squares, used = (self.left_out / self.deviation) ** 2, take(self.dwells, self.scatter.kept)
        return np.array([squares[self.scatter.kept][rows].mean() for rows in _sweeps(used)])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values ** 2)))


def channels_of(dwells: Dwells) -> Channels:
    """Return what the effects look at."""
    temperature = np.full(len(dwells), np.nan) if dwells.temperature is None else dwells.temperature
    return Channels(dwells.rate, dwells.output, temperature)


def take(dwells: Dwells, which: Mask) -> Dwells:
    """Return some of the dwells, by a mask of shape (n,)."""
    temperature = None if dwells.temperature is None else dwells.temperature[which]
    places = tuple(place for place, wanted in zip(dwells.place, which) if wanted)
    return replace(dwells, rate=dwells.rate[which], output=dwells.output[which], temperature=temperature,
                   deviation=dwells.deviation[which], sweep=dwells.sweep[which], place=places)


def _sweeps(dwells: Dwells) -> list[Mask]:
    """Return a mask for each sweep; a single sweep counts as one a dwell, so that something can be left out."""
    numbers = np.unique(dwells.sweep)
    if len(numbers) == 1:
        return list(np.eye(len(dwells), dtype=bool))
    return [dwells.sweep == number for number in numbers]


# the covariance of the dwells

class _Whitener:
    """The covariance of the errors of dwells: block by block, since sweeps are independent of each other."""

    def __init__(self, dwells: Dwells, scatter: Scatter):
        """Factor the covariance of each sweep."""
        self.scatter = scatter
        self.deviation = _deviation(dwells, scatter)
        self.factors = [(np.flatnonzero(rows), self._factor(dwells.rate[rows], self.deviation[rows])) for rows in _sweeps(dwells)]

    def _factor(self, rate: Array, deviation: Array) -> Array:
        shared = self.scatter.sweep_bias ** 2 + self.scatter.sweep_scale ** 2 * np.outer(rate, rate)
        return np.linalg.cholesky(np.diag(deviation ** 2) + shared)

    def whiten(self, values: Array) -> Array:
        """Return columns of shape (n,) or (n, m) as independent ones of variance one."""
        whitened = np.empty_like(values)
        for rows, factor in self.factors:
            whitened[rows] = solve_triangular(factor, values[rows], lower=True)
        return whitened


def _deviation(dwells: Dwells, scatter: Scatter) -> Array:
    """Return the standard deviation of each dwell, without what its sweep shares, rad/s, shape (n,)."""
    return np.sqrt(np.nan_to_num(dwells.deviation) ** 2 + scatter.dwell ** 2 + (scatter.dwell_scale * dwells.rate) ** 2)


def find_scatter(dwells: Dwells) -> Scatter:
    """
    Return how dwells scatter, by restricted likelihood, and which of them are outlying.

    Raises
    ------
    DataRefused : too few dwells to say

    """
    error, surface = dwells.output - dwells.rate, _surface(dwells)
    kept = _not_outlying(error, surface)
    used, error, surface = take(dwells, kept), error[kept], _surface(take(dwells, kept))
    size = _rms(error - surface @ (surface.T @ error)) * math.sqrt(len(used) / max(len(used) - surface.shape[1], 1)) + 1e-15
    relative = size / max(float(np.abs(used.rate).max()), 1e-9)
    sought = 4 if len(np.unique(used.sweep)) >= _FEWEST_SWEEPS else 2
    units = np.array([size, relative, size, relative])[:sought if len(used) >= _FEWEST_DWELLS else 1]

    def scatter(logarithms: Array) -> Scatter:
        return Scatter(*np.append(units * np.exp(logarithms), np.zeros(4 - len(units))).tolist(), kept=kept)  # type: ignore[misc]

    best = minimize(lambda logarithms: -_restricted_likelihood(used, scatter(logarithms), error, surface),
                    np.array([0.0, -1.5, -1.5, -1.5])[:len(units)], method='Nelder-Mead', bounds=[(-7.0, 2.0)] * len(units),
                    options={'xatol': 0.02, 'fatol': 0.01})
    return scatter(best.x)


def _surface(dwells: Dwells) -> Array:
    """Return orthonormal columns that span a smooth surface over rate and temperature, one for three dwells at most, shape (n, m)."""
    rate = dwells.rate / max(float(np.abs(dwells.rate).max()), 1e-9)
    temperature = np.zeros(len(rate)) if dwells.temperature is None else dwells.temperature - dwells.temperature.mean()
    temperature = temperature / max(float(np.abs(temperature).max()), 0.5 * SMALLEST_TEMPERATURE_SPREAD)
    powers = sorted(((i, j) for i in range(6) for j in range(3)), key=lambda power: (power[0] + 2 * power[1], power[1]))
    products = [rate ** i * temperature ** j for i, j in powers]
    columns = np.column_stack([*products[:4], np.abs(rate), *products[4:]])[:, :max(len(rate) // 3, min(len(rate) - 1, 2))]
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, sizes > 1e-4 * sizes[0]]


def _not_outlying(error: Array, surface: Array) -> Mask:
    """Return which dwells lie as the others do, by a fit in which a large residual counts by its size, not its square."""
    residual = np.abs(_robust_residual(surface, error, 20))
    return (residual <= OUTLYING * 1.4826 * float(np.median(residual)) + 1e-12) | (len(error) < _FEWEST_DWELLS)


def _restricted_likelihood(dwells: Dwells, scatter: Scatter, error: Array, columns: Array) -> float:
    """Return the logarithm of the likelihood of the scatter, whatever the values are, up to a constant."""
    deviation = _deviation(dwells, scatter)
    scaled = np.column_stack([columns, error]) / deviation[:, None]
    shared = np.column_stack([np.full(len(error), scatter.sweep_bias), scatter.sweep_scale * dwells.rate]) / deviation[:, None]
    inner, outer = (_sums_by_sweep(dwells, shared[:, :, None] * each[:, None, :]) for each in (shared, scaled))
    inner = inner + np.eye(2)
    # the inverse of a diagonal and two columns a sweep, by Woodbury's identity
    gram = scaled.T @ scaled - np.tensordot(outer, np.linalg.solve(inner, outer), axes=((0, 1), (0, 1)))
    factor = np.linalg.cholesky(gram)
    log_determinant = 2.0 * float(np.log(deviation).sum()) + float(np.linalg.slogdet(inner)[1].sum())
    return -0.5 * (log_determinant + 2.0 * float(np.log(np.diag(factor)[:-1]).sum()) + float(factor[-1, -1]) ** 2)


def _sums_by_sweep(dwells: Dwells, values: Array) -> Array:
    """Return the sums of the values, shape (n, ...), over each sweep, shape (sweeps, ...)."""
    order = np.argsort(dwells.sweep, kind='stable')
    return np.add.reduceat(values[order], np.flatnonzero(np.diff(dwells.sweep[order], prepend=-1)))


# the fit

def fit_effects(dwells: Dwells, effects: Sequence[Effect], scatter: Scatter | None = None) -> Calibration:
    """
    Fit effects to dwells by generalised least squares, solved by QR.

    Effects of the rate look at the reference rate. The polynomial of Ojeda et al. (eq. 9 to 12) looks at the output, which does no harm
    where the output is an average. A shape is found by Gauss-Newton steps from the best of a grid over its bounds.

    Parameters
    ----------
    dwells : of a rate table or a log
    effects : each once
    scatter : of the dwells, if it is known already

    Raises
    ------
    EffectsNotParted : some of the effects look alike in these dwells
    DataRefused : too few dwells

    """
    _refuse_unseen(dwells, effects)
    terms = tuple(Term(effect, tuple(_start(parameter, dwells) for parameter in effect.parameters)) for effect in effects)
    _refuse_few(dwells, terms)
    scatter = scatter or find_scatter(dwells)
    used = take(dwells, scatter.kept)
    whitener = _Whitener(used, scatter)
    return _calibration(dwells, _solve(used, _search(used, terms), whitener), whitener)


def _start(parameter: Parameter, dwells: Dwells) -> float:
    """Return a value to begin with; those of conventions, such as the temperature to count from, stay."""
    temperature = np.zeros(2) if dwells.temperature is None else dwells.temperature
    conventions = {
        'reference_temperature': round(float(temperature.mean()), 1),
        'output_centre': 0.5 * float(dwells.output.max() + dwells.output.min()),
        'output_scale': 0.5 * float(np.ptp(dwells.output)) or 1.0,
        'temperature_centre': 0.5 * float(temperature.max() + temperature.min()),
        'temperature_scale': 0.5 * float(np.ptp(temperature)) or 1.0,
    }
    return conventions.get(parameter.name, parameter.default or 0.0)


def error_of(dwells: Dwells, terms: Sequence[Term]) -> Array:
    """Return what effects leave of the errors of the dwells, rad/s, shape (n,)."""
    channels = channels_of(dwells)
    return dwells.output - dwells.rate - sum(term.error(channels) for term in terms)


def columns_of(dwells: Dwells, terms: Sequence[Term]) -> Array:
    """Return what the error changes by for each fitted value, shape (n, m)."""
    channels = channels_of(dwells)
    return np.column_stack([row for term in terms for row in term.sensitivity(channels)])


def _search(dwells: Dwells, terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """Set every fitted shape to the best of a grid over its bounds, the others being as they are."""
    for number, term in enumerate(terms):
        for place in term.fitted:
            if place < len(term.effect.shapes):
                grid = np.geomspace(*term.effect.shapes[place].bounds, 60).tolist()
                tried = [(*terms[:number], _with(term, place, value), *terms[number + 1:]) for value in grid]
                terms = min(tried, key=lambda each: _linear_misfit(dwells, each))
    return terms


def _with(term: Term, place: int, value: float) -> Term:
    low, high = term.effect.parameters[place].bounds
    return replace(term, values=(*term.values[:place], min(max(value, low), high), *term.values[place + 1:]))


def _linear_misfit(dwells: Dwells, terms: Sequence[Term]) -> float:
    """Return the sum of squares that is left when the coefficients, not the shapes, are fitted."""
    channels = channels_of(dwells)
    columns = [term.columns(channels)[place - len(term.effect.shapes)] for term in terms for place in term.fitted
               if place >= len(term.effect.shapes)]
    error = error_of(dwells, terms)
    matrix = np.column_stack([*columns, np.zeros(len(dwells))])
    return float(np.sum((error - matrix @ np.linalg.lstsq(matrix, error, rcond=None)[0]) ** 2))


def _solve(dwells: Dwells, terms: tuple[Term, ...], whitener: _Whitener) -> tuple[Term, ...]:
    """Take Gauss-Newton steps; where only coefficients are fitted the first is the solution."""
    for _ in range(20):
        orthogonal, triangle, lengths = _factor(dwells, terms, whitener)
        step = solve_triangular(triangle, orthogonal.T @ whitener.whiten(error_of(dwells, terms))) / lengths
        terms = _moved(terms, step)
        if np.all(np.abs(step) * lengths < 1e-6):  # of a standard deviation
            break
    return terms


def _moved(terms: Sequence[Term], step: Array) -> tuple[Term, ...]:
    changes, moved = iter(step.tolist()), []
    for term in terms:
        for place in term.fitted:
            term = _with(term, place, term.values[place] + next(changes))
        moved.append(term)
    return tuple(moved)


def _factor(dwells: Dwells, terms: Sequence[Term], whitener: _Whitener) -> tuple[Array, Array, Array]:
    """Return Q and R of the whitened columns, each of length one, and their lengths before."""
    columns = whitener.whiten(columns_of(dwells, terms))
    lengths = np.linalg.norm(columns, axis=0)
    orthogonal, triangle = np.linalg.qr(columns / np.where(lengths > 0.0, lengths, 1.0))
    if not np.linalg.cond(triangle) < LARGEST_CONDITION:
        raise _not_parted(terms, triangle)
    return orthogonal, triangle, lengths


# what a fit shows

def _calibration(dwells: Dwells, terms: tuple[Term, ...], whitener: _Whitener) -> Calibration:
    kept = whitener.scatter.kept
    used = take(dwells, kept)
    orthogonal, triangle, lengths = _factor(used, terms, whitener)
    whitened, freedom = whitener.whiten(error_of(used, terms)), len(used) - len(lengths)
    left_out, deviation = np.full(len(dwells), np.nan), np.full(len(dwells), np.nan)
    left_out[kept], deviation[kept] = _left_out(orthogonal, whitened, whitener), whitener.deviation
    misfit = float(whitened @ whitened)
    model = _model(used, terms, _covariance(used, terms, whitener, misfit, freedom))
    return Calibration(model, dwells, whitener.scatter, error_of(dwells, terms), left_out, deviation, float(np.linalg.cond(triangle)),
                       freedom, misfit)


def _left_out(orthogonal: Array, whitened: Array, whitener: _Whitener) -> Array:
    """Return what a fit without its sweep leaves of each dwell's error: the deleted residuals, block by block."""
    left_out = np.empty_like(whitened)
    for rows, factor in whitener.factors:
        rest = np.eye(len(rows)) - orthogonal[rows] @ orthogonal[rows].T
        alone = np.linalg.eigvalsh(rest)[0] < 1e-9  # only this sweep shows some value
        left_out[rows] = math.inf if alone else factor @ np.linalg.solve(rest, whitened[rows])
    return left_out


def _covariance(dwells: Dwells, terms: Sequence[Term], whitener: _Whitener, misfit: float, freedom: int) -> Array | None:
    """Return the covariance, wider by Student's factor and where the effects leave more than the scatter; None with no dwell to spare."""
    if freedom == 0:
        return None
    alone = replace(whitener.scatter, sweep_bias=0.0, sweep_scale=0.0)
    covariance, without_sweeps = (_inverse(*_factor(dwells, terms, each)[1:]) for each in (whitener, _Whitener(dwells, alone)))
    share = np.clip(1.0 - np.diag(without_sweeps) / np.diag(covariance), 0.0, 1.0)
    # Satterthwaite (1946): the part that sweeps have in common is known from few values, the other from many
    freedoms = 1.0 / (share ** 2 / _sweep_freedom(dwells) + (1.0 - share) ** 2 / freedom)
    widened = student.ppf(0.975, freedoms) / 1.959964 * math.sqrt(max(misfit / freedom, 1.0))
    return covariance * np.outer(widened, widened)


def _sweep_freedom(dwells: Dwells) -> float:
    """Return the number of sweeps, less what of the surface differs from sweep to sweep as their biases do."""
    sweeps, surface = _sweeps(dwells), _surface(dwells)
    shared = sum(float(np.sum(surface[rows].sum(axis=0) ** 2)) / rows.sum() for rows in sweeps)
    return max(len(sweeps) - shared, 1.0)


def _inverse(triangle: Array, lengths: Array) -> Array:
    """Return the covariance of the values from R of their whitened columns."""
    inverse = solve_triangular(triangle, np.eye(len(lengths))) / lengths[:, None]
    return inverse @ inverse.T


def _model(dwells: Dwells, terms: tuple[Term, ...], covariance: Array | None) -> GyroModel:
    outputs, temperatures = dwells.output, dwells.temperature
    middle = 25.0 if temperatures is None else round(float(temperatures.mean()), 1)
    temperature_range = (-math.inf, math.inf) if temperatures is None else (float(temperatures.min()), float(temperatures.max()))
    return GyroModel(terms, covariance, (float(outputs.min()), float(outputs.max())), temperature_range, middle)


# refusals

def _refuse_few(dwells: Dwells, terms: Sequence[Term]) -> None:
    values = sum(len(term.fitted) for term in terms)
    if len(dwells) < values:
        raise DataRefused(f'{len(dwells)} dwells do not determine {values} values; add dwells, or fit fewer effects')


def _refuse_unseen(dwells: Dwells, effects: Sequence[Effect]) -> None:
    thermal = [effect.name for effect in effects if 'temperature' in effect.looks_at]
    if not thermal:
        return
    unseen = f'{", ".join(thermal)} cannot be seen'
    if dwells.temperature is None:
        raise EffectsNotParted(f'{unseen}: the log holds no temperature; record temperature_degc too', thermal)
    spread = float(np.ptp(dwells.temperature))
    if spread < SMALLEST_TEMPERATURE_SPREAD:
        raise EffectsNotParted(f'{unseen}: the temperature varies by {spread:.2g} K, wanted at least {SMALLEST_TEMPERATURE_SPREAD:g} K; '
                               'repeat the rates at another temperature', thermal)


def _not_parted(terms: Sequence[Term], triangle: Array) -> EffectsNotParted:
    """Return the refusal that names the effects whose columns add up to nearly nothing, and what would part them."""
    direction = np.abs(np.linalg.svd(triangle)[2][-1])
    owners = [term.effect for term in terms for _ in term.fitted]
    alike = [effect for effect in dict.fromkeys(owners)
             if max(size for size, owner in zip(direction, owners) if owner is effect) > 0.1 * direction.max()]
    names = [effect.name for effect in alike]
    if len(names) == 1:
        return EffectsNotParted(f'{names[0]} cannot be determined from these dwells; {alike[0].shown_by}', names)
    advice = '; '.join(dict.fromkeys(effect.shown_by for effect in alike[::-1] if effect.shown_by))
    return EffectsNotParted(f'{", ".join(names)} look alike in these dwells and cannot be parted; {advice}, or leave one out', names)


# looking at it

@dataclass(frozen=True)
class Bin:
    """
    Dwells of nearly one rate, or nearly one temperature.

    Attributes
    ----------
    low, high : ends of the bin, in the unit of what was binned
    count : of dwells
    before, residual : mean error without the model and with it, rad/s
    deviation : standard deviation of the mean residual, rad/s
    rms : of the residual, rad/s

    """

    low: float
    high: float
    count: int
    before: float
    residual: float
    deviation: float
    rms: float


def binned(fit: Calibration, values: Array, most: int = 8) -> list[Bin]:
    """Return the errors over one quantity, shape (n,), in bins of equal width that hold something."""
    edges = np.linspace(values.min(), values.max(), min(most, len(np.unique(values))) + 1)
    place = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, len(edges) - 2)
    rows = [np.flatnonzero((place == number) & fit.scatter.kept) for number in range(len(edges) - 1)]
    return [_bin(fit, float(low), float(high), part) for low, high, part in zip(edges, edges[1:], rows) if len(part)]


def _bin(fit: Calibration, low: float, high: float, rows: NDArray[np.intp]) -> Bin:
    before, residual = (fit.dwells.output - fit.dwells.rate)[rows], fit.residual[rows]
    deviation = math.sqrt(float(np.sum(fit.deviation[rows] ** 2))) / len(rows)
    return Bin(low, high, len(rows), float(before.mean()), float(residual.mean()), deviation, _rms(residual))
