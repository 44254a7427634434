"""The diagnosis: its steps in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, norm

from gyro_calibration.diagnosis.candidates import fitted_shapes
from gyro_calibration.diagnosis.causes import CAUSES, REFERENCES
from gyro_calibration.diagnosis.curves import curves, heading_curve, noise_curve
from gyro_calibration.diagnosis.door import refuse
from gyro_calibration.diagnosis.experiment import separating
from gyro_calibration.diagnosis.extension import extended
from gyro_calibration.diagnosis.field import Named, work
from gyro_calibration.diagnosis.figures import NAMES, NoiseFigures, noise_figures
from gyro_calibration.diagnosis.finding import Diagnosis, Estimate, Finding, Gain
from gyro_calibration.diagnosis.gain import gain
from gyro_calibration.diagnosis.hygiene import Hygiene, inspect
from gyro_calibration.diagnosis.naming import named_finding, unexplained
from gyro_calibration.diagnosis.outcome import Outcome
from gyro_calibration.diagnosis.probes import along, is_named
from gyro_calibration.diagnosis.replay import Replay, replay
from gyro_calibration.diagnosis.search import MOST_OF, Search, alternatives, begin, evidence_of, polished, pruned, searched
from gyro_calibration.diagnosis.units import amount
from gyro_calibration.log import Log
from gyro_calibration.model import GyroModel
from gyro_calibration.noise import Noise

#: Shares of the false-alarm rate: of the causes that are searched for, of each noise figure, of bias and of scale factor error.
_OF_SEARCH, _OF_NOISE, _OF_BIAS = 0.6, 0.03, 0.05
#: An effect along the rate that is larger than this part of it is not named.
_LARGEST = 0.5
#: A cause that differs between logs beyond this chance does not repeat.
_REPEATS = 1e-3
#: Causes named from a temperature must repeat.
_MUST_REPEAT = frozenset({'temperature', 'temperature_rate'})

Say = Callable[[str], object]


def diagnose(logs: Sequence[Log], generator: np.random.Generator, model: GyroModel | None = None, rate: float = 0.01,
             names: Sequence[str] = (), say: Say = lambda step: None) -> Diagnosis:
    """
    Say what a simulation gets wrong, and why.

    Parameters
    ----------
    logs : of one gyro, with time, and a reference unless it rests
    generator : source of what is drawn: residuals of noise alone, and blocks for intervals
    model : of the simulation; an ideal gyro with the bias and scale factor error that fit best where it is None
    rate : of false alarms a diagnosis
    names : of the logs, for people
    say : is told each step as it begins

    Raises
    ------
    DataRefused : the logs allow no diagnosis

    """
    say('hygiene')
    for log in logs:
        refuse(log, model)
    hygiene = [inspect(log, model) for log in logs]
    say('replay')
    replays = [replay(_mended(log, clean), clean.trusted, generator, clean.update_interval, clean.heading_step, clean.step, model)
               for log, clean in zip(logs, hygiene)]
    say('search')
    search = begin(replays, generator, _OF_SEARCH * rate)
    named, unnamed = _parted(search, searched(search))
    say('sets')
    named, rivals = _simplest(search, named, unnamed)
    found = Outcome(work(search.field, named), search.field.replays)
    say('noise')
    figures = noise_figures(found.work, Noise() if model is None else model.noise)
    say('gain')
    won = gain(search, {each.candidate.cause for members in rivals for each in members}, generator) if named else None
    say('report')
    return _told(_Conclusion(search, found, rivals, unnamed, figures, won), hygiene, model, rate, names, generator)


@dataclass(frozen=True)
class _Conclusion:
    """
    What the search came to.

    Attributes
    ----------
    search : in the logs
    found : the causes that are named, in values
    rivals : of each, itself and those that may be in its place
    unnamed : structure without a name, and causes whose names were withdrawn
    figures : of the noise that is left
    won : on what was held out

    """

    search: Search
    found: Outcome
    rivals: Sequence[Sequence[Named]]
    unnamed: tuple[Named, ...]
    figures: NoiseFigures
    won: Gain | None


def _mended(log: Log, clean: Hygiene) -> Log:
    assert log.output is not None
    return log if clean.factor == 1.0 else replace(log, output=log.output * clean.factor)


def _parted(search: Search, everything: tuple[Named, ...]) -> tuple[tuple[Named, ...], tuple[Named, ...]]:
    """
    Part what is named from what is not.

    A name is withdrawn where there is more along its variable than it explains, where tones are many, and where a cause named from a
    temperature is another one in each log.

    """
    beyond = {name for each in everything if not is_named(each.candidate) for name in along(each.candidate).split(' and ')}
    tones = [each for each in everything if each.candidate.cause == 'interference_tone']
    if len(tones) >= MOST_OF['interference_tone']:
        beyond.add('frequency')
    kept = tuple(each for each in everything if is_named(each.candidate) and CAUSES[each.candidate.cause].along not in beyond)
    kept = tuple(each for each in kept if _repeats(search, everything, each) and _is_small(search, each))
    unnamed = tuple(each for each in everything if each not in kept)
    if not unnamed:
        return kept, ()
    rest = tuple(each for each in unnamed if not is_named(each.candidate) or CAUSES[each.candidate.cause].along not in
                 {along(other.candidate) for other in unnamed if not is_named(other.candidate)})
    left = pruned(search, polished(search, (*kept, *rest)))
    return tuple(each for each in left if any(_same(each, one) for one in kept)), rest


def _is_small(search: Search, known: Named) -> bool:
    """Tell whether an effect along the rate is small beside it, as those of a gyro are: another one has only its shape."""
    if CAUSES[known.candidate.cause].along != 'rate' or known.candidate.amplitude is not None:
        return True
    most = [float(np.abs(np.tensordot(known.values, np.array(known.candidate.columns(each)), 1)).max()) for each in search.field.replays]
    return max(most) < _LARGEST * max(float(np.abs(each.channels.rate).max()) for each in search.field.replays)


def _same(one: Named, other: Named) -> bool:
    return one.candidate.cause == other.candidate.cause and one.candidate.run == other.candidate.run


def _repeats(search: Search, everything: tuple[Named, ...], known: Named) -> bool:
    """Tell whether a cause named from a temperature is the same in all logs, as far as chance allows."""
    candidate, runs = known.candidate, len(search.field.replays)
    if runs == 1 or CAUSES[candidate.cause].along not in _MUST_REPEAT or not known.values or candidate.amplitude is not None:
        return True
    alone = [replace(candidate, run=run) for run in range(runs - 1)]
    more = 2.0 * (work(search.field, everything, alone).score - work(search.field, everything).score)
    return bool(chi2.sf(max(more, 0.0), len(known.values) * len(alone)) > _REPEATS)


def _simplest(search: Search, named: tuple[Named, ...], unnamed: tuple[Named, ...]) -> tuple[tuple[Named, ...], list[list[Named]]]:
    """Put the simplest member of each set in its place, and return all members of each."""
    rivals: list[list[Named]] = []
    for place, known in enumerate(named):
        members = [each for each, _ in alternatives(search, (*named, *unnamed), known)] or [known]
        chosen = min(members, key=_size)
        if _size(chosen) < _size(known):
            named = polished(search, (*named[:place], chosen, *named[place + 1:]))
        rivals.append(members)
    return named, rivals


def _size(known: Named) -> int:
    """Return how many values a cause has."""
    candidate = known.candidate
    return len(fitted_shapes(candidate)) + (0 if candidate.amplitude is not None else max(len(known.values), 1))


def _told(known: _Conclusion, hygiene: Sequence[Hygiene], model: GyroModel | None, rate: float, names: Sequence[str],
          generator: np.random.Generator) -> Diagnosis:
    """Put all that was found into words and records."""
    search, found, noise = known.search, known.found, known.figures.noise
    given, simulated = (GyroModel(), Noise()) if model is None else (model, model.noise)
    findings = [*_named(known, generator), *_once([each for clean in hygiene for each in clean.findings])]
    if model is not None:
        findings += [*_of_model(found, model, noise, rate), *_of_noise(known.figures, model.noise, rate, found.replays)]
    findings.sort(key=lambda each: each.p_value)
    plain, deviation = Outcome(work(search.field, []), found.replays), _bias_deviation(found, noise)
    offered = known.won is None or not known.won.worse
    before = extended(given, plain, noise, deviation, {}) if model is None else model
    after = extended(given, found, noise, deviation, _said_of_sets(findings)) if offered else before
    shown = found if offered else plain
    return Diagnosis(
        tuple(findings), tuple(unexplained(search, found, known.unnamed)), noise, simulated, known.won, before, after, _cannot_show(search),
        curves(plain, shown), heading_curve(plain, shown), noise_curve(found, noise, simulated),
        tuple(_remarks(hygiene, names, known, offered)), rate, tuple(names))


def _named(known: _Conclusion, generator: np.random.Generator) -> list[Finding]:
    """Return the causes that were named."""
    search, found, findings = known.search, known.found, []
    for place, (each, members) in enumerate(zip(found.named, known.rivals)):
        chance = search.chance.p_value(each.candidate.cause, evidence_of(search, (*found.named, *known.unnamed), place))
        findings.append(named_finding(search, found, place, chance, members, _separated(search, found, place, members, generator)))
    return findings


def _separated(search: Search, found: Outcome, place: int, members: Sequence[Named], generator: np.random.Generator) -> str:
    """Return the experiment that parts the members of a set."""
    known = found.named[place]
    others = [each for each in members if each.candidate.cause != known.candidate.cause]
    return separating(search.field, found.named, known, others, generator).sentence if others else ''


def _once(findings: Sequence[Finding]) -> list[Finding]:
    """Return each cause once, by the log that shows it best."""
    best: dict[str, Finding] = {}
    for each in findings:
        if each.effect not in best or each.p_value < best[each.effect].p_value:
            best[each.effect] = each
    return list(best.values())


def _bias_deviation(found: Outcome, noise: Noise) -> float:
    """Return the standard deviation of the mean bias of the logs, rad/s."""
    each = [noise.heading_variance(replay.duration) / replay.duration ** 2 for replay in found.replays]
    return float(np.sqrt(np.mean(each) / len(each) + found.bias_variance))


def _of_model(found: Outcome, model: GyroModel, noise: Noise, rate: float) -> list[Finding]:
    """Return bias and scale factor error as findings, where they differ from the model's beyond chance."""
    scale, bias = found.scale_factor_error, float(np.mean(found.biases))
    own = [_own_deviation(model, name) for name in ('bias', 'scale_factor_error')]
    # A bias that a model allows to wander is no other bias; one log says little of how far it does.
    likely = Noise(noise.angle_random_walk, *(max(getattr(each, name) for each in (noise, model.noise)) for name in NAMES[1:]))
    doubts = np.hypot([_bias_deviation(found, likely), scale.deviation], own)
    told = [('bias', bias, doubts[0], ()), ('scale_factor_error', scale.value, doubts[1], ('reference_scale',))]
    return [_against(name, value, float(deviation), twins) for name, value, deviation, twins in told
            if deviation > 0.0 and 2.0 * norm.sf(abs(value) / deviation) < _OF_BIAS * rate]


