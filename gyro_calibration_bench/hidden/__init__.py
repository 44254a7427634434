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
Logs with hidden effects, made independently of the package: nothing of it is imported here.

`hide` makes logs of a random gyro; `FORMS` are the effects of the catalogue, `OUTSIDE_CATALOGUE`
those that are not in it; `hide_look_alike` and `record_separating` make the logs on which two
causes are confounded, and on which they are distinguishable.

A size is a multiple of the minimum detectable effect beside a bias of each recording and one scale
(`size`), with these exceptions: faults of samples are counted, and three are just detectable;
quantization and encoder steps have the size whose added variance is just detectable; a wrong unit
has no size; a figure of the noise changes until its spectrum is as far from the expected one as a
just detectable effect is from none.

Reading order: `motion`, `noise`, `effects`, `size`, `log`, `conditions`.
"""

from gyro_calibration_bench.hidden.conditions import (
    hide_look_alike, LOOK_ALIKES, record_separating)
from gyro_calibration_bench.hidden.effects import FORMS, OUTSIDE_CATALOGUE
from gyro_calibration_bench.hidden.log import (
    ALL, Cause, draw_gyro, Gyro, HiddenLog, hide, record, Truth)
from gyro_calibration_bench.hidden.motion import Session, session, session_from_motion
from gyro_calibration_bench.hidden.noise import KINDS, NoiseFigures
from gyro_calibration_bench.hidden.size import DETECTION_SIGMAS

__all__ = [
    'ALL', 'DETECTION_SIGMAS', 'FORMS', 'KINDS', 'OUTSIDE_CATALOGUE', 'LOOK_ALIKES', 'Cause',
    'Gyro', 'HiddenLog', 'NoiseFigures', 'Session', 'Truth', 'session_from_motion', 'draw_gyro',
    'hide', 'record_separating', 'record', 'session', 'hide_look_alike'
]
