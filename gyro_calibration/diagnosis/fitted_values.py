# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Values that a search found: those of effects, of bias and scale, and what they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from gyro_calibration.diagnosis.candidates import fitted_shapes
from gyro_calibration.diagnosis.regression_problem import (
    deviation_of_leaping,
    Fitted,
    is_of_the_rate,
    leaping_shapes,
    Named,
    seen,
)
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from scipy.linalg import block_diag


@dataclass(frozen=True)
class Value:
    """A fitted value and its standard deviation."""

    value: float
    deviation: float


@dataclass(frozen=True)
class FittedValues:
    """
    A field with its causes, as values.

    Attributes
    ----------
    fitted : the causes in the field
    replays : the logs as they were laid out
    lasting : whether effects of the gyro that happen once are fitted, but explain nothing, as in a
        model for other logs

    """

    fitted: Fitted
    replays: tuple[Replay, ...]
    lasting: bool = False

    @property
    def named(self) -> tuple[Named, ...]:
        """Return the causes."""
        return self.fitted.named

    def explaining(self, cause: int) -> bool:
        """Tell whether a cause, by its place, is in what is explained."""
        return not (self.lasting and happens_once(self.named[cause]))

    @cached_property
    def _estimates(self) -> tuple[dict[tuple[int, int], int], Array, Array]:
        values, covariance = self.fitted.estimates
        return {owner: rank for rank, owner in enumerate(self.fitted.owner)}, values, covariance

    @cached_property
    def _leaping(self) -> dict[tuple[int, int], float]:
        """Return standard deviations of shapes whose columns leap, by cause and place."""
        return {(place, -1 - shape): deviation_of_leaping(self.fitted, place, shape)
                for place, known in enumerate(self.named)
                for shape in leaping_shapes(known.candidate)}

    def place(self, cause: int, number: int) -> int | None:
        """Return the place of a value among the estimates: column from 0, or shape below 0."""
        ranks = [*self.fitted.owner, *self._leaping]
        return ranks.index((cause, number)) if (cause, number) in ranks else None

    @property
    def covariance(self) -> Array:
        """Return that of all estimates."""
        return np.asarray(block_diag(self._estimates[2],
                                     np.diag(np.square(list(self._leaping.values())))))

    def _value(self, cause: int, number: int, known: float | None = None) -> Value:
        ranks, values, covariance = self._estimates
        place = ranks.get((cause, number))
        if place is None:
            return (Value(0.0, 0.0) if known is None
                    else Value(known, self._leaping.get((cause, number), 0.0)))
        return Value(float(values[place]) if known is None else known,
                     float(np.sqrt(max(covariance[place, place], 0.0))))

    @property
    def scale_factor_error(self) -> Value:
        """Return what the scale factor differs by from the simulation's, 1."""
        return self._value(-1, 0)

    def coefficients(self, cause: int) -> list[Value]:
        """Return the values of the columns of a cause."""
        candidate = self.named[cause].candidate
        if candidate.amplitude is not None:
            return []
        return [self._value(cause, number) for number in range(len(self.named[cause].values))]

    def shapes(self, cause: int) -> dict[int, Value]:
        """Return the fitted shapes of a cause, by their places."""
        candidate = self.named[cause].candidate
        return {place: self._value(cause, -1 - place, candidate.shapes[place])
                for place in fitted_shapes(candidate)}

    @cached_property
    def explained(self) -> list[Array]:
        """Return what causes and scale add to each log's output, less bias, rad/s, shape (n,)."""
        return [self.explains(each, run) for run, each in enumerate(self.replays)]

    def parts(self, each: Replay, run: int) -> dict[str, Array]:
        """Return what the scale and each cause add to the output of a log, rad/s, shape (n,)."""
        found: dict[str, Array | float] = {}
        new = each
        for known in self.named:
            if is_of_the_rate(known.candidate.cause):
                before, new = new, seen(new, [known])
                found[known.candidate.cause] = new.channels.rate - before.channels.rate
        found['scale_factor_error'] = self.scale_factor_error.value * new.channels.rate
        for place, known in enumerate(self.named):
            candidate = known.candidate
            if (is_of_the_rate(candidate.cause) or candidate.run not in (None, run)
                    or not self.explaining(place)):
                continue
            values = ([candidate.amplitude] if candidate.amplitude is not None
                      else [one.value for one in self.coefficients(place)])
            for value, column in zip(values, candidate.columns(new)):
                found[candidate.cause] = found.get(candidate.cause, 0.0) + value * column
        return {name: np.asarray(part) for name, part in found.items()}

    def explains(self, each: Replay, run: int) -> Array:
        """Return what the causes and the scale add to the output of a log."""
        return np.asarray(sum(self.parts(each, run).values()))

    def heading_changes(self, run: int,
                        plain: FittedValues | None) -> tuple[dict[str, Array], Array]:
        """
        Return what adds to the change of heading of a log, rad, and its times, s.

        Parameters
        ----------
        run : number of the log
        plain : bias and scale that the simulation has already; None where it has none

        """
        each = self.replays[run]
        parts = {**self.parts(each, run), 'bias': np.full(len(each.kept), self.biases[run]),
                 'left': self.residuals[run] - self.biases[run]}
        if plain is not None:
            parts['scale_factor_error'] -= plain.explains(each, run)
            parts['bias'] -= plain.biases[run]
        return ({name: each.on_grid(part) * each.step for name, part in parts.items()},
                np.arange(each.points + 1) * each.step)

    @cached_property
    def residuals(self) -> list[Array]:
        """Return what is left of each log, its bias too, rad/s, shape (n,)."""
        return [each.channels.output - each.reference - added
                for each, added in zip(self.replays, self.explained)]

    @cached_property
    def biases(self) -> list[float]:
        """Return the bias of each log beside the simulation's, rad/s."""
        return [float(left[each.kept].mean()) for each, left in zip(self.replays, self.residuals)]

    @cached_property
    def bias_variance(self) -> float:
        """Return the variance of the mean bias by the uncertainty of other values, (rad/s)²."""
        means = np.array([self._mean_change(place, number) for place, number in self.fitted.owner])
        return float(means @ self._estimates[2] @ means)

    def _mean_change(self, cause: int, number: int) -> float:
        """Return by what one more of a cause's value, or of the scale, lowers the mean bias."""
        if cause < 0:
            parts = [seen(each, self.named).channels.rate for each in self.replays]
        elif number >= 0 and self.explaining(cause):
            parts = [self.named[cause].candidate.columns(seen(each, self.named))[number]
                     for each in self.replays]
        else:
            return 0.0
        return float(np.mean([part[each.kept].mean() for part, each in zip(parts, self.replays)]))


def happens_once(known: Named) -> bool:
    """Tell whether a cause is an effect of the gyro in one of the logs: a step or a tone."""
    return known.candidate.run is not None and known.candidate.cause in CATALOGUE


def joined(parts: Sequence[Array]) -> Array:
    """Return the values of all logs in one array."""
    return np.concatenate(list(parts))
