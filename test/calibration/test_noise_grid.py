# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The restricted likelihood over a grid of noise sizes: by the textbook, and its sizes."""

import math

from gyro_calibration.calibration.noise_grid import (
    BandedNoise, bias_wander_columns, fit_noise_grid, heading_noise, SharedNoise)
import numpy as np
import pytest

DEGREE = math.pi / 180.0
SCALE, BIAS = 1.01, 0.3 * DEGREE


def headings(generator, count=240, walk=0.2 * DEGREE, reference=0.5 * DEGREE, motion=0.03):
    """Return times, rates, and headings of a gyro's integral and of a reference with noise."""
    time = np.arange(count + 1.0)
    rate = (20.0 * DEGREE * np.sin(2.0 * math.pi * time / 37.0)
            * (np.sin(2.0 * math.pi * time / 131.0) > -0.3))
    true = np.cumsum(rate)
    turned = SCALE * true + BIAS * time + np.cumsum(generator.standard_normal(count + 1)) * walk
    return (time, rate, turned,
            true + (reference + motion * np.abs(rate)) * generator.standard_normal(count + 1))


def fitted(time, rate, turned, seen, **options):
    cosines, wanders = bias_wander_columns(time)
    columns = np.column_stack([np.diff(seen), np.diff(time)])
    return fit_noise_grid(np.diff(turned), columns, heading_noise(time, rate, **options), cosines,
                          wanders, wandering_value=1)


def test_at_known_sizes_it_is_the_restricted_likelihood_of_the_textbook():
    generator = np.random.default_rng(1)
    n, q = 40, 3
    columns, shared, observed = (generator.standard_normal((n, 2)),
                                 generator.standard_normal((n, q)), generator.standard_normal(n))
    parts = [BandedNoise('a', np.full(n, 2.0), np.full(n, -0.9), (0.5, 0.5)),
             BandedNoise('b', np.linspace(1.0, 2.0, n), None, (1.5, 1.5))]
    variance = np.array([1.0, 0.5, 0.1])
    found = fit_noise_grid(observed, columns, parts, shared, [_shared('c', variance, 2.0)])
    dense = 0.25 * (2.0 * np.eye(n) - 0.9 * np.eye(n, k=1)
                    - 0.9 * np.eye(n, k=-1)) + 2.25 * np.diag(np.linspace(1.0, 2.0, n))
    dense += shared @ np.diag(4.0 * variance) @ shared.T
    inverse = np.linalg.inv(dense)
    information = columns.T @ inverse @ columns
    values = np.linalg.solve(information, columns.T @ inverse @ observed)
    left = observed - columns @ values
    wanted = -0.5 * (
        np.linalg.slogdet(dense)[1] + np.linalg.slogdet(information)[1] + left @ inverse @ left)
    assert found.log_evidence == pytest.approx(wanted, rel=1e-9)
    np.testing.assert_allclose(found.values, values, rtol=1e-8)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-8)


def _shared(name, variance, size):
    return SharedNoise(name, variance, (size, size))


def test_the_sizes_of_the_noise_are_found():
    found = fitted(*headings(np.random.default_rng(2), 2000, walk=0.5 * DEGREE,
                             reference=0.2 * DEGREE, motion=0.1))
    for name, size in (('angle_random_walk', 0.5 * DEGREE), ('reference', 0.2 * DEGREE),
                       ('motion', 0.1)):
        estimate, low, high = found.sizes[name]
        assert 0.4 * size < estimate < 2.5 * size and 0.99 * low <= estimate <= 1.01 * high, (
            name, found.sizes[name])


def test_a_size_far_from_the_points_of_the_first_grid_is_found():
    """The first points are a factor of 18 apart."""
    white = np.random.default_rng(5).standard_normal(400)
    for size in np.geomspace(0.03, 0.6, 13):
        found = fit_noise_grid(size * white, np.ones((400, 1)),
                               [BandedNoise('size', np.ones(400), None, (1e-4, 10.0))])
        assert found.size('size') == pytest.approx(size * white.std(ddof=1), rel=0.02)


def test_too_few_observations_are_refused():
    with pytest.raises(ValueError, match='2 observations do not determine 2 values'):
        fit_noise_grid(np.zeros(2), np.eye(2), [BandedNoise('a', np.ones(2), None, (1.0, 1.0))])


def test_a_span_that_the_gyro_does_not_cover_shows_nothing():
    """Its points have errors of their own, whatever its observation would be."""
    generator = np.random.default_rng(1)
    time, is_measured = np.arange(0.0, 60.0, 0.5), np.ones(119, dtype=bool)
    is_measured[60] = False
    turned = np.diff(0.01 * time + 0.02 * generator.standard_normal(120))
    turned[61] += 0.5  # an error of the point after it that would be one of the point before, too
    columns = (np.diff(time) * is_measured)[:, None]
    parts = heading_noise(time, np.zeros(120), is_measured=is_measured)
    found = []
    for observation in (0.0, 3.0):
        turned[60] = observation
        found.append(fit_noise_grid(turned, columns, [parts[0], parts[1], parts[3]]))
    assert found[0].values == pytest.approx(found[1].values, rel=1e-3)
    assert found[0].size('reference') == pytest.approx(found[1].size('reference'), rel=1e-3)
