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
No value poisons the state: no model of the catalogue, sample or temperature.

Hypothesis looks for values that break a claim. `make test` tries a fixed choice;
GYRO_CALIBRATION_EXAMPLES multiplies their number and chooses them at random.
"""

import math
import os

from gyro_calibration.files import MAX_MAGNITUDE
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import CATALOGUE, rate_temperature_polynomial
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

hypothesis = pytest.importorskip('hypothesis', reason='hypothesis is not installed')
st = hypothesis.strategies

MORE = int(os.environ.get('GYRO_CALIBRATION_EXAMPLES', '1'))
INTERVAL = 0.04
NOISE = Noise(7.3e-4, 8.7e-5)

FINITE = st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.floats(-3.0, 3.0),
                   st.sampled_from([0.0, 30.0, -30.0, 99.0, 500.0, -512.0, 1e16, -1e16, 1e155,
                                    1e200, -1e308, 1.7e308]))


def tries(examples):
    return hypothesis.settings(
        max_examples=examples * MORE, derandomize=MORE == 1, deadline=None, database=None,
        suppress_health_check=[hypothesis.HealthCheck.too_slow,
                               hypothesis.HealthCheck.function_scoped_fixture])


def value(parameter):
    """Return values that a model file may hold for a parameter, most of them ordinary."""
    low, high = np.clip(parameter.bounds, -MAX_MAGNITUDE, MAX_MAGNITUDE).tolist()
    usual = st.floats(max(low, -0.05), min(high, 0.05)) if low <= 0.05 else st.just(low)
    return st.one_of(usual, st.floats(low, high), st.sampled_from([low, high]))


@st.composite
def models(draw):
    """Return models with one effect of the catalogue or several."""
    polynomial = rate_temperature_polynomial(draw(st.integers(0, 4)), draw(st.integers(0, 3)))
    chosen = draw(st.lists(st.sampled_from([polynomial, *CATALOGUE.values()]), min_size=1,
                           max_size=4, unique_by=lambda each: each.name))
    terms = tuple(Term(each, tuple(draw(value(parameter)) for parameter in each.parameters))
                  for each in chosen)
    rates = draw(st.sampled_from([(-math.inf, math.inf), (-2.0, 2.0), (0.0, 0.0), (1.0, 2.0)]))
    temperatures = draw(st.sampled_from([(-math.inf, math.inf), (10.0, 40.0)]))
    calibration = draw(
        st.sampled_from([None, SelfCalibration(0.04, 0.002), SelfCalibration(-0.9, 3.0)]))
    return GyroModel(terms, None, rates, temperatures, noise=NOISE, self_calibration=calibration)


@tries(150)
@hypothesis.given(models(), st.lists(st.tuples(FINITE, st.one_of(st.floats(-20.0, 60.0), FINITE)),
                                     min_size=1, max_size=5))
def test_every_output_gives_a_finite_rate(model, samples):
    output, temperature = np.array(samples).T
    time = np.arange(len(output)) * INTERVAL
    around = (model.start_history().update(time, temperature, 0.0 * time + 9.8)
              if model.needs_history else None)
    done = compensate(model, output, temperature, around)
    assert (np.isfinite(done.rate).all() and np.isfinite(done.model_rate).all()
            and np.isfinite(done.temperature).all())
    assert np.broadcast_to(done.beyond_range, len(output))[np.abs(output) > model.rate_limit].all()
    for one, degc in samples if not model.needs_history else ():
        single = compensate(model, one, degc)
        assert math.isfinite(single.rate) and math.isfinite(single.model_rate)


@pytest.mark.parametrize('place', ['sensitivity', 'mean', 'covariance'])
def test_a_state_that_is_not_finite_is_reported_and_built_anew_with_the_last_heading(place):
    tracker = HeadingTracker(NOISE, np.diag([1e-4, 1e-8]), TrackerSettings())
    for index in range(500):
        tracker.add(INTERVAL * index, 0.3, np.array([-0.3, -1.0]))
    heading, variance, said = tracker.heading, tracker.variance, []
    if place == 'sensitivity':
        said.append(tracker.add(INTERVAL * 500, 0.3, np.array([math.nan, -1.0])))
    else:
        getattr(tracker._state, place)[1] = math.nan
    said += [tracker.add(INTERVAL * (501 + index), 0.3, np.array([-0.3, -1.0]))
             for index in range(200)]
    shown = (tracker.heading, tracker.variance, tracker.rate, tracker.rate_variance,
             tracker.deleted_heading, *tracker.bias)
    assert tracker.rebuild_count == 1 and sum(map(bool, said)) == 1
    assert all(map(math.isfinite, shown)) and tracker.variance >= 0.0
    assert (abs(tracker.heading - heading - 0.3 * INTERVAL * 201) < 0.5
            and tracker.variance > variance + 1.0)
