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

from gyro_calibration.diagnosis.findings import Diagnosis, Finding
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.logs.log import COLUMNS, Log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration_bench import scores
from gyro_calibration_bench.hidden import Cause, HiddenLog
from gyro_calibration_bench.hidden.effects import MODEL_FINDINGS, WITHOUT_COLUMN
from gyro_calibration_bench.methods import answer_of_finding, known_model
from gyro_calibration_bench.scores import judge_answer, Judgement
import numpy as np

#: A diagnosis holds out one of so many blocks, of so many s.
EVERY, BLOCK = 3, 60.0


def log_of(hidden: HiddenLog) -> Log:
    """Return what the package reads of a hidden log."""
    return Log(
        **{COLUMNS[name][0]: column * COLUMNS[name][1] for name, column in hidden.columns.items()})


def model_of(hidden: HiddenLog) -> GyroModel:
    """Return the model of who knows all but what is hidden."""
    return known_model(hidden.truth.expected)


def diagnosis_of(hidden: Sequence[HiddenLog], generator: np.random.Generator,
                 with_model: bool | None = None) -> Diagnosis:
    """Diagnose hidden logs, with a model where the hidden cause is found only against one."""
    wanted = (bool(set(hidden[0].truth.names) & set(MODEL_FINDINGS)) if with_model is None
              else with_model)
    return diagnose([log_of(each) for each in hidden], generator,
                    model_of(hidden[0]) if wanted else None)


def judge_findings(hidden: HiddenLog, findings: Sequence[Finding], beyond: Sequence[str] = (),
                   allowed: Collection[str] = ()) -> Judgement:
    return judge_answer(hidden.truth.gyro.causes, [answer_of_finding(each) for each in findings],
                        beyond, allowed)


def judge_diagnosis(hidden: HiddenLog, found: Diagnosis,
                    allowed: Collection[str] = ()) -> Judgement:
    return judge_findings(hidden, found.findings, [each.along for each in found.unexplained],
                          allowed)


def held(causes: Iterable[Cause], findings: Sequence[Finding],
         deviations: float = 1.96) -> dict[str, bool]:
    """Return for each cause named with a number whether its interval holds the truth."""
    return scores.interval_holds(causes, [answer_of_finding(each) for each in findings],
                                 deviations)


def limited(command: np.ndarray, most: float) -> np.ndarray:
    """Return what follows a command, from rest, and changes by no more than so much at a time."""
    rates = [0.0]
    for wanted in command[1:].tolist():
        rates.append(rates[-1] + min(max(wanted - rates[-1], -most), most))
    return np.array(rates)


def established(found: Diagnosis) -> dict[str, Finding]:
    """Return the established findings by their effects."""
    return {each.effect: each for each in found.findings if each.status == 'established'}


def estimates(found: Diagnosis) -> dict[str, tuple[float, float]]:
    """Return the values of the model of a diagnosis and their deviations, by name."""
    return {name: (value, deviation) for name, _, value, deviation in found.model.estimates()}


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
                                   hidden.columns['time_s'], hidden.truth.is_good)
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
    limit = gyro.size_of('saturation') or np.inf
    return np.clip(truth.rate + truth.added_rate, -limit, limit) * (
        gyro.size_of('unit_error') or 1.0)


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