def _own_deviation(model: GyroModel, name: str) -> float:
    """Return the standard deviation that a model states for a value of its own, 0 where it states none."""
    if model.covariance is None:
        return 0.0
    owners = [term.effect.name for term in model.terms for _ in term.fitted]
    return float(np.sqrt(model.covariance[owners.index(name), owners.index(name)])) if name in owners else 0.0


def _against(name: str, value: float, deviation: float, twins: tuple[str, ...]) -> Finding:
    cause = CAUSES[name]
    unit = next(iter(cause.units.values()))
    return Finding(name, cause.sentence, {name: Estimate(value, (value - 1.96 * deviation, value + 1.96 * deviation), unit)},
                   float(2.0 * norm.sf(abs(value) / deviation)), 5.4 * deviation, twins, cause.separate_by if twins else '',
                   f'beside the model, it is {abs(value) / deviation:.3g} standard deviations from nothing', cause.along)


def _of_noise(figures: NoiseFigures, expected: Noise, rate: float, replays: Sequence[Replay]) -> list[Finding]:
    """Return the noise figures that are not those of the model."""
    found = []
    for name in NAMES[1:] if any(each.rounded for each in replays) else NAMES:  # the steps of an encoder hide white noise
        if figures.chance.get(name, 1.0) < _OF_NOISE * rate:
            cause, value = CAUSES[name], getattr(figures.noise, name)
            unit = next(iter(cause.units.values()))
            said = f'the model says {amount(getattr(expected, name), unit, name)}, the log {amount(value, unit, name)}'
            found.append(Finding(name, cause.sentence, {name: Estimate(value, figures.interval[name], unit)}, figures.chance[name], None,
                                 evidence=said, along=cause.along))
    return found


