# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Hidden logs given to the diagnosis, and how right its answers are."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
import itertools

from gyro_calibration.diagnosis.findings import Diagnosis, Finding
from gyro_calibration.diagnosis.pipeline import diagnose
from gyro_calibration.logs.log import COLUMNS, Log
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
from hidden import Cause, HiddenLog, OUTSIDE
from hidden.effects import AGAINST_A_MODEL, COUNTED, STEPPED, WITHOUT_COLUMN
import numpy as np

#: What no log can part.
SAME = {'reference_scale': 'scale_factor_error'}
#: An answer with more names is no answer.
LARGEST_SET = 3
#: Without a size that an interval could hold: what is counted, steps, and what has no size.
WITHOUT_SIZE = {*COUNTED, *STEPPED, 'unit_error', 'bias_instability'}
#: A diagnosis holds out one of so many blocks, of so many s.
EVERY, BLOCK = 3, 60.0


def log_of(hidden: HiddenLog) -> Log:
    """Return what the package reads of a hidden log."""
    return Log(
        **{COLUMNS[name][0]: column * COLUMNS[name][1] for name, column in hidden.columns.items()})


def model_of(hidden: HiddenLog) -> GyroModel:
    """Return the model of who knows all but what is hidden."""
    known = hidden.truth.expected
    terms = (Term(BIAS, (known['bias'],)),
             Term(SCALE_FACTOR_ERROR, (known['scale_factor_error'],)))
    return GyroModel(terms, noise=Noise(known['angle_random_walk'], known['bias_instability'],
                                        known['rate_random_walk']))


def diagnosis_of(hidden: Sequence[HiddenLog], generator: np.random.Generator,
                 with_model: bool | None = None) -> Diagnosis:
    """Diagnose hidden logs, with a model where the hidden cause is found only against one."""
    wanted = (bool(set(hidden[0].truth.names) & set(AGAINST_A_MODEL)) if with_model is None
              else with_model)
    return diagnose([log_of(each) for each in hidden], generator,
                    model_of(hidden[0]) if wanted else None)


@dataclass(frozen=True)
class Judged:
    """
    How right an answer is.

    Attributes
    ----------
    detected : something is reported
    first : the strongest finding has the right name
    in_set : each hidden cause is a finding of its own, or in its set
    set_sizes : of the findings that hold a hidden cause
    extra : names of the findings that hold none
    beyond : variables of structures without a name
    right : each hidden cause is in a set of at most three, and nothing else is reported; a cause
        outside the catalogue is reported as unexplained, and nothing is named
    held : of each cause that is named with a number, whether its interval of 95 % holds the truth

    """

    detected: bool
    first: bool
    in_set: bool
    set_sizes: tuple[int, ...]
    extra: tuple[str, ...]
    beyond: tuple[str, ...]
    right: bool
    held: dict[str, bool]


def judged(hidden: HiddenLog, findings: Sequence[Finding], beyond: Sequence[str],
           allowed: Collection[str] = ()) -> Judged:
    """
    Compare an answer with the truth.

    Parameters
    ----------
    hidden : one of the logs
    findings : the named causes
    beyond : variables along which there is structure without a name
    allowed : names of findings that are true though they were not hidden

    """
    wanted = {SAME.get(name, name) for name in hidden.truth.names}
    findings = [each for each in findings if each.effect not in allowed or each.effect in wanted]
    sets = [_names(each) for each in findings]
    matched = _matched(sorted(wanted - set(OUTSIDE)), sets)
    extra = tuple(each.effect for each, names in zip(findings, sets) if not names & wanted)
    sizes = tuple(len(each) for each in sets if each & wanted)
    complete = (len(matched) == len(wanted) == len(sizes) and max(sizes, default=0) <= LARGEST_SET
                and not extra and not beyond)
    right = bool(beyond) and not findings if wanted & set(OUTSIDE) else complete
    return Judged(bool(findings or beyond),
                  bool(findings) and SAME.get(findings[0].effect, findings[0].effect) in wanted,
                  len(matched) == len(wanted), sizes, extra, tuple(beyond), right,
                  held(hidden.truth.gyro.causes, findings))


def judged_diagnosis(hidden: HiddenLog, found: Diagnosis, allowed: Collection[str] = ()) -> Judged:
    """Compare a diagnosis with the truth."""
    return judged(hidden, found.findings, [each.along for each in found.unexplained], allowed)


def _names(finding: Finding) -> set[str]:
    """Return the set of a finding; what no log can part is one."""
    return {SAME.get(name, name) for name in (finding.effect, *finding.ambiguous_with)}


