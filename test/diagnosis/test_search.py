# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The search covers all logs, pays for all that it could have found, and bounds each value."""

import math

from diagnosed import diagnosis_of, established, held
from gyro_calibration.diagnosis.candidates import (
    Candidate, effect_candidate, generic_terms, is_named, propose_candidates)
from gyro_calibration.diagnosis.findings import MIN_PREDICTION_SIGMAS
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.regression import build_problem, fit_causes
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.search import (
    confirm_causes, evidence_for, held_out_sigmas, p_value, refine_jointly, search_causes,
    start_search)
from gyro_calibration.logs.log import Log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration_bench.hidden import hide
import numpy as np
import pytest

NOISE = 1e-3  # rad/s, of a sample
TIME = np.arange(8000) / 20.0


def resting(added=0.0, time=TIME, seed=0, **columns):
    output = added + NOISE * np.random.default_rng(seed).standard_normal(len(time))
    return Log(output=output, time=time, moving=np.zeros(len(time)), **columns)


def laid(log, kept=None):
    return replay(log, np.ones(len(log), bool) if kept is None else kept, np.random.default_rng(0))


def tone(size, frequency, time=TIME, phase=0.3):
    return size * np.sin(2.0 * np.pi * frequency * time + phase)


def found_in(replays):
    search = start_search(replays)
    return search, search_causes(search)


def gained(search, named):
    return (fit_causes(search.problem, named).log_likelihood
            - fit_causes(search.problem, []).log_likelihood)


@pytest.mark.parametrize('cause, added, places', [
    ('interference_tone', tone(3e-4, 3.3), len(TIME)), ('bias_step', 3e-4 * (TIME > 150.0), 30),
    ('~time', 8e-4 * np.exp(-0.5 * ((TIME - 150.0) / 8.0) ** 2), 10)])
def test_what_may_be_anywhere_pays_for_the_places_to_the_end(cause, added, places):
    search, named = found_in([laid(resting(added))])
    assert [each.cause for each in named] == [cause]
    assert evidence_for(search, named, 0) < gained(search, named) - math.log(places)


def test_what_one_stretch_shows_does_not_predict_the_others():
    lasting, brief = tone(4e-4, 3.3), np.where(abs(TIME - 203.0) < 2.0, tone(2e-2, 3.3), 0.0)
    search, named = found_in([laid(resting(lasting))])
    assert held_out_sigmas(search, named)[0] > MIN_PREDICTION_SIGMAS
    search = start_search([laid(resting(brief))])
    named = refine_jointly(search, named)
    assert (evidence_for(search, named, 0) > 10.0
            and held_out_sigmas(search, named)[0] < MIN_PREDICTION_SIGMAS)


@pytest.mark.parametrize('name, shape', [('dead_zone', 'dead_zone'), ('bias_step', 'step_time')])
def test_a_shape_whose_column_leaps_has_an_interval(name, shape):
    log, = hide([name], 5.0, np.random.default_rng(3), noise='white', duration=600.0,
                sample_rate=25.0)
    found = diagnosis_of([log], np.random.default_rng(0))
    finding = next(each for each in found.findings if each.effect == name)
    cause, size = log.truth[name], finding.parameters[shape]
    truth = cause.shapes.get(shape, cause.size)
    deviation = (size.interval[1] - size.interval[0]) / 3.92
    assert 0.0 < abs(size.estimate - truth) + deviation < 5.0 * deviation, size
    assert held([cause], [finding], 4.0) == {name: True}
    places = [(term.effect.name, value) for term in found.model.terms
              for value in term.fitted_indices]
    if name == 'bias_step':  # it happens once
        assert (name, 0) not in places
        return
    place = places.index((name, 0))
    assert math.sqrt(found.model.covariance[place, place]) == pytest.approx(deviation, rel=0.01)


def test_a_tone_above_what_is_searched_has_its_own_frequency_and_size():
    time = np.arange(60_000) / 100.0
    each = laid(resting(tone(1e-3, 30.0, time), time))
    assert each.decimation == 2
    _, named = found_in([each])
    assert [known.cause for known in named] == ['interference_tone']
    assert (named[0].shapes[0] == pytest.approx(30.0, abs=1e-3)
            and math.hypot(*named[0].values) == pytest.approx(1e-3, rel=0.05))


def test_a_tone_in_each_log_has_a_phase_in_each():
    time = TIME[:2000]
    logs = [resting(tone(1e-3, 3.3, time, 0.3 + 2.0 * run), time, run) for run in range(3)]
    findings = diagnose(logs, np.random.default_rng(0)).findings
    assert [each.effect for each in findings] == 3 * ['interference_tone']
    assert sorted(each.parameters['phase'].estimate % (2.0 * math.pi)
                  for each in findings) == pytest.approx([0.3, 2.3, 4.3], abs=0.5)


@pytest.mark.parametrize('largest', [
    lambda number, run: NOISE * number * (6.0 if run == 2 else 1.0),
    lambda number, run: NOISE * number + (run == 2) * 2e-4 * np.cumsum(number)])
def test_noise_that_is_larger_in_one_of_several_logs_is_no_cause(largest):
    time = TIME[:4000]
    for seed in range(3):
        numbers = np.random.default_rng(seed).standard_normal((3, len(time)))
        logs = [Log(output=largest(number, run), time=time, moving=np.zeros(len(time)))
                for run, number in enumerate(numbers)]
        found = diagnose(logs, np.random.default_rng(0))
        assert found.verdict == 'adequate'


