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
The model extended by the findings, and its gain on parts of the logs that are held out.

The model gets effects, limits, values, covariance, noise and origin. The held-out parts take no
part in the selection and fit of the causes that predict them.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from gyro_calibration.calibration.self_calibration import RunLimits
from gyro_calibration.diagnosis.candidates import Candidate
from gyro_calibration.diagnosis.causes import add_remedies, NOISE_NAMES
from gyro_calibration.diagnosis.data_quality import DataQuality
from gyro_calibration.diagnosis.findings import (
    Change, Curve, Diagnosis, Finding, Gain, NOT_OFFERED)
from gyro_calibration.diagnosis.regression import fit_causes, is_single_event, RegressionFit
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.search import restrict_search, Search, search_causes
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, CATALOGUE, Effect, SCALE_FACTOR_ERROR)
from gyro_calibration.model.gyro_model import GyroModel, have_same_effects, Term
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.linalg import block_diag
from scipy.stats import t as student

#: Effects with a reference value -> the effect that compensates a change of that value.
_COMPENSATING_EFFECTS: Mapping[str, Effect] = {
    'bias_temperature': BIAS, 'supply_sensitivity': BIAS,
    'scale_factor_temperature': SCALE_FACTOR_ERROR, 'bias_temperature_quadratic': BIAS_TEMPERATURE}
#: Window over which heading errors are counted, s.
HEADING_WINDOW = 60.0
#: Longest window as a share of a held-out part.
MAX_WINDOW_SHARE = 0.75


def extend_model(model: GyroModel | None, fit: RegressionFit, quality: Sequence[DataQuality],
                 findings: Sequence[Finding], noise: Noise, bias_deviation: float) -> GyroModel:
    """
    Return the extended model; the given one if no finding concerns the gyro.

    The fit contains the causes that can be merged with the given model, None for an ideal gyro. Of
    its noise, only the figures with a finding are replaced. The bias has a deviation, rad/s.
    """
    given = model or GyroModel()
    names = {name for each in findings for name in (each.effect, *each.ambiguous_with)}
    fitted = (model is None or names & {BIAS.name, SCALE_FACTOR_ERROR.name}
              or any(each.cause in CATALOGUE and fit.is_included(place)
                     for place, each in enumerate(fit.causes)))
    new = add_causes(given, fit, bias_deviation) if fitted else given
    # limit and quantization of the output, if they are findings, from the first log; exact
    output_terms: dict[str, Term] = {}
    for clean in quality:
        sizes = {'saturation': clean.limit, 'quantization': clean.output_step}
        for name in (each.effect for each in clean.findings if sizes.get(each.effect)):
            output_terms.setdefault(name, Term(CATALOGUE[name], (float(sizes[name] or 0.0),)))
    terms = [term for term in output_terms.values() if _is_within_bounds(term)]
    if terms:
        term_covariance = np.zeros((len(terms), len(terms)))
        new = replace(new, terms=_merge_terms(new.terms, terms),
                      covariance=_extended_covariance(new, terms, term_covariance))
    figures = replace(given.noise, **{each.effect: each.parameters[each.effect].estimate
                                      for each in findings if each.effect in NOISE_NAMES})
    if model is not None and have_same_effects(new, model) and figures == model.noise:
        return model
    figures = figures if given.noise.angle_random_walk else noise
    bounds = {name: ends for name, ends in given.noise_bounds.items()
              if getattr(figures, name) == getattr(given.noise, name)}
    return replace(new, noise=figures, noise_bounds=bounds, origin=previous_origins(given))