def _said_of_sets(findings: Sequence[Finding]) -> dict[str, object]:
    """Return a note on each set of which the simplest member is used, for the origin of the model."""
    notes = [f'{each.effect} is used; it may be {" or ".join(each.ambiguous_with)} instead' for each in findings if each.ambiguous_with]
    return {'ambiguous': notes} if notes else {}


def _cannot_show(search: Search) -> dict[str, str]:
    """Say of each cause that was not searched for why these logs cannot show it."""
    replays = search.field.replays
    has = frozenset.intersection(*(each.has for each in replays)) | {'time', 'output'}
    has |= {'reference', *REFERENCES} if any(np.any(each.reference != 0.0) for each in replays) else frozenset()
    told = {}
    for name, cause in CAUSES.items():
        missing = sorted(cause.needs - has)
        if missing:
            told[name] = f'the logs have no {" and no ".join(missing)}'.replace('_', ' ')
    for name, reason in _constant(replays).items():
        told.update({cause.name: reason for cause in CAUSES.values() if cause.along == name and cause.name not in told})
    return told


def _constant(replays: Sequence[Replay]) -> dict[str, str]:
    """Return the variables that stay the same in all logs, with what is said of them."""
    quiet = {}
    for name, reason in (('temperature', 'the temperature hardly changes'), ('supply', 'the supply voltage does not change'),
                         ('specific_force', 'the specific force does not change')):
        values = [getattr(each.channels, name) for each in replays if name in each.has]
        if values and max(float(np.ptp(value)) for value in values) < (0.2 if name == 'temperature' else 1e-9):
            quiet[name] = reason
    if 'temperature' in quiet:
        quiet['temperature_rate'] = quiet['temperature']
    return quiet


def _remarks(hygiene: Sequence[Hygiene], names: Sequence[str], known: _Conclusion, offered: bool) -> Iterator[str]:
    for place, clean in enumerate(hygiene):
        where = f'{names[place]}: ' if len(hygiene) > 1 and names else ''
        yield from (where + remark for remark in clean.remarks)
    for name in dict.fromkeys(each.candidate.cause for each in known.unnamed if is_named(each.candidate)):
        why = 'it is at many frequencies' if name == 'interference_tone' else 'it differs from log to log, or is not alone'
        yield f'What looks like {name.replace("_", " ")} is not named: {why}.'
    if not offered:
        yield 'On the parts held out, the extended model was worse than the one before; it is not offered.'
