"""
Logs as a regression: the residual and the columns in the cosine transform, whitened, with the noises that may be in them.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gyro_calibration.diagnosis.candidates import Candidate, columns_of, fitted_shapes, with_shape
from gyro_calibration.diagnosis.evidence import Beside, Judged, Noises, Places, Sample, beside, judge, log_sum, sample, sums
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.spectrum import Shape, angles, bands, inverse, noise_grid
from gyro_calibration.effects import CATALOGUE
from gyro_calibration.log import Array

#: A shape is changed by this part of itself to see what its column changes by.
_SMALL = 1e-4


@dataclass(frozen=True)
class Named:
    """A cause in the list, with the values of its columns; without them nothing is known of what its shapes change."""

    candidate: Candidate
    values: tuple[float, ...] = ()


@dataclass(frozen=True)
class Field:
    """
    The logs and the noises that may be in them.

    Attributes
    ----------
    replays : the logs
    first : the noise by which all is divided at first
    deviation : what it gives each coefficient, over that of white noise, shape (m,)
    starts : first coefficient of each band
    shapes : noises that are tried
    noises : the same, as weights of the bands

    """

    replays: tuple[Replay, ...]
    first: Shape
    deviation: Array
    starts: Places
    shapes: tuple[Shape, ...]
    noises: Noises

    def angles(self) -> tuple[Array, Array]:
        """Return pi k / n of each coefficient, and the interval of its log, s."""
        parts = [angles(each.points) for each in self.replays]
        return np.concatenate(parts), np.concatenate([np.full(len(part), each.step) for part, each in zip(parts, self.replays)])

    def divided(self, noise: int) -> Array:
        """Return what whitens coefficients that are divided by the first noise already, shape (m,)."""
        count = np.diff(np.append(self.starts, len(self.deviation)))
        return np.repeat(np.sqrt(self.noises.weights[noise]), count)


def field(replays: Sequence[Replay]) -> Field:
    """Lay out the logs with a grid of noises."""
    reference = _rounding(replays) if any(each.rounded for each in replays) else 0.0
    return _field(tuple(replays), Shape(reference=reference), noise_grid(
        min(each.step for each in replays), max(each.duration for each in replays), reference))


def _rounding(replays: Sequence[Replay]) -> float:
    """Return how strong the rounding of a reference heading is beside white noise, where both are likeliest."""
    shapes = [Shape(reference=ratio) for ratio in (0.0, *np.geomspace(1e-3, 1e4, 43))]
    tried = _field(tuple(replays), Shape(), [replace(shape, walk=walk) for shape in shapes for walk in (0.0, 1e-4, 1e-2)])
    done = work(tried, [])
    return tried.shapes[int(done.judged.likelihood[0].argmax())].reference


def _field(replays: tuple[Replay, ...], first: Shape, shapes: Sequence[Shape]) -> Field:
    parts = [(angles(each.points), each.step) for each in replays]
    deviation = np.sqrt(np.concatenate([first.variance(angle, step) / step for angle, step in parts]))
    offsets = np.cumsum([0, *(len(angle) for angle, _ in parts)])
    starts = np.concatenate([bands(angle, step) + offset for (angle, step), offset in zip(parts, offsets)])
    count = np.diff(np.append(starts, offsets[-1])).astype(float)
    # Some coefficients of a band are enough to know its mean variance.
    few = [np.unique(np.linspace(begin, end - 1.0, 9).round().astype(int)) for begin, end in zip(starts, [*starts[1:], offsets[-1]])]
    angle, step = np.concatenate([part for part, _ in parts]), np.concatenate([np.full(len(part), step) for part, step in parts])
    chosen, first_of = np.concatenate(few), np.cumsum([0, *(len(part) for part in few)])[:-1]
    relative = np.array([np.add.reduceat(shape.variance(angle[chosen], step[chosen]) / step[chosen] / deviation[chosen] ** 2, first_of)
                         for shape in shapes]) / [len(part) for part in few]
    # Each combination of parts has an even chance; that parts come in many sizes must not outweigh that they may not be there.
    kinds = [(bool(each.walk), bool(each.strength), bool(each.flicker)) for each in shapes]
    rare = [np.log(kinds.count(kind)) for kind in kinds]
    noises = Noises(1.0 / relative, np.log(relative) @ count + 2.0 * np.array(rare))
    return Field(replays, first, deviation, starts, tuple(shapes), noises)


@dataclass(frozen=True)
class Work:
    """
    A field with some causes in it.

    Attributes
    ----------
    field : with the rate that the gyro sees, if something happens to it before
    plain : the logs as they are
    named : causes
    residual : whitened, without what the causes of fixed amplitude make, shape (m,)
    columns : whitened and independent: scale factor error, those of the causes, what their shapes change, shape (q, m)
    owner : of each column: (place of the cause, or -1 for the scale; place of its value, or minus one less place of its shape)
    widths : of each cause, how many columns with free values it has
    sample, by, judged : see `evidence`

    """

    field: Field
    plain: tuple[Replay, ...]
    named: tuple[Named, ...]
    residual: Array
    columns: Array
    owner: tuple[tuple[int, int], ...]
    widths: tuple[int, ...]
    sample: Sample
    by: Beside
    judged: Judged

    @property
    def score(self) -> float:
        """
        Return the logarithm of the likelihood at the best values, averaged over the noises.

        It is the restricted likelihood without what it says of the units of the columns: see `evidence`.

        """
        judged, best = self.judged, int(self.judged.likelihood[0].argmax())
        _, logarithm = np.linalg.slogdet(self.by.own[best])
        return float(log_sum(judged.likelihood)[0] + 0.5 * (logarithm - len(self.columns) * np.log(judged.squares[0, best])))

    def white(self) -> list[Array]:
        """Return what is left of each log by the likeliest noise, as white noise in time of variance 1: shape (points,) each."""
        values, _ = self.estimates
        left = self.residual - values @ self.columns
        best = int(self.judged.likelihood[0].argmax())
        left = left * self.field.divided(best) * np.sqrt(self.by.freedom / self.judged.squares[0, best])
        return [inverse(part) for part in np.split(left, np.cumsum([each.points - 1 for each in self.field.replays])[:-1])]

    @property
    def estimates(self) -> tuple[Array, Array]:
        """Return the values of the independent columns and their covariance, averaged over the noises."""
        probable = self.judged.probability[0]
        kept = np.flatnonzero(probable > 1e-3 * probable.max())
        weights = probable[kept] / probable[kept].sum()
        covariance = np.linalg.inv(self.by.own[kept])
        crossed = self.field.noises.weights[kept] @ self.sample.own[0]
        values = np.einsum('gpq,gq->gp', covariance, crossed)
        mean = weights @ values
        inside = np.einsum('g,gpq->pq', weights * self.judged.squares[0, kept] / self.by.freedom, covariance)
        return mean, inside + np.einsum('g,gp,gq->pq', weights, values - mean, values - mean)


def is_of_the_rate(name: str) -> bool:
    """Tell whether a cause changes the rate before anything is added to it."""
    return name in CATALOGUE and CATALOGUE[name].stage == 'rate'


def seen(each: Replay, named: Sequence[Named]) -> Replay:
    """Return a log with the rate that the gyro sees."""
    rate, time = each.channels.rate, each.channels.time
    for known in named:
        if is_of_the_rate(known.candidate.cause):
            distortion = CATALOGUE[known.candidate.cause].distortion
            assert distortion is not None
            rate = distortion(rate, time, *known.candidate.shapes)
    return each.with_rate(rate)


def work(whole: Field, named: Sequence[Named], extra: Sequence[Candidate] = ()) -> Work:
    """
    Put causes into a field.

    Parameters
    ----------
    whole : the logs as they are
    named : causes with their shapes and values
    extra : candidates whose columns are nuisances too

    """
    replays = [seen(each, named) for each in whole.replays]
    widths = []
    residual = np.concatenate([
        each.noisy(each.channels.output - each.reference - (new.channels.rate - each.channels.rate))
        for each, new in zip(whole.replays, replays)])
    columns, owner = [np.concatenate([each.coefficients(each.channels.rate) for each in replays])[None]], [(-1, 0)]
    for place, known in enumerate(named):
        own = columns_of(known.candidate, replays if not is_of_the_rate(known.candidate.cause) else whole.replays)
        widths.append(len(own) if known.candidate.amplitude is None else 0)
        if known.candidate.amplitude is None:
            columns.append(own)
            owner += [(place, number) for number in range(len(own))]
        elif not is_of_the_rate(known.candidate.cause):
            residual = residual - known.candidate.amplitude * own[0]
        changes = _changes(known, whole.replays if is_of_the_rate(known.candidate.cause) else replays, own) if known.values else []
        columns += [change[None] for _, change in changes]
        owner += [(place, -1 - number) for number, _ in changes]
    for candidate in extra:
        own = columns_of(candidate, replays)
        columns.append(own)
        owner += [(-2, 0)] * len(own)
    return _judged(replace(whole, replays=tuple(replays)), whole.replays, tuple(named), residual / whole.deviation,
                   np.concatenate(columns) / whole.deviation, tuple(owner), tuple(widths))


def _changes(known: Named, replays: Sequence[Replay], own: Array) -> list[tuple[int, Array]]:
    """Return what the sum of a cause's columns changes by with each shape that is fitted and smooth."""
    found: list[tuple[int, Array]] = []
    for place in free_shapes(known.candidate):
        shape = known.candidate.shapes[place]
        step = _SMALL * abs(shape) if shape else 1e-6
        moved = columns_of(with_shape(known.candidate, place, shape + step), replays)
        found.append((place, np.tensordot(known.values, moved - own, 1) / step))
    return found


