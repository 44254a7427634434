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
Headings over spans: the change of a reference regressed on what the gyro integrates to.

The reference errs, and its errors are larger than those of the gyro over seconds. So the heading
of the reference is observed, and all columns are integrals of what the gyro says: nothing of the
reference is a regressor. With the output ``y``, the rate ``w`` that the values so far make of it,
and effects ``y = w + b + s w + sum(a f(w, T, t, ...))``, the heading ``psi`` of the reference is,
at points ``t`` and less a constant::

    psi(t) - J(t + d) = -b t - s J_w(t) - sum(a J_f(t)) + d w(t) + errors of the reference

with ``J`` the integrals. A point is the mean over some samples; the observations are the
differences between points, so that a gap of the reference is a long span that the gyro bridges.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.diagnosis.compared import bridged, white_noise
from gyro_calibration.diagnosis.reference import integral_of
from gyro_calibration.effects import CATALOGUE, Channels
from gyro_calibration.history import channels_of
from gyro_calibration.log import Array, DEGREE, Log
from gyro_calibration.noise_grid import GridFit, heading_noise, noise_grid, SharedNoise, wander
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.ndimage import median_filter
from scipy.stats import t as student

#: Names and prior standard deviations of the values that every model has: what gyros on wheels are
#: sold with (scale 1 %, bias 1 deg/s), and delays of references (1 s).
PLAIN = {'scale_factor_error': 0.01, 'bias': DEGREE, 'time_offset': 1.0}
#: Length of a span, s; most spans of a log; stretches whose scores count as independent, s.
SPAN, MOST_SPANS, STRETCH = 1.0, 400, 15.0
#: Evidence of fewer stretches establishes nothing.
FEWEST_STRETCHES = 3.0
#: A point counts no less than one that errs by so many times the usual.
_WILDEST = 10.0
#: What is not fitted keeps its value to this part of the prior.
_NOT = 1e-6
#: Delays of a reference that are tried first, s.
_DELAYS = np.arange(-1.5, 1.501, 0.05)
#: Angle random walk of gyros on wheels at most, rad/√s (1.7 deg/√h): samples may vibrate more.
_WALK = 5e-4
#: Cosines of a bias that wanders, and the bias instability that gyros on wheels have, rad/s (up to
#: 40 deg/h).
_COSINES, _WANDER = 12, (1e-6, 2e-4)
#: A gyro rests where its course is lost for so long, s, and its output is as quiet as ever.
_REST, _QUIET = 3.0, 2.0


@dataclass(frozen=True)
class Column:
    """
    One cause as columns of the regression.

    Attributes
    ----------
    cause : its name
    shapes : of the effect
    once : whether it happens at one time only

    """

    cause: str
    shapes: tuple[float, ...] = ()
    once: bool = False


