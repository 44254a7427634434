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
Chance in tests: seeds that stay the same, and bounds of counts.

A test draws from the same seed in each run, by its name, and from another one as evidence. Where
it counts what happens at a stated rate, or measures a mean or a scatter, its bound is one that
chance alone breaks at most once in a million runs.
"""

import math
import secrets
import zlib

import numpy as np
import pytest
from scipy.stats import binom, chi2
from scipy.stats import t as student

#: Probability that a count, a mean or a scatter is beyond a bound although all is as stated.
RARE = 1e-6


def most(trials, rate):
    """Return how often something of a stated rate happens at most, in so many trials."""
    return int(binom.isf(RARE, trials, rate))


def fewest(trials, rate):
    """Return how often something of a stated rate happens at least, in so many trials."""
    return int(binom.ppf(RARE, trials, rate))


def rms_bounds(freedom):
    """
    Return the least and the largest root mean square of normal values of deviation 1.

    Of a scatter about the own mean, `freedom` is one less than there are values.
    """
    return tuple(math.sqrt(chi2.ppf(rare, freedom) / freedom) for rare in (RARE, 1.0 - RARE))


def mean_bound(values):
    """Return what the mean of normal values about zero is off at most, by their own scatter."""
    count = len(values)
    return (student.isf(0.5 * RARE, count - 1) * np.std(values, axis=0, ddof=1) / math.sqrt(count))


def evidence(*case):
    """Return a case of a test that runs as evidence alone."""
    return pytest.param(*case, marks=pytest.mark.evidence)


def seeds(count):
    """Return so many seeds of a test: the first in each run, the others as evidence."""
    return [0, *map(evidence, range(1, count))]


def seeded(name, fresh=False):
    """Return a source of random numbers by a name, or by a new seed, which is printed."""
    seed = secrets.randbits(32) if fresh else zlib.crc32(name.encode())
    print(f'seed {seed}')
    return np.random.default_rng(seed)
