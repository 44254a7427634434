# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Allan variances at octaves, and the terms of their covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import itertools

from gyro_calibration.allan.chart import AllanChart
from gyro_calibration.allan.covariance import covariance_form
from gyro_calibration.allan.parts import BEND_PLACE, PARTS, QUANTIZATION
from gyro_calibration.logs.log import Array
import numpy as np


@dataclass(frozen=True)
class Octaves:
    """
    Allan variances at octaves and the terms of their covariance, all in samples.

    Attributes
    ----------
    variance : shape (n,)
    columns : of each part, and of a bend, for a coefficient of 1, shape (n, 6)
    forms : the covariance as a quadratic form of squared coefficients, shape (n, n, 5, 5)

    """

    variance: Array
    columns: Array
    forms: Array

    @classmethod
    def of(cls, chart: AllanChart) -> Octaves:
        columns = np.column_stack([*(part.variance(chart.size) for part in PARTS),
                                   -QUANTIZATION.variance(chart.size)])
        scarcity = np.sqrt((chart.samples + 1 - 2 * chart.size) / chart.differences)
        forms = (_forms(chart.samples, tuple(chart.size.tolist()))
                 * np.outer(scarcity, scarcity)[:, :, None, None])
        return cls(chart.deviation ** 2, columns, forms)

    def since(self, start: int) -> Octaves:
        """Leave out the shortest averaging times."""
        return Octaves(self.variance[start:], self.columns[start:], self.forms[start:, start:])

    def covariance(self, squares: Array) -> Array:
        """Return the covariance of the variances, shape (n, n), for these squared coefficients."""
        return np.einsum('ijpq,p,q->ij', self.forms, squares[:BEND_PLACE], squares[:BEND_PLACE])

    def model(self, squares: Array) -> Array:
        """Return the sum of the parts for these squared coefficients, kept above zero."""
        return np.maximum(self.columns @ squares, 1e-3 * self.variance)


@lru_cache(maxsize=8)
def _forms(samples: int, sizes: tuple[int, ...]) -> Array:
    """Return the covariances as forms of the squared coefficients, shape (n, n, 5, 5)."""
    forms = np.zeros((len(sizes),) * 2 + (len(PARTS),) * 2)
    for i, j in itertools.combinations_with_replacement(range(len(sizes)), 2):
        form = covariance_form(samples, sizes[i], sizes[j])
        forms[i, j] = forms[j, i] = 0.5 * (form + form.T)
    return forms