@dataclass(frozen=True)
class Spans:
    """
    One log as n spans between n + 1 points, and r rests.

    Attributes
    ----------
    log : with output, time and reference heading
    channels : what effects look at; the rate is that of the gyro, as corrected so far
    place : point of each known row of the reference
    known : these rows
    time, heading : of the points, s and rad, shape (n + 1,)
    rests : begin and end row of each stretch at rest
    delay : by which the stamps of the gyro are late beside the reference, s

    """

    log: Log
    channels: Channels
    known: NDArray[np.intp]
    place: NDArray[np.intp]
    time: Array
    heading: Array
    rests: tuple[tuple[int, int], ...]
    delay: float = 0.0

    @property
    def stretches(self) -> NDArray[np.intp]:
        """Return the number of the stretch of each observation, shape (n + r,)."""
        middle = 0.5 * (self.time[1:] + self.time[:-1]) - self.time[0]
        count = max(int(np.ceil(middle[-1] / STRETCH)), 1)
        of_spans = np.minimum(middle * count / (middle[-1] + 1e-9), count - 1).astype(np.intp)
        return np.concatenate([of_spans, count + np.arange(len(self.rests))])

    def points(self, values: Array) -> Array:
        """Return the means of a signal at the points, its delay taken off, shape (n + 1,)."""
        assert self.log.time is not None
        stamps = self.log.time[self.known] + self.delay
        moved = np.interp(stamps, self.log.time, values)
        return np.bincount(self.place, moved) / np.bincount(self.place)

    def integrals(self, rate: Array) -> Array:
        """Return the change of the integral of a rate over spans and rests, shape (n + r,)."""
        assert self.log.time is not None
        whole = integral_of(self.log.time, np.broadcast_to(rate, self.log.time.shape))
        still = [whole[end] - whole[begin] for begin, end in self.rests]
        return np.concatenate([np.diff(self.points(whole)), still])

    def changes(self, values: Array) -> Array:
        """Return the change of a signal over spans, 0 over rests, shape (n + r,)."""
        return np.concatenate([np.diff(self.points(values)), np.zeros(len(self.rests))])

    @property
    def observed(self) -> Array:
        """Return the change of the reference less that of the integral of the output, (n + r,)."""
        assert self.log.output is not None
        turned = np.concatenate([np.diff(self.heading), np.zeros(len(self.rests))])
        return turned - self.integrals(self.log.output)

    def plain(self) -> Array:
        """Return the columns of scale factor error, bias and delay, shape (n + r, 3)."""
        rate = np.asarray(self.channels.rate)
        return np.column_stack(
            [-self.integrals(rate), -self.integrals(np.ones_like(rate)), self.changes(rate)]
        )

    def columns(self, cause: Column) -> Array:
        """Return the columns of a cause, shape (n + r, k)."""
        heading = np.asarray(self.channels.heading)
        if cause.cause == 'reference_once_per_rev':
            found = [self.changes(wave(heading)) for wave in (np.sin, np.cos)]
        elif cause.cause == 'reference_slip':
            found = [
                self.changes((np.asarray(self.channels.time) >= cause.shapes[0]).astype(float))
            ]
        else:
            effect = CATALOGUE[cause.cause]
            found = [
                -self.integrals(np.asarray(each))
                for each in effect.columns(self.channels, *cause.shapes)
            ]
        return np.column_stack(found)

    def rates(self) -> Array:
        """Return the rate at the points, rad/s, shape (n + 1,)."""
        return self.points(np.asarray(self.channels.rate))

    def corrected(self, values: Array) -> Spans:
        """Return the spans with the rate that scale factor error and bias make of the output."""
        assert self.log.output is not None
        assert self.log.time is not None
        rate = (self.log.output - values[1]) / (1.0 + values[0])
        moved = replace(self, delay=self.delay + float(values[2]))
        turned = integral_of(self.log.time, rate)
        # of the reference, and between its points of the gyro
        away = np.interp(
            self.log.time - moved.delay, self.time, self.heading - moved.points(turned)
        )
        channels = replace(self.channels.moving(rate, self.log.output), heading=turned + away)
        return replace(moved, channels=channels)


@dataclass(frozen=True)
class Fitted:
    """
    A regression with its noise.

    Attributes
    ----------
    spans : the log
    causes : beside scale factor error, bias and delay
    fit : of the restricted likelihood
    values, covariance : estimates and their cluster-robust covariance
    stretches_of : effective number of stretches that each value rests on
    prior : standard deviations of what is known of scale factor error, bias and delay beforehand

    """

    spans: Spans
    causes: tuple[Column, ...]
    fit: GridFit
    values: Array
    covariance: Array
    stretches_of: Array
    prior: Array

    def half(self, place: int) -> float:
        """Return half the length of the interval of 95 % of a value."""
        freedom = max(self.stretches_of[place] - 1.0, 1.0)
        deviation = math.sqrt(max(self.covariance[place, place], 0.0))
        half = float(student.ppf(0.975, freedom)) * deviation
        prior = list(PLAIN.values())
        return min(half, 1.96 * prior[place]) if place < len(prior) else half

    def size(self, name: str) -> float:
        """Return the likeliest size of a part of the noise."""
        return float(self.fit.likely.get(name, 0.0))


def spans_of(log: Log) -> Spans:
    """Lay a log with a reference heading out in spans."""
    assert log.time is not None and log.output is not None
    time, output = log.time - log.time[0], bridged(log.output)
    log = replace(log, time=time, output=output)
    reference = log.reference_heading
    assert reference is not None
    known = np.flatnonzero(np.isfinite(reference))
    length = max(SPAN, float(time[known[-1]] - time[known[0]]) / MOST_SPANS)
    # a gap begins a new point
    number = np.floor((time[known] - time[known[0]]) / length)
    place = np.cumsum(
        (np.diff(number, prepend=number[0]) > 0.0)
        | (np.diff(time[known], prepend=time[known[0]]) > length)
    )
    count = np.bincount(place)
    heading = np.bincount(place, reference[known]) / count
    middle = np.bincount(place, time[known]) / count
    channels = replace(channels_of(log), rate=output, time=time, heading=integral_of(time, output))
    return Spans(log, channels, known, place, middle, heading, _rests(log, known))


