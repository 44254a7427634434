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
from gyro_calibration_bench.hidden.effects import MODEL_FINDINGS
from gyro_calibration_bench.methods import answer_of_finding, known_model
from gyro_calibration_bench.scores import judge_answer, Judgement
import numpy as np


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
