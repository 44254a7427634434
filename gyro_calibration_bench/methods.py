# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.
"""Answers of gyro_calibration to the cases of the bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gyro_calibration_bench.scores import NamedCause
import numpy as np

#: Bias, scale_factor_error, angle_random_walk, bias_instability and rate_random_walk, in SI.
KnownModel = Mapping[str, float]

#: Single events, which one log cannot establish.
SINGLE_EVENTS = ('bias_step', 'reference_slip')


def answer_of_finding(finding: Any) -> NamedCause:
    """Return a finding of gyro_calibration as an answer of the bench."""
    size = finding.parameters.get(finding.effect)
    return NamedCause(finding.effect, tuple(finding.ambiguous_with), size and size.estimate,
                      size and tuple(size.interval))


def reported_findings(findings: Sequence[Any]) -> list[Any]:
    """Return the established findings, and suspected single events."""
    return [each for each in findings if each.status == 'established'
            or each.effect in SINGLE_EVENTS and each.p_value < 0.01]


def known_model(known: KnownModel) -> Any:
    """Return what is known of a gyro as a model."""
    from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
    from gyro_calibration.model.gyro_model import GyroModel, Term
    from gyro_calibration.model.noise import Noise
    terms = Term(BIAS, (known['bias'],)), Term(SCALE_FACTOR_ERROR, (known['scale_factor_error'],))
    return GyroModel(terms, noise=Noise(known['angle_random_walk'], known['bias_instability'],
                                        known['rate_random_walk']))


def answer_logs(logs: Sequence[Path],
                known: KnownModel | None) -> tuple[list[NamedCause], bool]:
    """Return the causes that gyro_calibration names, and whether structure is unexplained."""
    from gyro_calibration import read_log
    from gyro_calibration.diagnosis.log_diagnosis import diagnose
    found = diagnose([read_log(path) for path in logs], np.random.default_rng(0),
                     None if known is None else known_model(known))
    return ([answer_of_finding(each) for each in reported_findings(found.findings)],
            bool(found.unexplained))
