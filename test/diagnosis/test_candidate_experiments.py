# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Experiments: the proposed one, once carried out, distinguishes what one log confounds."""

from dataclasses import replace
import re
import zlib

from gyro_calibration.diagnosis.candidate_experiments import (
    candidate_experiments,
    distinguishing,
    ENOUGH,
    observed_range,
)
from gyro_calibration.diagnosis.candidates import Candidate, effect
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.regression_problem import Named, regression_problem
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.search import alternatives, begin, searched
from gyro_calibration.logs.log import DEGREE, Log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import from_rates
from gyro_calibration.model.simulation import simulate
from hidden.log import hide, record
from hidden.motion import described
from hidden.twins import twin, TWINS
import numpy as np
import pytest

#: In multiples of the minimum detectable effect: large ones are distinguishable by their second
#: order, slow ones are lost in wander.
MULTIPLES = {('time_offset', 'bandwidth'): 30.0,
             ('bias_temperature_rate', 'thermal_hysteresis'): 2.0}


def seeded(*words):
    """Return a source of random numbers by words, the same in each run."""
    return np.random.default_rng(zlib.crc32(' '.join(words).encode()))


def laid(hidden):
    """Return a hidden log as the diagnosis looks at it."""
    columns = hidden.columns
    log = Log(output=columns['gyro_rad_s'], time=columns['time_s'],
              temperature=columns['temperature_degc'], supply=columns['supply_v'],
              reference_rate=columns['reference_rate_rad_s'],
              specific_force=columns['acceleration_mps2'])
    return replay(log, np.ones(len(log), bool), np.random.default_rng(1))


def carried_out(conditions, hidden, generator):
    """Let the generator of hidden logs record the same gyro in an experiment."""
    time = np.arange(0.0, 60.0 * conditions.minutes, hidden.session.interval)
    planned = {name: np.interp(time, conditions.time - conditions.time[0],
                               getattr(conditions, name))
               for name in ('rate', 'temperature', 'supply')}
    # What goes to and fro with each point of the plan is a vibration.
    force = conditions.specific_force
    mean = np.convolve(np.pad(force, 1, 'edge'), [0.25, 0.5, 0.25], 'valid')
    level, tilt = (np.interp(time, conditions.time - conditions.time[0], each)
                   for each in (np.abs(force - mean), mean))
    session = described(generator, time, planned['rate'], planned['temperature'], 'constant',
                        'one_pose')
    session = replace(session, supply=planned['supply'], tilt_force=tilt,
                      vibration=level * generator.choice([-1.0, 1.0], len(time)))
    return record(hidden.truth.gyro, session, generator, run=1)


def answer(replays):
    """Return what the search names, and for each name the rest of its set."""
    search = begin(replays, np.random.default_rng(2))
    named = searched(search)
    rivals = [[rival for rival, _ in alternatives(search, named, place)
               if rival.candidate.cause != known.candidate.cause]
              for place, known in enumerate(named)]
    return search, named, rivals


def names(named):
    return [each.candidate.cause for each in named]


# what is proposed for two causes that are given

#: Each cause with the shapes suggested by its twin; below, the experiments that may distinguish
#: the twins, in their order.
FIRST = {'time_offset': effect('time_offset', 0.03), 'bandwidth': effect('bandwidth', 0.03),
         'sine_response': effect('sine_response', 0.19),
         'bias_temperature': effect('bias_temperature', 25.0),
         'bias_temperature_rate': effect('bias_temperature_rate', 10.0),
         'thermal_lag': effect('thermal_lag', 18.0),
         'thermal_hysteresis': effect('thermal_hysteresis', 3.0, 5e-4),
         'supply_sensitivity': effect('supply_sensitivity', 5.0),
         'vibration_rectification': effect('vibration_rectification', 1.0),
         'reference_scale': Candidate('reference_scale', (), lambda each: (-each.channels.rate,))}