def add_causes(model: GyroModel, fit: RegressionFit, bias_deviation: float) -> GyroModel:
    """Return a model with all named effects of the gyro, and with corrected bias and scale."""
    implausible = is_scale_implausible(fit)
    scale = 0.0 if implausible else fit.scale_factor_error.value
    # the mean bias of the logs given that scale factor error
    rates = [each.channels.rate[each.valid].mean() for each in fit.distorted]
    bias = np.mean(fit.biases) + (fit.scale_factor_error.value - scale) * np.mean(rates)
    terms = [Term(BIAS, (float(bias),)), Term(SCALE_FACTOR_ERROR, (scale,))]
    # of each value its index among the estimates, after the bias; None for an exact one
    of_scale = fit.estimate_index(-1, 0)
    ranks: list[int | None] = [None if implausible else of_scale]
    for place, known in enumerate(fit.causes):
        if known.cause in CATALOGUE and fit.is_included(place):
            terms.append(_term_of_cause(fit, place))
            shapes = len(known.shapes)
            ranks += [
                fit.estimate_index(place, -1 - number if number < shapes else number - shapes)
                for number in range(len(terms[-1].values))]
    moves, replays = of_scale is not None and not implausible, fit.problem.replays
    return add_terms(model, terms, [0, *(-1 if rank is None else 1 + rank for rank in ranks)],
                     block_diag(bias_deviation ** 2, fit.covariance),
                     [each.channels.output[each.valid] + each.simulated_error[each.valid]
                      for each in replays if moves],
                     [each.channels.temperature[each.valid]
                      for each in replays if 'temperature' in each.available_channels])


def add_terms(model: GyroModel, new: Sequence[Term], places: Sequence[int], covariance: Array,
              outputs: Sequence[Array], temperatures: Sequence[Array]) -> GyroModel:
    """
    Return a model with more terms and their covariance, and ranges that include the logs.

    Given are the place of each value of the terms in a covariance, -1 for an exact one; and the
    outputs, rad/s, and temperatures, degC, of logs.
    """
    has_ranges = bool(model.terms)
    return replace(
        model, terms=_merge_terms(model.terms, new), covariance=_extended_covariance(
            model, new, np.pad(covariance, (0, 1))[np.ix_(places, places)]),
        rate_range=widen_range(model.rate_range, outputs, has_ranges),
        temperature_range=widen_range(model.temperature_range, temperatures, has_ranges))


def complete_diagnosis(found: Diagnosis) -> Diagnosis:
    """Return a diagnosis with its findings in order, each with a remedy, and the model's notes."""
    findings = add_remedies(
        sorted(found.findings, key=lambda each: (each.status != 'established', each.p_value)),
        found.heading_shares, found.model)
    new = {term.effect.name for term in found.model.terms if term not in found.before.terms}
    sets = [f'{each.effect} is used; it may be {" or ".join(each.ambiguous_with)} instead'
            for each in findings if each.ambiguous_with and each.effect in new]
    model = (replace(found.model, origin={'ambiguous': sets, **found.model.origin}) if sets
             else found.model)
    is_worse = found.gain is not None and found.gain.is_worse
    return replace(found, findings=tuple(findings), model=model,
                   remarks=(*found.remarks, *[NOT_OFFERED] * is_worse))


def previous_origins(model: GyroModel) -> dict[str, object]:
    """Return the origins of a model as a list, because its file has a limited nesting depth."""
    earlier = model.origin.get('before', [])
    own = {name: value for name, value in model.origin.items() if name != 'before'}
    return {'before': [own, *(earlier if isinstance(earlier, list) else [earlier])]} if own else {}


def merge_self_calibration(model: GyroModel) -> GyroModel:
    """Return a model with its self-calibration merged into its terms, to first order."""
    known = model.self_calibration
    if known is None:
        return model
    slope = 1.0 + sum(term.values[0] for term in model.terms if term.effect is SCALE_FACTOR_ERROR)
    new = [Term(SCALE_FACTOR_ERROR, (slope * known.scale_factor_error,)),
           Term(BIAS, (slope * known.bias,))]
    covariance = (None if known.covariance is None
                  else _extended_covariance(model, new, slope ** 2 * np.array(known.covariance)))
    return replace(model, terms=_merge_terms(model.terms, new), covariance=covariance,
                   self_calibration=None)


def unmergeable_causes(model: GyroModel, fit: RegressionFit) -> tuple[Candidate, ...]:
    """Return the lasting causes of the gyro that cannot be merged with terms of its model."""
    terms, unmergeable = model.terms, []
    for place, known in enumerate(fit.causes):
        if known.cause in CATALOGUE and not is_single_event(known):
            more = _merge_term(terms, _term_of_cause(fit, place))
            unmergeable += [known] if more is None else []
            terms = more or terms
    return tuple(unmergeable)


