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
Several logs of one gyro as one log, with gaps.

Each log has a bias of its own, and by a clock of its own a delay, for which its reference is
shifted before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from gyro_calibration.calibration.reference_noise import OwnInstants
from gyro_calibration.logs.columns import QUANTITIES
from gyro_calibration.logs.log import Array, Log
from gyro_calibration.model.channels import channels_from_log
from gyro_calibration.model.effects import Channels
import numpy as np
from numpy.typing import NDArray

#: From the end of a log to the begin of the next, s: longer than a turn over which headings are
#: compared.
_GAP = 60.0


@dataclass(frozen=True, eq=False)
class JoinedLogs:
    """Logs of one gyro as one log, with gaps."""

    log: Log  # of n rows
    begins: Array  # of the logs, s, shape (k,)
    channels: Channels  # whose time is that since the begin of each log
    delays: Array  # of the gyro in each log, already corrected, s, (k,); (0,) by one clock
    instants: OwnInstants  # of the reference, shifted by the delays

    def find(self, time: Array | float) -> NDArray[np.intp]:
        """Return the number of the log of times, s, from 0 on; a gap belongs to the one before."""
        return np.maximum(np.searchsorted(self.begins, time, side='right') - 1, 0)


def join_logs(logs: Sequence[Log], instants: Sequence[OwnInstants | None],
              delays: Sequence[float] = ()) -> JoinedLogs:
    """
    Join logs, each with a reference of the same quantity, and its instants if that is slow.

    The delays of the gyros, s, shape (k,), are those by another clock than that of the reference;
    none by the same.
    """
    quantities = [name for name in QUANTITIES
                  if all(getattr(log, name) is not None for log in logs)]
    logs = [Log(**{name: getattr(log, name) for name in quantities}) for log in logs]
    times, at, values, begin = list[Array](), list[Array](), list[Array](), 0.0
    for place, (log, own) in enumerate(zip(logs, instants)):
        reference = log.reference_rate if log.reference_heading is None else log.reference_heading
        assert log.time is not None and reference is not None
        stamps, known = (log.time, reference) if own is None else own[:2]
        times.append(log.time - log.time[0] + begin)
        at.append(stamps - log.time[0] + begin + (delays[place] if delays else 0.0))
        values.append(known)
        begin = float(times[-1][-1]) + _GAP
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(log, name) for log in logs]) for name in quantities}
    return JoinedLogs(Log(**{**arrays, 'time': np.concatenate(times)}),
                      np.array([each[0] for each in times]),
                      _join_channels([channels_from_log(log) for log in logs]), np.array(delays),
                      OwnInstants(np.concatenate(at), np.concatenate(values), _GAP, False))


def _join_channels(parts: Sequence[Channels]) -> Channels:
    """Return channels one after the other, each with its own past."""
    def join(name: str) -> Any:
        values = [getattr(each, name) for each in parts]
        return None if any(each is None for each in values) else np.concatenate(values)

    def join_past(name: str) -> Callable[[Any, float], Array]:
        return lambda *key: np.concatenate([getattr(each, name)(*key) for each in parts])

    return Channels(**{name: join(name) for name in (
        'rate', 'output', 'temperature', 'time', 'specific_force', 'supply', 'heading')},
        lagged=join_past('lagged'), heating=join_past('heating'))
