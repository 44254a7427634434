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
it counts what happens at a stated rate, its bound is one that chance alone breaks at most once in
a million runs.

"""

import secrets
import zlib

import numpy as np
from scipy.stats import binom

#: Probability that a count is beyond a bound although the rate is as stated.
RARE = 1e-6


def most(trials, rate):
    """Return how often something of a stated rate happens at most, in so many trials."""
    return int(binom.isf(RARE, trials, rate))


def fewest(trials, rate):
    """Return how often something of a stated rate happens at least, in so many trials."""
    return int(binom.ppf(RARE, trials, rate))


def seeded(name, fresh=False):
    """Return a source of random numbers by a name, or by a new seed, which is printed."""
    seed = secrets.randbits(32) if fresh else zlib.crc32(name.encode())
    print(f'seed {seed}')
    return np.random.default_rng(seed)