def is_scale_implausible(fit: RegressionFit) -> bool:
    """
    Tell whether the fitted scale factor error is implausible.

    If the gyro hardly turns, noise of the reference passes for motion that the gyro does not
    measure.
    """
    scale, limits = fit.scale_factor_error, RunLimits()
    return (scale.value < -limits.max_scale_factor_error
            or scale.deviation > limits.max_scale_deviation)


# values

def _term_of_cause(fit: RegressionFit, cause_index: int) -> Term:
    candidate = fit.causes[cause_index]
    effect = CATALOGUE[candidate.cause]
    coefficients = (fit.coefficients(cause_index)[0].tolist()
                    or [candidate.amplitude or 0.0][:len(effect.coefficients)])
    return Term(effect, (*candidate.shapes, *coefficients))


# terms among others

def _merge_terms(terms: tuple[Term, ...], new: Sequence[Term]) -> tuple[Term, ...]:
    for each in new:
        terms = _merge_term(terms, each) or terms
    return terms


def _merge_term(terms: tuple[Term, ...], new: Term) -> tuple[Term, ...] | None:
    """Return terms with one more, merged with that of its effect; None if not possible."""
    effect, values, others = new.effect, new.values, []
    old = next((term for term in terms if term.effect.name == effect.name), None)
    if old is None:
        return (*terms, new)
    if effect.name in _COMPENSATING_EFFECTS and values[0] != old.values[0]:
        # with the reference value of the old term, and terms that compensate this
        begin, value, other = old.values[0], values[1], _COMPENSATING_EFFECTS[effect.name]
        offset, values = begin - values[0], (begin, value)
        others = ([Term(other, (begin, 2.0 * offset * value)), Term(BIAS, (offset ** 2 * value,))]
                  if effect is BIAS_TEMPERATURE_QUADRATIC else [Term(other, (offset * value,))])
    one = new  # Logs are compared without limits and quantization of the model.
    if effect.stage != 'output':
        # Delays add up, and so do clock rate errors, to first order.
        first = 0 if effect.correct_stamps is not None else len(effect.nonlinear_parameters)
        one = Term(effect, (*values[:first], *(
            a + b for a, b in zip(old.values[first:], values[first:]))))
        if values[:first] != old.values[:first] or (first and not effect.coefficients) or any(
                each.default is not None
                for each in effect.coefficients) or not _is_within_bounds(one):
            return None
    return _merge_terms(tuple(one if term is old else term for term in terms), others)


def _is_within_bounds(term: Term) -> bool:
    return all(parameter.bounds[0] <= value <= parameter.bounds[1]
               for parameter, value in zip(term.effect.parameters, term.values))


# covariance

def _extended_covariance(model: GyroModel, new: Sequence[Term],
                         term_covariance: Array) -> Array | None:
    """
    Return the covariance of all fitted values of a model with new terms; None if unknown before.

    New values, with a covariance of their own, are independent of those of the model.
    """
    if model.terms and model.covariance is None:
        return None

    def fitted_values(terms: Sequence[Term]) -> Array:
        return np.array([term.values[place] for term in _merge_terms(model.terms, terms)
                         for place in term.fitted_indices])

    values, deviations = fitted_values(new), np.sqrt(np.diag(term_covariance)).tolist()
    slopes = np.zeros((len(values), len(deviations)))
    owners = [(number, place) for number, term in enumerate(new)
              for place in range(len(term.values))]
    for column, (step, (number, place)) in enumerate(zip(deviations, owners)):
        if step:
            own = list(new[number].values)
            own[place] += step
            moved = [*new[:number], replace(new[number], values=tuple(own)), *new[number + 1:]]
            slopes[:, column] = (fitted_values(moved) - values) / step
    covariance = slopes @ term_covariance @ slopes.T
    if model.covariance is not None:
        covariance[:len(model.covariance), :len(model.covariance)] += model.covariance
    return covariance


