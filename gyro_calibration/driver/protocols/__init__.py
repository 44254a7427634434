# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

r"""
Wire formats of serial gyros: bytes to samples and back, and recognition of formats (`listening`).

This package uses no port, no ROS and no clock.

>>> decoder = find_protocol('kvh_dsp3000').decoder()
>>> decoder.feed(b'       0.015733   1\\r\\n')
[Sample(output=-0.00027459265121626786, ...)]

"""

from __future__ import annotations

from gyro_calibration.driver.protocols.csv_lines import CSV
from gyro_calibration.driver.protocols.fizoptika import FIZOPTIKA
from gyro_calibration.driver.protocols.kvh_1750 import KVH_1750
from gyro_calibration.driver.protocols.kvh_dsp3000 import KVH_DSP3000
from gyro_calibration.driver.protocols.kvh_ecore import KVH_ECORE
from gyro_calibration.driver.protocols.minimu9 import MINIMU9
from gyro_calibration.driver.protocols.protocol import Decoder, Protocol, Sample, Settings
from gyro_calibration.driver.protocols.razor import RAZOR
from gyro_calibration.driver.protocols.witmotion import WITMOTION
from gyro_calibration.files import suggest_nearest

PROTOCOLS = {protocol.name: protocol for protocol in (KVH_DSP3000, KVH_1750, KVH_ECORE, FIZOPTIKA,
                                                      MINIMU9, WITMOTION, RAZOR, CSV)}

__all__ = ['PROTOCOLS', 'Decoder', 'Protocol', 'Sample', 'Settings', 'find_protocol']


def find_protocol(name: str) -> Protocol:
    """Return a protocol by its name; ValueError names the known ones where there is none."""
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    raise ValueError(f'protocol {name!r} is not known: choose one of {", ".join(PROTOCOLS)}'
                     f'{suggest_nearest(name, PROTOCOLS)}')
