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
from gyro_calibration.diagnosis.generic_terms import is_named
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

    """

    fitted: Fitted
    replays: tuple[Replay, ...]

    @property
    def named(self) -> tuple[Named, ...]:
        """Return the causes."""
        return self.fitted.named

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

    def explains(self, each: Replay, run: int, gyro_only: bool = False) -> Array:
        """Return what the causes and the scale add to the output of a log."""
        new = seen(each, self.named)
        total = ((new.channels.rate - each.channels.rate)
                 + self.scale_factor_error.value * new.channels.rate)
        for place, known in enumerate(self.named):
            candidate = known.candidate
            if is_of_the_rate(candidate.cause) or (candidate.run not in (None, run)):
                continue
            if gyro_only and (not is_named(candidate) or candidate.cause.startswith('reference')):
                continue
            values = ([candidate.amplitude] if candidate.amplitude is not None
                      else [one.value for one in self.coefficients(place)])
            total = total + sum(value * column
                                for value, column in zip(values, candidate.columns(new)))
        return total

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
        elif number >= 0:
            parts = [self.named[cause].candidate.columns(seen(each, self.named))[number]
                     for each in self.replays]
        else:
            return 0.0
        return float(np.mean([part[each.kept].mean() for part, each in zip(parts, self.replays)]))


def joined(parts: Sequence[Array]) -> Array:
    """Return the values of all logs in one array."""
    return np.concatenate(list(parts))