def widen_range(known: tuple[float, float], parts: Sequence[Array],
                is_existing: bool) -> tuple[float, float]:
    """Return a range that includes the logs; only theirs if the model had none before."""
    if not parts:
        return known
    low, high = min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)
    return (min(known[0], low), max(known[1], high)) if is_existing else (low, high)


# the gain on held-out parts

def measure_gain(search: Search, causes: Collection[str], has_model: bool) -> Gain | None:
    """
    Hold out every third block, select and fit causes without them, and predict them.

    The error before is that of the model, or of the best bias and scale factor without one. None
    if the logs are too short, or too few of their samples are used.
    """
    replays = search.problem.replays
    length = min(HEADING_WINDOW, max(each.duration for each in replays) / 6.0)
    blocks = []
    for each in replays:  # the number of the held-out block of each sample, -1 without one
        since = (each.channels.time - each.channels.time[0]) / length
        number = since.astype(int)
        held_out = each.valid & (number % 3 == 1) & (number < int(since[-1] + 1e-9))
        blocks.append(np.where(held_out, number, -1))
    if (not any((block >= 0).any() for block in blocks)
            or any(np.count_nonzero(each.valid & (block < 0)) < 20
                   for each, block in zip(replays, blocks))):
        return None
    reduced_search = restrict_search(
        search, [drop_samples(each, block >= 0) for each, block in zip(replays, blocks)], causes)
    named = search_causes(reduced_search)
    straight, plain, extended = (
        replace(fit_causes(reduced_search.problem, some), lasting_only=True)
        for some in ((), [each for each in named if each.cause == 'time_offset'], named))
    models = {'given': None, 'straight': straight, 'plain': plain, 'extended': extended}
    parts = []
    for run, (each, block) in enumerate(zip(replays, blocks)):
        added = {name: 0.0 if found is None else
                 found.total_contribution(each, run) + found.biases[run]
                 for name, found in models.items()}
        # against the smooth and the measured reference
        left = {name: (each.channels.output - each.channels.rate - some,
                       each.channels.output - each.reference - some)
                for name, some in added.items()}
        for part in (block == place for place in np.unique(block[block >= 0])):
            duration = np.ptp(each.channels.time[part])
            parts.append({name: (of_rate[part], duration * increments[part].mean(keepdims=True))
                          for name, (of_rate, increments) in left.items()})
    which = 'the log' if len(replays) == 1 else 'each log'
    return gain_from_errors(f'every third {length:.3g} s of {which}, {len(parts)} parts', parts,
                            'given' if has_model else 'straight', length)


def gain_from_errors(held_out: str, parts: Sequence[Mapping[str, tuple[Array, Array]]],
                     before: str, window: float) -> Gain:
    """
    Return the gain on held-out parts.

    Parameters
    ----------
    held_out : description of the parts
    parts : of each, model -> errors of the rate, rad/s, and of the heading, rad, shape (n,) each
    before : the model that the extended one is compared with
    window : over which the heading changes, s

    """
    counts = np.array([[float(len(each)) for each in part[before]] for part in parts])
    squares = {name: np.array([[each @ each for each in part[name]] for part in parts])
               for name in parts[0]}
    rate, heading = (jackknife_change(np.column_stack(
        [squares[name][:, k] for name in (before, 'extended')]), counts[:, k]) for k in (0, 1))
    return Gain(held_out, rate, heading, window,
                {name: float(np.sqrt(each[:, 1].sum() / counts[:, 1].sum()))
                 for name, each in squares.items() if name != 'straight'})


def drop_samples(replay: Replay, dropped: Mask) -> Replay:
    """Return a log with fewer samples that are used."""
    left = (replay.valid & ~dropped)[replay.valid]
    place = replay.grid_index[left]
    return replace(replay, valid=replay.valid & ~dropped, grid_index=place - place[0],
                   fill_noise=replay.fill_noise[place[0]:place[-1] + 1])


def window_changes(changes: Array, time: Array, window: float) -> Array:
    """Return changes over windows, (m,), from changes, (n,), between times, (n + 1,)."""
    whole = np.concatenate([[0.0], np.cumsum(changes)])
    later = np.searchsorted(time, time + window - 0.5 * float(np.median(np.diff(time))))
    inside = np.flatnonzero(later < len(time))
    return np.asarray(whole[later[inside]] - whole[inside])


