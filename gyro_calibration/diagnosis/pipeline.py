# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


"""The diagnosis of time-sampled logs: its steps in order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
import math

from gyro_calibration.diagnosis.candidates import (
    along,
    constant,
    fitted_shapes,
    is_named,
    observed_range,
)
from gyro_calibration.diagnosis.causes import (
    as_suspected,
    CAUSES,
    experiment,
    finding,
    REFERENCES,
    with_remedies,
)
from gyro_calibration.diagnosis.cross_validation import gain, shares
from gyro_calibration.diagnosis.data_quality import (
    DataQuality,
    decided,
    inspect,
    limits,
    reference_of,
)
from gyro_calibration.diagnosis.expected_output import unit_of_offset
from gyro_calibration.diagnosis.extended_model import (
    calibrated,
    extended,
    implausible_scale,
    left_out,
    noted,
    with_findings,
)
from gyro_calibration.diagnosis.findings import (
    Diagnosis,
    Estimate,
    Finding,
    Gain,
    Gate,
    probabilities,
    Unexplained,
)
from gyro_calibration.diagnosis.gates import gates, mismatch, model_gate, refuse, rests
from gyro_calibration.diagnosis.noisy_reference import diagnose_by_noisy_reference
from gyro_calibration.diagnosis.regression import (
    filtered,
    fitted,
    FittedValues,
    happens_once,
    Named,
    Value,
)
from gyro_calibration.diagnosis.replay import Replay, replay
from gyro_calibration.diagnosis.residuals import (
    curves,
    heading_curve,
    NAMES,
    noise_curve,
    noise_parameters,
    NoiseParameters,
    residuals_of_model,
    what_is_left,
)
from gyro_calibration.diagnosis.search import (
    alternatives,
    begin,
    evidence_of,
    lasts,
    MOST_OF,
    MOST_SLIPS,
    polished,
    price_of_freedom,
    pruned,
    Search,
    searched,
    SURELY,
    sureness_of,
    suspected,
    without_weakest,
)
from gyro_calibration.diagnosis.steps import CHECKS, OnProgress, Steps
from gyro_calibration.diagnosis.words import amount
from gyro_calibration.logs.log import DataRefused, Log, NORMAL_95
from gyro_calibration.model.effects import CATALOGUE, QUANTIZATION
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import chi2, norm

#: Shares of the false-alarm rate: for the search for causes, for each noise figure, and for bias
#: and scale factor error each.
_OF_SEARCH, _OF_NOISE, _OF_BIAS = 0.6, 0.03, 0.05
#: Largest effect along the rate that is named, as a share of the largest rate.
_LARGEST = 0.5
#: Probability of the differences between logs below which a cause does not repeat.
_REPEATS = 1e-3
#: Variables whose causes are named only if they have the same size in all logs.
_MUST_REPEAT = frozenset({'temperature', 'temperature_rate'})
#: Probability that an effect of the minimum detectable size is found.
_POWER = 0.95
#: Names of the shape parameters of causes that are not effects of the catalogue.
_SHAPES = {'reference_slip': ('width', *(f'slip_time_{place}' for place in range(MOST_SLIPS)))}
_ONCE = 'find its cause; it occurs in this log alone, and is not added to the model'
#: Why a constant channel shows no cause, and the variable that is derived from the channel.
_HARDLY = {'temperature': 'the temperature changes by less than 0.2 K',
           'supply': 'the supply voltage does not change',
           'specific_force': 'the specific force does not change'}
_WITH = {'temperature': 'temperature_rate', 'specific_force': 'vibration'}

#: Shares of the steps in the computing time, %, measured on 25 min of an encoder at 100 Hz.
_SHARES = {CHECKS: 1, 'data quality': 1, 'replay of the model': 1, 'search for causes': 78,
           'alternatives': 11, 'noise figures': 1, 'cross-validation': 3, 'findings': 4}

#: A cause and its alternatives, each with its deficit in log-likelihood.
Members = Sequence[tuple[Named, float]]


def diagnose(logs: Sequence[Log], generator: np.random.Generator, model: GyroModel | None = None,
             rate: float = 0.01, names: Sequence[str] = (),
             on_progress: OnProgress = lambda share, words: None,
             kind: str | None = None) -> Diagnosis:
    """
    Find the causes of the difference between a simulation and logs.

    Parameters
    ----------
    logs : of one gyro, with time, and with a reference unless the gyro is at rest
    generator : source of the random residuals of noise alone, and of the noise that fills gaps
    model : of the simulation; None is an ideal gyro with the bias and scale factor error that fit
        best
    rate : false alarms per diagnosis
    names : file names of the logs, for messages
    on_progress : is called with the share of the work done and the name of the step that begins
    kind : of the reference, one of `data_quality.KINDS`; None is found from the log

    Raises
    ------
    DataRefused : a diagnosis of these logs is not possible

    """
    on_progress(0.0, CHECKS)
    given, model = model, None if model is None else calibrated(model)
    checked: list[Gate] = []
    for place, log in enumerate(logs):
        passed = gates(log, model)
        failed = mismatch(passed)
        if failed is None or failed.effect != 'wrapped_heading':
            refuse(log)
        if failed is None and model is not None:
            passed = (*passed, model_gate(log, model))
            failed = mismatch(passed)
        if failed is not None:
            own = given or GyroModel()
            return Diagnosis((failed,), (), Noise(), own.noise, None, own, own,
                             false_alarm_rate=rate, logs=tuple(names[place:place + 1]),
                             gates=passed)
        checked += passed
    references = [reference_of(log, kind) for log in logs]
    erring = [place for place, log in enumerate(logs)
              if not rests(log) and limits(log, references[place])]
    if erring and len(logs) > 1:
        where = (list(names) or [f'log {place + 1}' for place in range(len(logs))])[erring[0]]
        raise DataRefused(
            f'the errors of the reference of {where} are larger than those of the gyro, and such '
            'logs cannot be diagnosed together: diagnose each alone, or give all to `fleet`')
    if erring:
        found = diagnose_by_noisy_reference(logs[0], references[0], model, rate, on_progress)
    else:
        found = _by_exact_reference(logs, generator, model, rate, names, on_progress)
        found = replace(found, reference=references[0] if len(logs) == 1 else None)
    if given is not None and found.model is model:
        found = replace(found, before=given, model=given)  # with its self-calibration separate
    return replace(found, logs=tuple(names), gates=tuple(checked))


def _by_exact_reference(logs: Sequence[Log], generator: np.random.Generator,
                        model: GyroModel | None, rate: float, names: Sequence[str],
                        on_progress: OnProgress) -> Diagnosis:
    """Diagnose logs whose reference errs less than the gyro."""
    steps = Steps(on_progress, _SHARES)
    steps.begin('data quality')
    quality = [decided(inspect(log, model)) for log in logs]
    steps.begin('replay of the model')
    replays = [replay(log if clean.factor == 1.0 or log.output is None
                      else replace(log, output=log.output * clean.factor), clean.trusted,
                      generator, clean.update_interval, clean.heading_step, clean.step, model)
               for log, clean in zip(logs, quality)]
    steps.begin('search for causes')
    search, everything = _searched(replays, generator, _OF_SEARCH * rate, steps)
    named, unnamed = _withdrawn(search, everything)
    named, unconfirmed = without_weakest(search, named, partial(sureness_of, search), SURELY)
    named, contradicted = without_weakest(search, named, partial(_sigmas, search), NORMAL_95)
    refuted = {**{each.candidate.cause: 'it does not predict held-out stretches'
                  for each in unconfirmed if not lasts(each.candidate)},
               **{each.candidate.cause: 'the interval of its size includes 0'
                  for each in contradicted}}
    steps.begin('alternatives')
    named, sets = _simplest(search, named, unnamed)
    found = FittedValues(fitted(search.problem, named), search.problem.replays)
    out = left_out(model or GyroModel(), found)
    steps.begin('noise figures')
    # without a model, rounding of the output counts only if it is a finding
    rounds = (any(each.effect == QUANTIZATION.name for clean in quality for each in clean.findings)
              if model is None else any(term.effect is QUANTIZATION for term in model.terms))
    simulated = Noise() if model is None else model.noise
    figures = noise_parameters(found.fitted, simulated, rounds)
    noise = figures.noise
    steps.begin('cross-validation')
    changed = [] if model is None else _of_model(found, model, noise, rate)
    within = [(known, members) for known, members in zip(named, sets) if known not in out]
    lasting = any(not happens_once(known) for known, _ in within)
    won = (gain(search, {each.candidate.cause for _, members in within for each, _ in members},
                model is not None)
           if (lasting or changed) and not implausible_scale(found) else None)
    offered = won is None or not won.worse
    steps.begin('findings')
    more = suspected(search, (*named, *unnamed))
    taken = {each.candidate.cause for each in named}
    findings = [*_of_search(search, found, sets, unnamed, [
        each for each in unconfirmed
        if lasts(each.candidate) and each.candidate.cause not in taken]
        or ([more.named[-1]] if more else [])), *_of_records(quality, changed)]
    if model is not None:
        findings += _of_noise(figures, model, rate, found.replays)
    findings.sort(key=lambda each: (each.status != 'established', each.p_value))
    # without causes that the model has already and that cannot be merged with those
    inside = FittedValues(fitted(search.problem, [each for each in named if each not in out])
                          if out else found.fitted, found.replays, lasting=True)
    plain, deviation = (FittedValues(fitted(search.problem, []), found.replays),
                        _bias_deviation(inside, noise))
    before = model or noted(replace(extended(GyroModel(), plain, deviation), noise=noise),
                            GyroModel(), quality)
    after = (with_findings(model, inside, quality, findings, noise, deviation) if offered
             else before)
    # Curves before the extension contain the best bias and scale factor error, unless these differ
    # significantly from those of the model.
    left, shown = (residuals_of_model(found.replays) if changed else what_is_left(plain),
                   inside if offered else plain)
    of_heading = shares([found.heading_changes(run, plain if model is None else None)
                         for run in range(len(replays))],
                        float(np.mean([each.rounded ** 2 for each in replays])) / 6.0)
    return Diagnosis(
        tuple(with_remedies(findings, of_heading, after)),
        tuple(unexplained(search, found, unnamed)), noise, simulated, won, before, after,
        _cannot_show(search, logs), curves(left, shown), heading_curve(left, shown),
        noise_curve(found, noise, simulated),
        tuple(_remarks(quality, names, found, unnamed, refuted, out, won, model)), rate,
        heading_shares=of_heading)


def _of_search(search: Search, found: FittedValues, sets: Sequence[Members],
               unnamed: Sequence[Named], doubtful: Sequence[Named]) -> Iterator[Finding]:
    """Give the named causes, and the doubtful ones as suspected, each given all named causes."""
    for place, (known, members) in enumerate(zip(found.named, sets)):
        others = [(each.candidate.cause, lack) for each, lack in members
                  if each.candidate.cause != known.candidate.cause]
        yield named_finding(
            search, found, place, _chance(search, (*found.named, *unnamed), place), members,
            experiment(known.candidate.cause, others, observed_range(found.replays)))
    for known in doubtful:
        everything = polished(search, (*found.named, *unnamed, known))
        with_it = FittedValues(fitted(search.problem, everything), found.replays)
        place = len(everything) - 1
        yield as_suspected(named_finding(
            search, with_it, place, _chance(search, everything, place), [(everything[-1], 0.0)],
            ''))


def _of_records(quality: Sequence[DataQuality], changed: Sequence[Finding]) -> list[Finding]:
    """Return the record findings with the smallest p-value of all logs, and changed values."""
    best: dict[str, Finding] = {}
    for each in (each for clean in quality for each in clean.findings):
        if each.effect not in best or each.p_value < best[each.effect].p_value:
            best[each.effect] = each
    covered = {name for each in best.values() for name in each.ambiguous_with}
    return [*best.values(), *(each for each in changed if each.effect not in covered)]


def _chance(search: Search, named: Sequence[Named], place: int) -> float:
    """Return the p-value of a named cause, given the others."""
    return search.chance.p_value(named[place].candidate.cause, evidence_of(search, named, place))


def _searched(replays: Sequence[Replay], generator: np.random.Generator, rate: float,
              steps: Steps) -> tuple[Search, tuple[Named, ...]]:
    """Search for causes, and repeat it with levels for the noise if the residual is filtered."""
    search = begin(replays, generator, rate, steps.within)
    everything = searched(search)
    as_filtered = filtered(fitted(search.problem, everything))
    if as_filtered is search.problem.replays:
        return search, everything
    search = begin(as_filtered, generator, rate, steps.within)
    return search, searched(search)


def _withdrawn(search: Search,
               everything: tuple[Named, ...]) -> tuple[tuple[Named, ...], tuple[Named, ...]]:
    """
    Separate named causes from structure without a name.

    A name is withdrawn if structure without a name lies along the same variable, if there are many
    tones, or if a cause along a temperature differs between logs.

    """
    beyond = {name for each in everything if not is_named(each.candidate)
              for name in along(each.candidate).split(' and ')}
    tones = [each.candidate.run for each in everything
             if each.candidate.cause == 'interference_tone']
    if any(tones.count(run) >= MOST_OF['interference_tone'] for run in tones):
        beyond.add('frequency')
    kept = tuple(each for each in everything if is_named(each.candidate)
                 and CAUSES[each.candidate.cause].along not in beyond)
    fastest = max(float(np.abs(each.channels.rate).max()) for each in search.problem.replays)

    def is_small(known: Named) -> bool:
        """Tell whether an effect along the rate is small compared with the rate."""
        return (CAUSES[known.candidate.cause].along != 'rate'
                or known.candidate.amplitude is not None
                or all(np.abs(np.tensordot(known.values, np.array(known.candidate.columns(each)),
                                           1)).max() < _LARGEST * fastest
                       for each in search.problem.replays))

    kept = tuple(each for each in kept if _repeats(search, everything, each) and is_small(each))
    unnamed = tuple(each for each in everything if each not in kept)
    if not unnamed:
        return kept, ()
    rest = tuple(each for each in unnamed if not is_named(each.candidate)
                 or CAUSES[each.candidate.cause].along not in
                 {along(other.candidate) for other in unnamed if not is_named(other.candidate)})
    left = pruned(search, polished(search, (*kept, *rest)))
    return tuple(each for each in left if any(
        each.candidate.cause == one.candidate.cause and each.candidate.run == one.candidate.run
        for one in kept)), rest


def _sigmas(search: Search, named: tuple[Named, ...]) -> list[float]:
    """Return the distance of the size of each cause from 0 in standard deviations."""
    found, sigmas = FittedValues(fitted(search.problem, named), search.problem.replays), []
    for place, known in enumerate(named):
        sizes = found.coefficients(place) or list(found.shapes(place).values())
        # sine or cosine alone may be 0 for a wave that is not
        wave = len(sizes) == 2 and known.candidate.cause != 'reference_slip'
        sigmas.append(math.inf if wave or not sizes or not sizes[0].deviation
                      else abs(sizes[0].value) / sizes[0].deviation)
    return sigmas


def _repeats(search: Search, everything: tuple[Named, ...], known: Named) -> bool:
    """Tell whether a cause along a temperature has the same size in all logs within the noise."""
    candidate, runs = known.candidate, len(search.problem.replays)
    if (runs == 1 or CAUSES[candidate.cause].along not in _MUST_REPEAT or not known.values
            or candidate.amplitude is not None):
        return True
    alone = [replace(candidate, run=run) for run in range(runs - 1)]
    more = 2.0 * (fitted(search.problem, everything, alone).score
                  - fitted(search.problem, everything).score)
    return bool(chi2.sf(max(more, 0.0), len(known.values) * len(alone)) > _REPEATS)


def _simplest(search: Search, named: tuple[Named, ...],
              unnamed: tuple[Named, ...]) -> tuple[tuple[Named, ...], list[Members]]:
    """Replace each cause by its simplest alternative, and return the alternatives of each."""
    def size(known: Named) -> int:
        """Return the number of fitted values of a cause."""
        candidate = known.candidate
        return len(fitted_shapes(candidate)) + (
            0 if candidate.amplitude is not None
            else len(candidate.columns(search.problem.replays[0])))

    sets: list[Members] = []
    for place in range(len(named)):
        members = (alternatives(search, (*named, *unnamed), place) or [(named[place], 0.0)])
        sizes = [size(each) for each, _ in members]
        if min(sizes) < size(named[place]):
            chosen = members[int(np.argmin(sizes))][0]
            named = polished(search, (*named[:place], chosen, *named[place + 1:]))
        sets.append(members)
    return named, sets


def _bias_deviation(found: FittedValues, noise: Noise) -> float:
    """Return the standard deviation of the mean bias of the logs, rad/s."""
    each = [noise.heading_variance(replay.duration) / replay.duration ** 2
            for replay in found.replays]
    return float(np.sqrt(np.mean(each) / len(each) + found.bias_variance))


def _of_model(found: FittedValues, model: GyroModel, noise: Noise, rate: float) -> list[Finding]:
    """Return bias and scale factor error as findings if they differ from those of the model."""
    scale, bias = found.scale_factor_error, float(np.mean(found.biases))
    own = [_own_deviation(model, name) for name in ('bias', 'scale_factor_error')]
    # A bias within the bias instability and random walk of the model is not a finding.
    likely = Noise(noise.angle_random_walk,
                   *(max(getattr(each, name) for each in (noise, model.noise))
                     for name in NAMES[1:]))
    deviations = np.hypot([_bias_deviation(found, likely), scale.deviation], own)
    different = []
    for name, value, deviation, confounders in (
            ('bias', bias, float(deviations[0]), ()),
            ('scale_factor_error', scale.value, float(deviations[1]), ('reference_scale',))):
        chance = float(2.0 * norm.sf(abs(value) / deviation)) if deviation > 0.0 else 1.0
        if chance < _OF_BIAS * rate:
            different.append(finding(
                name, {name: Estimate.about(value, NORMAL_95 * deviation, CAUSES[name].unit)},
                chance, confounders, minimum_detectable=5.4 * deviation,
                evidence='it adds to the value of the model, '
                f'{abs(value) / deviation:.3g} sigma from zero'))
    return different


def _own_deviation(model: GyroModel, name: str) -> float:
    """Return the standard deviation that a model states for one of its values, or 0."""
    if model.covariance is None:
        return 0.0
    owners = [term.effect.name for term in model.terms for _ in term.fitted]
    return (float(np.sqrt(model.covariance[owners.index(name), owners.index(name)]))
            if name in owners else 0.0)


def _of_noise(figures: NoiseParameters, model: GyroModel, rate: float,
              replays: Sequence[Replay]) -> list[Finding]:
    """Return the noise figures that differ from those of the model and lie outside its bounds."""
    found, expected = [], model.noise
    # The steps of an encoder hide white noise.
    for name in NAMES[1:] if any(each.rounded for each in replays) else NAMES:
        if figures.chance.get(name, 1.0) < _OF_NOISE * rate:
            low, high = model.noise_bounds.get(name, (math.inf, -math.inf))
            if figures.interval[name][0] <= high and low <= figures.interval[name][1]:
                continue
            unit, value = CAUSES[name].unit, getattr(figures.noise, name)
            found.append(finding(
                name, {name: Estimate(value, figures.interval[name], unit)}, figures.chance[name],
                evidence=f'the model states {amount(getattr(expected, name), unit, name)}, '
                f'the log {amount(value, unit, name)}'))
    return found


def _cannot_show(search: Search, logs: Sequence[Log]) -> dict[str, str]:
    """Return the reason for each cause that these logs cannot show."""
    replays = search.problem.replays
    has = frozenset.intersection(*(each.has for each in replays)) | {'time', 'output'}
    of_motion = frozenset({'reference', *REFERENCES})
    has |= (of_motion if any(getattr(log, name) is not None for log in logs for name in REFERENCES)
            else frozenset())
    moves = any(np.any(each.reference[each.kept] != 0.0) for each in replays)
    reasons = {}
    for name, cause in CAUSES.items():
        missing = sorted(cause.needs - has)
        if missing:
            reasons[name] = f'the logs have no {" and no ".join(missing)}'.replace('_', ' ')
        elif not moves and cause.needs & of_motion:
            reasons[name] = 'the reference shows no motion'
    quiet = {name: _HARDLY[name] for name in constant(replays)}
    quiet |= {other: quiet[name] for name, other in _WITH.items() if name in quiet}
    for name, reason in quiet.items():
        reasons.update({cause.name: reason for cause in CAUSES.values()
                        if cause.along == name and cause.name not in reasons})
    alike = 'in these logs it cannot be distinguished from a bias or a scale factor error'
    hidden = sorted(search.unidentifiable & (CAUSES.keys() - reasons.keys()))
    reasons.update(dict.fromkeys(hidden, alike))
    return reasons


def _remarks(quality: Sequence[DataQuality], names: Sequence[str], found: FittedValues,
             unnamed: Sequence[Named], refuted: Mapping[str, str], out: Sequence[Named],
             won: Gain | None, model: GyroModel | None) -> Iterator[str]:
    """Give remarks on the records, on withdrawn names, and on the model."""
    for place, clean in enumerate(quality):
        where = f'{names[place]}: ' if len(quality) > 1 and names else ''
        yield from (where + remark for remark in clean.remarks)
    for name in dict.fromkeys(each.candidate.cause for each in unnamed
                              if is_named(each.candidate)):
        why = ('there are tones at many frequencies' if name == 'interference_tone'
               else 'it differs between logs, or other structure lies along the same variable')
        yield f'What looks like {name.replace("_", " ")} is not named: {why}.'
    for name, why in refuted.items():
        yield f'What looks like {name.replace("_", " ")} is not named: {why}.'
    scale, own = (found.scale_factor_error,
                  {term.effect.name for term in ([] if model is None else model.terms)})
    if implausible_scale(found):
        yield (f'A scale factor error of {100.0 * scale.value:.2g} +- '
               f'{100.0 * scale.deviation:.1g} % is not added to the model: the motion is too '
               'small for the noise of gyro and reference; turn faster, in both directions.')
    for name in dict.fromkeys(each.candidate.cause for each in out):
        remedy = ('; remove that one from the given model, and diagnose again' if name in own
                  else '')
        yield (f'A second {name.replace("_", " ")} is not added to the extended model, as it '
               f'cannot be merged with the first one{remedy}.')
    for name in dict.fromkeys(each.candidate.cause for each in found.named if happens_once(each)):
        yield (f'The {name.replace("_", " ")} occurs once: it is not in the extended model, '
               'whose bias is the mean over the logs.')
    if won is not None and won.worse:
        yield ('On the held-out parts, the errors of the extended model are larger than those of '
               'the model before; it is not offered.')


# findings

def named_finding(search: Search, found: FittedValues, place: int, p_value: float,
                  members: Members, separate_by: str) -> Finding:
    """Return the finding of a named cause with its alternatives."""
    known = found.named[place]
    candidate, name = known.candidate, known.candidate.cause
    parameters = _parameters(found, place)
    probability = probabilities({name: 0.0, **{
        each.candidate.cause: lack for each, lack in reversed(members)}})
    confounders = [each.candidate.cause for each, _ in members if each.candidate.cause != name]
    size = next(iter(parameters.values()))
    deviation = size.deviation
    if name == 'time_offset' and unit_of_offset(size.estimate, deviation,
                                                found.replays[0].interval):
        confounders.append('unit_error')
    # the evidence of a size of n standard deviations is n² / 2
    needed = search.chance.threshold(name, search.rate) + price_of_freedom(known)
    smallest = math.sqrt(2.0 * max(needed, 0.0)) + float(norm.isf(1.0 - _POWER))
    log = ('' if candidate.run is None or len(found.replays) == 1
           else f'in log {candidate.run + 1}, ')
    where = None
    if name == 'bias_step':
        where = candidate.shapes[0], float(found.replays[candidate.run or 0].channels.time[-1])
    elif name == 'reference_slip':
        where = min(candidate.shapes[1:]), max(candidate.shapes[1:])
    return finding(
        name, parameters, p_value, tuple(dict.fromkeys(confounders)),
        minimum_detectable=smallest * deviation if deviation > 0.0 else None,
        separate_by=separate_by or (CAUSES[name].separate_by if confounders else ''),
        evidence=(f'{log}{abs(size.estimate) / deviation:.3g} sigma from zero' if deviation > 0.0
                  else ''), probability=probability, where=where,
        remedy=_ONCE if happens_once(known) else '')


def _parameters(found: FittedValues, place: int) -> dict[str, Estimate]:
    """Return the parameters of a cause, first the one with the name of the cause."""
    candidate = found.named[place].candidate
    coefficients, shapes = found.coefficients(place), found.shapes(place)
    name, effect = candidate.cause, CATALOGUE.get(candidate.cause)
    names = (_SHAPES.get(name, ()) if effect is None
             else tuple(parameter.name for parameter in effect.shapes + effect.coefficients))
    unit = (effect.coefficients[0].unit if effect is not None and effect.coefficients
            else CAUSES[name].units.get(name, '1'))
    parameters = {}
    own = () if effect is None else effect.coefficients
    if len(own) > 1 and [each.name for each in own] != ['sine', 'cosine']:
        parameters = {each.name: _estimate(value, each.unit)
                      for each, value in zip(own, coefficients)}
    elif len(coefficients) == 2 and name != 'reference_slip':
        parameters = _as_phase(found, place, name, coefficients, unit)
    elif coefficients:
        parameters = {name: _estimate(coefficients[0], unit)}
    for number, value in shapes.items():
        parameters[names[number] if parameters else name] = _estimate(
            value, 's' if effect is None else effect.parameters[number].unit)
    if name == 'reference_slip':
        parameters.update({names[1 + number]: Estimate(at, (at, at), 's')
                           for number, at in enumerate(candidate.shapes[1:])})
    return parameters


def _estimate(value: Value, unit: str) -> Estimate:
    return Estimate.about(value.value, NORMAL_95 * value.deviation, unit)


def _as_phase(found: FittedValues, place: int, name: str, coefficients: Sequence[Value],
              unit: str) -> dict[str, Estimate]:
    """Return amplitude and phase of ``sine sin + cosine cos``, with intervals by covariance."""
    sine, cosine = (value.value for value in coefficients)
    amplitude, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
    ranks = [rank for rank in (found.place(place, number) for number in range(2))
             if rank is not None]
    covariance = found.covariance[np.ix_(ranks, ranks)]
    turn = np.array([[np.cos(phase), np.sin(phase)], [-np.sin(phase), np.cos(phase)]])
    deviation = np.sqrt(np.diag(turn @ covariance @ turn.T))
    return {name: _estimate(Value(amplitude, float(deviation[0])), unit),
            'phase': _estimate(Value(phase, float(deviation[1]) / amplitude), 'rad')}


def unexplained(search: Search, found: FittedValues,
                unnamed: Sequence[Named]) -> list[Unexplained]:
    """Return the structures without a name with the share of the residual that each explains."""
    everything = (*found.named, *unnamed)
    variables: dict[str, list[int]] = {}
    for place, known in enumerate(unnamed):
        name = (CAUSES[known.candidate.cause].along if is_named(known.candidate)
                else along(known.candidate))
        variables.setdefault(name, []).append(len(found.named) + place)
    least, most = _variance(search, found, everything), _variance(search, found, found.named)
    structures = []
    for name, places in variables.items():
        without = _variance(search, found, [known for place, known in enumerate(everything)
                                            if place not in places])
        chance = min(search.chance.p_value(everything[place].candidate.cause,
                                           evidence_of(search, everything, place))
                     for place in places)
        structures.append(Unexplained(name, max(without - least, 0.0) / most, chance))
    return structures


def _variance(search: Search, found: FittedValues, named: Sequence[Named]) -> float:
    """Return the variance of the residual of some causes at the grid points."""
    left = FittedValues(fitted(search.problem, named), found.replays)
    return float(np.var(np.concatenate([each.on_grid(rest - bias) for each, rest, bias
                                        in zip(found.replays, left.residuals, left.biases)])))