def test_what_is_established_is_significant_given_all_that_is():
    at = 261.0
    for size in (7e-5, 1e-4, 1.3e-4, 1.6e-4, 1.9e-4):
        search = start_search([laid(resting(size * (at <= TIME)))])
        named = refine_jointly(search, [effect_candidate('bias_step', at, log_index=0)])
        assert all(p_value(each.cause, evidence_for(search, selected, place)) < search.rate
                   for selected in [confirm_causes(search, named).named]
                   for place, each in enumerate(selected))


def test_a_scale_factor_of_a_part_of_a_log_is_not_blamed_on_the_temperature():
    generator, time = np.random.default_rng(4), np.arange(6000) * 0.05
    rate = np.sin(0.9 * time) * np.sin(0.11 * time)
    part = (time > 105.0) & (time < 195.0)
    log = Log(output=(1.0 + 0.004 * part) * rate + 1e-3 * generator.standard_normal(6000),
              time=time, reference_rate=rate,
              temperature=30.0 + 12.0 * np.sin(2.0 * math.pi * time / 180.0 + 3.0))
    found = diagnose([log], generator)
    assert not established(found)
    assert 'rate and time' in [each.along for each in found.unexplained]
    assert any('an effect of a part of the log' in remark for remark in found.remarks)


LATE = (TIME >= 200.0) & (TIME < 300.0)


def test_a_step_is_found_where_the_kept_samples_begin_late():
    search, named = found_in([laid(resting(6e-4 * (TIME >= 261.0)), LATE)])
    assert [known.cause for known in named] == ['bias_step']
    assert named[0].shapes[0] == pytest.approx(261.0, abs=2.0)
    moments = [each.shapes[0]
               for each in search.candidates if each.cause in ('bias_step', '~time')]
    assert moments and 200.0 < min(moments) < max(moments) < 300.0


def test_what_a_log_cannot_show_is_not_searched_for():
    rate = 0.5 - 0.5 * np.cos(0.1 * TIME) * np.sin(0.013 * TIME)
    output = 1.01 * rate + NOISE * np.random.default_rng(0).standard_normal(len(TIME))
    log = Log(output=output, time=TIME, reference_rate=rate,
              temperature=25.0 + 0.05 * np.sin(0.03 * TIME))
    shown = diagnose([log], np.random.default_rng(0)).cannot_show
    assert {'bias_temperature', 'scale_factor_temperature',
            'thermal_lag'} <= {name for name in shown if 'less than 0.2 K' in shown[name]}
    assert 'bias' in shown['scale_factor_asymmetry'] and 'quadratic_nonlinearity' not in shown
    replays = [laid(log)]
    searched_for = {each.cause for each in (*propose_candidates(replays), *generic_terms(replays))}
    assert not [name for name in searched_for if 'temperature' in name
                or shown.get(name, '').endswith('changes')]
    assert 'rate_ramp' in {each.cause for each in propose_candidates(replays) if is_named(each)}


def test_columns_that_nearly_depend_on_each_other_leave_a_positive_residual():
    time = np.arange(0.0, 21.0, 0.08)
    rate = 0.3 * np.sin(0.6 * time)
    log = Log(time=time, reference_rate=rate, output=rate + 1e-7 * np.random.default_rng(
        3).standard_normal(len(time)) + (time / 21.0) ** 3)
    powers = Candidate('~time', (), lambda each: [
        (each.channels.time / 21.0) ** power for power in range(1, 20)])
    fit = fit_causes(build_problem([laid(log)]), [powers])
    assert (fit.residual_squares > 0.0).all()
    units = fit.columns / np.linalg.norm(fit.columns, axis=1)[:, None]
    assert np.linalg.svd(units, compute_uv=False)[-1] ** 2 > 0.5e-9


def diagnosed_drift(noise, drift, seed):
    """Return the findings at rest, with a model of which `allan` saw no random walk."""
    time = np.arange(9000) / 10.0
    output = simulate_noise(noise, len(time), 0.1, np.random.default_rng(seed)) + drift * time
    model = GyroModel(noise=Noise(noise.angle_random_walk, 0.0, 0.0),
                      noise_bounds={'rate_random_walk': (0.0, 1e-7)})
    return established(diagnose([Log(output=output, time=time)], np.random.default_rng(0), model))


@pytest.mark.parametrize('seed', range(3))
def test_the_noise_of_the_model_shows_a_drift(seed):
    """It is 9.6 standard deviations; without the model a random walk explains it as well."""
    slope = 9.6e-4 * math.sqrt(12.0 / 900.0 ** 3)
    found = diagnosed_drift(Noise(1e-4, 0.0, 0.0), slope, [4, seed])
    assert 'rate_ramp' in found and 'rate_random_walk' not in found


def test_a_drift_that_a_random_walk_beyond_the_model_may_be_is_a_set():
    every = [diagnosed_drift(Noise(1e-4, 0.0, 3e-6), 0.0, [5, seed]) for seed in range(6)]
    slow = [each for found in every for name, each in found.items()
            if name in ('rate_ramp', 'warm_up', 'bias_step')]
    assert slow and all('rate_random_walk' in each.ambiguous_with for each in slow)
