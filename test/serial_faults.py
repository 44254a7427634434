# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Faults of a serial line: bytes lost, doubled and flipped; and settings for every format."""

from gyro_calibration.driver.protocols import PROTOCOLS, Settings
import numpy as np

#: With what a format cannot be without: one unit of fizoptika has 27880 counts per deg/s.
SETTINGS = {
    name: Settings(sensitivity=np.radians(1.0 / 27880.0) if protocol.sensitivity is None else None)
    for name, protocol in PROTOCOLS.items()}


def damaged(data, generator, lost=0.0, doubled=0.0, flipped=0.0):
    """Return what arrives of bytes; each is lost, comes twice, or with one of its bits flipped."""
    drawn = generator.random(len(data))
    arrived = np.frombuffer(data, np.uint8).copy()
    struck = (drawn >= lost + doubled) & (drawn < lost + doubled + flipped)
    arrived[struck] ^= (1 << generator.integers(8, size=int(struck.sum()))).astype(np.uint8)
    times = np.where(drawn < lost, 0, np.where(drawn < lost + doubled, 2, 1))
    return np.repeat(arrived, times).tobytes()