PROPOSED = dict(zip(TWINS, [
    'warm_start|triangle|long_rest|corners', 'triangle|warm_start|corners', 'long_rest',
    'turns|staircase|reversals|sweep|swings', 'staircase|times_as_fast', 'motor', 'poses',
    'times_as_fast', 'swings|reversals', 'triangle|corners', 'triangle|corners',
    'repeat|triangle|corners', 'repeat|triangle|corners', 'supply_step', 'poses', '']))


def put(name, hidden):
    """Return a cause with the shapes that it has, or that its twin speaks for."""
    session = hidden.session
    shapes = {'warm_up': (0.2 * session.time[-1],),
              'bias_step': (float(session.time[np.argmax(session.temperature)]),)}
    if name in hidden.truth.names and hidden.truth[name].shapes.get('time_constant'):
        shapes[name] = (hidden.truth[name].shapes['time_constant'],)
    return (effect(name, *shapes[name], run=0 if name == 'bias_step' else None) if name in shapes
            else FIRST.get(name) or effect(name))


@pytest.mark.parametrize('pair', TWINS, ids='-'.join)
def test_two_that_are_alike_are_parted_by_what_physics_would_have(pair):
    hidden = twin(pair, pair[0], seeded('proposed', *pair), multiple=MULTIPLES.get(pair),
                  sample_rate=20.0)
    size = hidden.truth[pair[0]].size
    # Some are found against a model only, and half a wave of temperature looks like wander: there
    # no fit determines the values.
    given = TWINS[pair].against_a_model or pair[1] == 'thermal_lag'
    alike = {'reference_scale': (-size,), 'thermal_lag': (-size / FIRST['thermal_lag'].shapes[0],)}
    known = Named(put(pair[0], hidden), (size,) if given else ())
    rival = Named(put(pair[1], hidden), alike.get(pair[1], ()))
    whole = regression_problem([laid(hidden)])
    found = distinguishing(whole, [known], known, [rival], np.random.default_rng(3))
    if not PROPOSED[pair]:
        assert found.conditions is None and found.sentence == CAUSES[pair[0]].separate_by
        return
    assert re.search(PROPOSED[pair], found.name), found.sentence
    assert found.separation >= ENOUGH > 1.5 * found.now, found.sentence
    assert (f'would part {pair[0]} from {pair[1]} by' in found.sentence
            and f'(now {found.now:.1f})' in found.sentence)


@pytest.fixture(name='log', scope='module')
def _log():
    return hide(['bias'], 1.0, seeded('menu'), sample_rate=20.0, conditions={'top_rate': 2.0})[0]


def test_experiments_keep_within_what_the_log_has_shown_or_say_that_they_go_beyond(log):
    whole = laid(log)
    seen = observed_range([whole])
    for plan in candidate_experiments(seen, [whole]):
        inside = (np.abs(plan.rate).max() <= np.abs(whole.channels.rate).max() * (1.0 + 1e-9)
                  and plan.temperature.min() >= whole.channels.temperature.min() - 1e-9
                  and plan.temperature.max() <= whole.channels.temperature.max() + 1e-9)
        assert inside or plan.beyond, plan.name
        assert not plan.beyond or re.search('log', plan.to_do), plan.to_do


def test_words_of_an_experiment_give_its_numbers(log):
    whole = laid(log)
    for plan in candidate_experiments(observed_range([whole]), [whole]):
        minutes = [int(found) for found in re.findall(r'(\d+) min\b', plan.to_do)]
        assert not minutes or abs(max(minutes) - plan.minutes) <= 1.0, plan.to_do
        rates = [float(found) for found in re.findall(r'up to ([\d.]+) deg/s', plan.to_do)]
        assert not rates or rates[-1] * DEGREE == pytest.approx(np.abs(plan.rate).max(),
                                                                rel=0.02), plan.to_do
        between = re.search(r'between (-?\d+) and (-?\d+) °C', plan.to_do)
        if between:
            assert [float(end) for end in between.groups()] == pytest.approx(
                [plan.temperature.min(), plan.temperature.max()], abs=0.05)