def _rests(log: Log, known: NDArray[np.intp]) -> tuple[tuple[int, int], ...]:
    """Return begin and end row of stretches without a course in which the gyro is quiet."""
    assert log.time is not None and log.output is not None
    edges = np.concatenate([[0], known, [len(log.time) - 1]])
    second = max(round(1.0 / float(np.median(np.diff(log.time)))), 2)
    blocks = len(log.output) // second
    if blocks < 8:
        return ()
    scatter = log.output[: blocks * second].reshape(blocks, second).std(axis=1)
    quiet = _QUIET * float(scatter.min()) + 1e-12
    found = []
    for begin, end in zip(edges[:-1], edges[1:]):
        first, last = -(-int(begin) // second) + 1, int(end) // second - 1
        run: list[int] = []
        for block in [*range(first, last + 1), -1]:
            if 0 <= block < blocks and scatter[block] <= quiet:
                run.append(block)
                continue
            if len(run) >= _REST:
                found.append((run[0] * second, (run[-1] + 1) * second - 1))
            run = []
    return tuple(found)


def fitted(spans: Spans, causes: Sequence[Column] = (), passes: int = 2) -> Fitted:
    """
    Fit scale factor error, bias, delay and causes, with the noise of gyro and reference.

    A scale factor error that rests on fewer stretches than `FEWEST_STRETCHES` is one with what the
    reference did there. It is left at 0, and its interval is that of the prior.

    """
    spans = replace(spans, delay=spans.delay if spans.delay else _first_delay(spans))
    outlying: Array = np.ones(len(spans.time))
    moved = spans
    for _ in range(passes):
        columns = all_columns(moved, causes)
        values = _robust(moved, columns)
        moved = moved.corrected(values)
        left = moved.observed - all_columns(moved, causes) @ np.append(
            values[:2], [0.0, *values[3:]]
        )
        outlying = _outlying(left[: len(spans.time) - 1])
    columns = all_columns(moved, causes)
    prior = np.array(list(PLAIN.values()))
    fit = _likelihood(moved, columns, outlying, prior)
    covariance, effective = _cluster_robust(
        moved, fit, causes, np.append(prior, np.full(len(fit.values) - 3, np.inf))
    )
    if effective[0] < FEWEST_STRETCHES:
        moved = moved.corrected(np.append(0.0, fit.values[1:3]))
        prior[0] *= _NOT
        fit = _likelihood(moved, all_columns(moved, causes), outlying, prior)
        covariance[0, 0] = PLAIN['scale_factor_error'] ** 2
    values = fit.values.copy()
    values[2] += moved.delay
    return Fitted(moved, tuple(causes), fit, values, covariance, effective, prior)


def all_columns(spans: Spans, causes: Sequence[Column]) -> Array:
    """Return the columns of scale factor error, bias and delay, and those of causes."""
    return np.column_stack([spans.plain(), *(spans.columns(each) for each in causes)])


def _first_delay(spans: Spans) -> float:
    """Return the delay at which gyro and reference agree best, by the median of what is left."""
    best = math.inf, 0.0
    for delay in _DELAYS:
        moved = replace(spans, delay=float(delay))
        columns = moved.plain()[:, :2]
        left = _robustly(
            columns, moved.observed, np.array([PLAIN['scale_factor_error'], PLAIN['bias']])
        )[1]
        best = min(
            best,
            (
                float(np.mean(np.minimum(np.abs(left[: len(spans.time) - 1]), 10.0 * DEGREE))),
                float(delay),
            ),
        )
    return best[1]


def _robust(spans: Spans, columns: Array) -> Array:
    prior = np.concatenate([list(PLAIN.values()), np.full(columns.shape[1] - 3, np.inf)])
    return _robustly(columns, spans.observed, prior)[0]


def _robustly(columns: Array, observed: Array, prior: Array) -> tuple[Array, Array]:
    """Return values by weighted least squares, large residuals counting less, and what is left."""
    left: Array = observed
    values: Array = np.zeros(columns.shape[1])
    own = np.diag(np.where(prior < np.inf, 1.0 / prior, 0.0))
    for _ in range(5):
        size = 1.4826 * float(np.median(np.abs(left))) + 1e-12
        weight = 1.0 / np.maximum(np.abs(left) / (2.0 * size), 1.0) / size
        rows = np.vstack([columns * weight[:, None], own])
        values = np.asarray(
            np.linalg.lstsq(rows, np.append(observed * weight, np.zeros(len(prior))), rcond=None)[
                0
            ]
        )
        left = np.asarray(observed - columns @ values)
    return values, left


def _outlying(left: Array) -> Array:
    """Return the variance of each point beside the usual one, larger where it stands out."""
    point = np.concatenate([[0.0], np.cumsum(left)])
    middle = median_filter(point, 9, mode='nearest')
    off = np.abs(point - middle)
    # what drifts one way is its own median
    size = (
        1.4826
        * max(float(np.median(off)), float(np.median(np.abs(np.diff(point, 2)))) / math.sqrt(6.0))
        + 1e-9
    )
    return np.clip(off / (3.0 * size), 1.0, _WILDEST) ** 2


def _likelihood(spans: Spans, columns: Array, outlying: Array, prior: Array) -> GridFit:
    """Fit by the restricted likelihood over a grid of noise, rests beside the spans."""
    assert spans.log.output is not None and spans.log.time is not None
    step = float(np.median(np.diff(spans.log.time)))
    walk = min(max(white_noise(spans.log.output) * math.sqrt(step), 1e-9), _WALK)
    still = np.array([spans.log.time[end] - spans.log.time[begin] for begin, end in spans.rests])
    parts = [
        replace(
            part,
            diagonal=np.concatenate(
                [part.diagonal, still if part.neighbours is None else 0.0 * still]
            ),
            neighbours=None
            if part.neighbours is None
            else np.concatenate([part.neighbours, 0.0 * still]),
        )
        for part in heading_noise(
            spans.time, spans.rates(), outlying, angle_random_walk=(0.1 * walk, walk)
        )
    ]
    waves, shared = _waves(spans)
    deviation = np.full(columns.shape[1], np.inf)
    deviation[:3] = prior
    return noise_grid(spans.observed, columns, parts, waves, shared, prior_deviation=deviation)


def _cluster_robust(
    spans: Spans, fit: GridFit, causes: Sequence[Column], prior: Array
) -> tuple[Array, Array]:
    """
    Return the covariance of the values, not less than the scatter of the scores between stretches.

    Also the effective number of stretches that each value rests on: the squared sum of the
    information of the stretches over the sum of its squares.

    """
    stretch, whiten = spans.stretches, whitening(spans, fit)
    clusters = int(stretch.max()) + 1
    plain = all_columns(spans, causes)
    columns = whiten @ plain
    # whitened, scores of neighbouring stretches are independent
    left = whiten @ (spans.observed - plain @ fit.values)
    influence = columns @ np.linalg.pinv(columns.T @ columns + np.diag(1.0 / prior**2))
    scores = np.array([np.bincount(stretch, part * left, clusters) for part in influence.T])
    found = clusters / max(clusters - 1.0, 1.0) * np.sum(scores**2, axis=1)
    larger = np.maximum(np.sqrt(found / np.diag(fit.covariance)), 1.0)
    shares = np.array([np.bincount(stretch, part**2, clusters) for part in columns.T])
    effective = shares.sum(axis=1) ** 2 / np.maximum((shares**2).sum(axis=1), 1e-300)
    return fit.covariance * np.outer(larger, larger), effective


def _waves(spans: Spans) -> tuple[Array, list[SharedNoise]]:
    """Return the columns of a wandering bias over spans and rests, and their noise."""
    assert spans.log.time is not None
    waves, shared = wander(spans.time, _WANDER, None, _COSINES)
    begin, end = spans.time[0], spans.time[-1]
    omega = math.pi * np.arange(1, waves.shape[1] + 1) / (end - begin)
    still = [np.clip(spans.log.time[list(rest)], begin, end) - begin for rest in spans.rests]
    return np.vstack(
        [waves, *(np.diff(np.sin(omega * each[:, None]), axis=0) / omega for each in still)]
    ), shared


def whitening(spans: Spans, fit: GridFit) -> Array:
    """Return the inverse root of the covariance of the observations, shape (n + r, n + r)."""
    count = len(spans.observed)
    precision = fit.solve(np.eye(count))
    waves, shared = _waves(spans)
    variance = sum(fit.likely[part.name] ** 2 * part.variance for part in shared)
    covariance = np.linalg.inv(0.5 * (precision + precision.T)) + (waves * variance) @ waves.T
    root = cholesky(0.5 * (covariance + covariance.T), lower=True)
    return np.asarray(solve_triangular(root, np.eye(count), lower=True))