def heading_contributions(fit: RegressionFit, log_index: int,
                          plain_fit: RegressionFit | None) -> tuple[dict[str, Array], Array]:
    """
    Return the contributions to the change of heading of a log, rad, and its times, s.

    The fit of the bias and scale factor of the simulation is subtracted, if these were fitted.
    """
    each = fit.problem.replays[log_index]
    parts = {**fit.contributions(each, log_index),
             'bias': np.full(len(each.valid), fit.biases[log_index]),
             'left': fit.unbiased_residuals[log_index]}
    if plain_fit is not None:
        parts['scale_factor_error'] -= plain_fit.total_contribution(each, log_index)
        parts['bias'] -= plain_fit.biases[log_index]
    return ({name: each.resample(part) * each.point_interval for name, part in parts.items()},
            np.arange(each.point_count + 1) * each.point_interval)


def heading_error_shares(logs: Sequence[tuple[Mapping[str, Array], Array]],
                         reference_square: float = 0.0) -> dict[str, float]:
    """
    Return the share of each cause in the mean square of the heading error over a minute.

    The part of a cause that is proportional to a bias or a scale factor error is counted as these,
    because their refit would absorb it. A log has the contributions of causes and of what is
    'left' to the change of heading, rad, shape (n,), between times, s, shape (n + 1,).
    """
    window_errors: dict[str, list[Array]] = {name: [] for parts, _ in logs for name in parts}
    for parts, time in logs:
        window = min(HEADING_WINDOW, MAX_WINDOW_SHARE * float(time[-1] - time[0]))
        # a cause may be in one of the logs
        turned = {name: window_changes(parts.get(name, 0.0 * parts['left']), time, window)
                  for name in window_errors}
        plain = np.column_stack([np.ones(len(turned['left'])), turned['scale_factor_error']])
        for name in window_errors.keys() - {'bias', 'scale_factor_error', 'left'}:
            plain_part = plain * np.linalg.lstsq(plain, turned[name], rcond=None)[0]
            turned[name] -= plain_part.sum(axis=1)
            turned['bias'] += plain_part[:, 0]
            turned['scale_factor_error'] += plain_part[:, 1]
        for name, each in turned.items():
            window_errors[name].append(each)
    found = {name: np.concatenate(each) for name, each in window_errors.items()}
    total = sum(found.values(), np.zeros(len(found['left'])))
    square = float(np.mean(total ** 2)) if len(total) else 0.0
    if not square > 0.0:
        return {}
    part_of = {name: float(np.mean(part * total)) / square for name, part in found.items()}
    left, response = part_of.pop('left'), part_of.pop('reference', 0.0)
    return {**part_of, 'reference': response + min(reference_square / square, max(left, 0.0)),
            'left': max(left - reference_square / square, 0.0)}


def heading_curve(parts: Mapping[str, Array], time: Array) -> Curve:
    """Return the heading error of a log and its rest, as `heading_error_shares` splits it."""
    total = sum(parts.values(), 0.0 * parts['left'])
    before, after = (np.concatenate([[0.0], np.cumsum(each)]) for each in (total, parts['left']))
    return Curve('time', 's', time, before, after)


def jackknife_change(square_sums: Array, counts: Array) -> Change:
    """
    Return root mean squares before and after, and the interval of their difference.

    Bootstrap intervals are too narrow for few parts, so the jackknife is used (Tukey 1958): each
    part is left out in turn, and the change has Student's distribution.
    """
    before, after = np.sqrt(square_sums.sum(axis=0) / counts.sum())
    parts = len(counts)
    if parts < 2:
        return Change(float(before), float(after), None)
    others = np.sqrt(
        np.maximum(square_sums.sum(axis=0) - square_sums, 0.0) / (counts.sum() - counts)[:, None])
    deviation = (parts - 1) / np.sqrt(parts) * np.std(others[:, 0] - others[:, 1], ddof=1)
    half = float(student.ppf(0.975, parts - 1) * deviation)
    won = float(before - after)
    return Change(float(before), float(after), (won - half, won + half))