def _matched(wanted: Sequence[str], sets: Sequence[set[str]]) -> dict[str, int]:
    """Give each hidden cause a finding of its own that holds it, to as many as can be."""
    places: list[list[int | None]] = [
        [*(place for place, each in enumerate(sets) if name in each), None] for name in wanted]
    ways = (way for way in itertools.product(*places) if _once(way))
    best = max(ways, key=lambda way: sum(place is not None for place in way))
    return {name: place for name, place in zip(wanted, best) if place is not None}


def _once(way: Sequence[int | None]) -> bool:
    given = [place for place in way if place is not None]
    return len(set(given)) == len(given)


def held(causes: Iterable[Cause], findings: Sequence[Finding],
         deviations: float = 1.96) -> dict[str, bool]:
    """
    Return for each cause named with a number whether its interval holds the truth.

    Where the phase says the sign of a wave, the size has none. What is counted has no interval, a
    wrong unit no size, and flicker beside a Gauss-Markov process none that an Allan deviation
    would tell.

    """
    by_name = {each.effect: each.parameters.get(each.effect) for each in findings}
    told = {}
    for cause in causes:
        estimate = None if cause.name in WITHOUT_SIZE else by_name.get(cause.name)
        if estimate is not None:
            half = 0.5 * (estimate.interval[1] - estimate.interval[0]) * deviations / 1.96
            size = abs(cause.size) if 'phase' in cause.shapes else cause.size
            told[cause.name] = bool(abs(estimate.estimate - size) <= half)
    return told


def won(hidden: HiddenLog, found: Diagnosis) -> dict[str, tuple[float, float]]:
    """
    Return the gains in mean square rate and heading error, by the diagnosis and by the truth.

    Both on the parts held out, in units of what the truth leaves; nothing where the diagnosis
    measured no gain, or where what is hidden has no gain to measure.

    """
    if found.gain is None or set(hidden.truth.names) <= WITHOUT_COLUMN:
        return {}
    changes = {'rate': found.gain.rate, 'heading': found.gain.heading}
    knowing = _knowing(hidden)
    return {name: ((change.before ** 2 - change.after ** 2) / knowing[name][1],
                   (knowing[name][0] - knowing[name][1]) / knowing[name][1])
            for name, change in changes.items() if change is not None and knowing[name][1] > 0.0}


def _knowing(hidden: HiddenLog) -> dict[str, tuple[float, float]]:
    """
    Return the mean squares left on the parts held out, by bias and scale alone and by the truth.

    The truth takes the bias, as the others do, from the other parts: it wanders.

    """
    truth, output, stamps, good = (hidden.truth, hidden.columns['gyro_rad_s'],
                                   hidden.columns['time_s'], hidden.truth.good)
    length = min(BLOCK, (stamps[-1] - stamps[0]) / 6.0)
    number = np.floor((stamps - stamps[0]) / length).astype(int)
    out = (number % EVERY == 1) & (number < int((stamps[-1] - stamps[0]) / length + 1e-9))
    kept = good & ~out
    design = np.column_stack([np.ones_like(output), truth.reference])
    left = [output - design @ np.linalg.lstsq(design[kept], output[kept], rcond=None)[0],
            output - _predicted(hidden)]
    left[1] = left[1] - np.mean(left[1][kept])
    headings = [[length * np.mean(each[out & good & (number == block)])
                 for block in np.unique(number[out])] for each in left]
    return {'rate': _squares([each[out & good] for each in left]), 'heading': _squares(headings)}


def _predicted(hidden: HiddenLog) -> np.ndarray:
    """Return the output to expect; that of a noisy gyro has no steps."""
    truth, gyro = hidden.truth, hidden.truth.gyro
    limit = gyro.value('saturation') or np.inf
    return np.clip(truth.rate + truth.added, -limit, limit) * (gyro.value('unit_error') or 1.0)


def _squares(both: Sequence[Sequence[float]]) -> tuple[float, float]:
    before, after = (float(np.mean(np.square(each))) for each in both)
    return before, after


def described(hidden: HiddenLog, found: Diagnosis) -> str:
    """Return what was hidden and what was answered, in a few lines."""
    causes = [f'{cause.name} {cause.size:.4g} {cause.unit} at {cause.multiple:.3g} times, '
              f'apart {cause.apart:.3g}, '
              f'{ {name: float(f"{value:.4g}") for name, value in cause.shapes.items()} }'
              for cause in hidden.truth.gyro.causes]
    said = [f'{"|".join([each.effect, *each.ambiguous_with])} p={each.p_value:.1e} '
            f"""{ {name: [float(f"{x:.4g}") for x in (value.estimate, *value.interval)]
                    for name, value in each.parameters.items()} }"""
            for each in found.findings]
    said += [f'unexplained along {each.along}, {each.share_of_variance:.2g} of the variance'
             for each in found.unexplained]
    return f'hidden: {"; ".join(causes) or "nothing"}\n    answer: {"; ".join(said) or "nothing"}'