def test_an_experiment_can_be_simulated(log):
    whole = laid(log)
    plan = next(each for each in candidate_experiments(observed_range([whole]), [whole])
                if each.name == 'reversals')
    simulated = simulate(GyroModel(()), from_rates(plan.time, plan.rate),
                         1.0 / (plan.time[1] - plan.time[0]))
    assert simulated.output == pytest.approx(plan.rate, abs=1e-5)
    assert plan.replay(np.random.default_rng(0)).duration == pytest.approx(60.0 * plan.minutes,
                                                                           rel=0.05)


def test_a_cause_that_none_of_the_experiments_parts_is_said_to_stay():
    hidden = twin(('bias_temperature', 'supply_sensitivity'), 'bias_temperature', seeded('stays'),
                  sample_rate=20.0)
    known, rival = Named(FIRST['bias_temperature']), Named(FIRST['supply_sensitivity'])
    same = Named(Candidate('bias_temperature_quadratic', (), known.candidate.columns))
    found = distinguishing(regression_problem([laid(hidden)]), [known], known, [rival, same],
                           np.random.default_rng(3))
    assert (found.name
            and found.sentence.endswith('; bias_temperature_quadratic would stay possible'))


# the whole way: a set, the experiment that is proposed for it, and one name

#: Each experiment may leave a smaller set, with an experiment of its own.
ROUNDS = 2
#: Without pairs that show against a model only: no experiment can distinguish those.
SEARCHED = [pair for pair in TWINS if not TWINS[pair].against_a_model]
#: Generator and package define a channel differently, which shows in quick changes before the
#: twins are distinguished.
DIFFERENT = {
    ('scale_factor_asymmetry',
     'vibration_rectification'): 'the power of a vibration is a mean over a centred second in the '
                                 'one, and over the time before in the other',
    ('bias_temperature_rate', 'thermal_lag'): 'the rate of the temperature is that of the moment '
                                              'in the one, and filtered in the other',
    ('bias_step', 'thermal_hysteresis'): 'a step pays for the choice of its moment, and may be '
                                         'ruled out beside what needs none'}
#: Quick motion and vibration want a quicker log than the rest.
SAMPLED = {('time_offset', 'bandwidth'): {'sample_rate': 50.0, 'duration': 300.0},
           ('scale_factor_asymmetry', 'vibration_rectification'): {'sample_rate': 25.0}}


def marks(pair):
    """Return what to expect of a pair; two pairs stand for all, which take a minute."""
    wrong = [pytest.mark.xfail(reason=DIFFERENT[pair], strict=True)] if pair in DIFFERENT else []
    tried = {('bias_temperature', 'warm_up'), ('heading_sensitivity', 'reference_once_per_rev')}
    return wrong + ([] if pair in tried else [pytest.mark.evidence])


@pytest.mark.parametrize('pair', [
    pytest.param(pair, id='-'.join(pair), marks=marks(pair)) for pair in SEARCHED])
def test_a_set_becomes_one_name_by_the_experiment_that_is_proposed(pair):
    generator = seeded('parted', *pair)
    true = pair[int(generator.integers(2))]
    hidden = twin(pair, true, generator, multiple=MULTIPLES.get(pair),
                  **SAMPLED.get(pair, {'sample_rate': 10.0}))
    replays = [laid(hidden)]
    search, named, rivals = answer(replays)
    assert len(named) == 1 and {*names(named), *names(rivals[0])} >= set(pair)
    for _ in range(ROUNDS):
        if len(named) != 1 or not rivals[0]:
            break
        proposed = distinguishing(search.problem, named, named[0], rivals[0],
                                  np.random.default_rng(3))
        replays.append(laid(carried_out(proposed.conditions, hidden, generator)))
        search, named, rivals = answer(replays)
    assert names(named) == [true] and rivals == [[]], (true, proposed.sentence)