def free_shapes(candidate: Candidate) -> list[int]:
    """Return the places of the shapes that a fit may change a little: not those of a step, nor conventions."""
    return [] if candidate.cause in ('bias_step', 'dead_zone') else fitted_shapes(candidate)


def with_one_more(before: Work, candidate: Candidate) -> Work:
    """Put one cause more into a field, at its shapes as they are; what is there already is not made again."""
    if is_of_the_rate(candidate.cause):
        return work(replace(before.field, replays=before.plain), [*before.named, Named(candidate)])
    own, residual, columns = columns_of(candidate, before.field.replays) / before.field.deviation, before.residual, before.columns
    owner, place = before.owner, len(before.named)
    if candidate.amplitude is None:
        columns = np.concatenate([columns, own])
        owner = (*owner, *((place, number) for number in range(len(own))))
    else:
        residual = residual - candidate.amplitude * own[0]
    widths = (*before.widths, len(own) if candidate.amplitude is None else 0)
    return _judged(before.field, before.plain, (*before.named, Named(candidate)), residual, columns, owner, widths)


def with_columns(before: Work, columns: Array) -> Work:
    """Put whitened columns more into a field, which belong to no cause."""
    owner = (*before.owner, *[(-2, 0)] * len(columns))
    return _judged(before.field, before.plain, before.named, before.residual, np.concatenate([before.columns, columns]), owner,
                   before.widths)


def _judged(whole: Field, plain: tuple[Replay, ...], named: tuple[Named, ...], residual: Array, columns: Array,
            owner: tuple[tuple[int, int], ...], widths: tuple[int, ...]) -> Work:
    """Sum whitened residual and columns, those that are independent, and judge them."""
    kept = _independent(columns)
    of = columns[kept]
    nothing = np.empty((0, len(residual)))
    given = sample(residual[None], of, nothing, whole.starts)
    by = beside(sums(of, nothing, (), whole.starts), (), whole.noises)
    return Work(whole, plain, named, residual, of, tuple(owner[place] for place in kept), widths, given, by,
                judge(given, whole.noises, by))


def _independent(columns: Array) -> list[int]:
    """Return the columns that are not made of those before them, nor zero."""
    product = columns @ columns.T
    length = np.sqrt(np.diag(product))
    kept: list[int] = []
    for place in np.flatnonzero(length > 0.0).tolist():
        own = product[np.ix_(kept, kept)] / np.outer(length[kept], length[kept])
        towards = product[kept, place] / (length[kept] * length[place])
        if 1.0 - (towards @ np.linalg.solve(own, towards) if kept else 0.0) > 1e-9:
            kept.append(place)
    return kept
