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
Wire formats of serial gyros: bytes to samples and back, and recognition of formats.

A format is a module of this folder with one `Protocol`; it is found by being there. The driver,
`record`, `emulate`, their help, the recognition and the page on wire formats are made from these
records. No port, no ROS and no clock is used here.

>>> decoder = find_protocol('kvh_dsp3000').decoder()
>>> decoder.feed(b'       0.015733   1\\r\\n')
[Sample(output=-0.00027459265121626786, ...)]
"""

from __future__ import annotations

import importlib
import pkgutil

from gyro_calibration.driver.protocols.protocol import (
    Counts, Decoder, Protocol, Sample, Settings)
from gyro_calibration.files import suggest_nearest

__all__ = ['AUTO', 'BAUDS', 'PROTOCOLS', 'Counts', 'Decoder', 'Protocol', 'Sample', 'Settings',
           'find_protocol', 'recognize_protocol']

#: The formats by name.
PROTOCOLS = {
    value.name: value for each in pkgutil.iter_modules(__path__)
    for value in vars(importlib.import_module(f'{__name__}.{each.name}')).values()
    if isinstance(value, Protocol)}
AUTO = 'auto'  # name that stands for recognition by listening
#: Bits per second, in order of the attempts: first the defaults of gyros, then others.
BAUDS = (*dict.fromkeys(protocol.baud for protocol in PROTOCOLS.values()), 460800, 230400, 19200)


def find_protocol(name: str) -> Protocol:
    """Return a protocol by its name; ValueError names the known ones where there is none."""
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    raise ValueError(f'protocol {name!r} is not known: choose one of {", ".join(PROTOCOLS)}'
                     f'{suggest_nearest(name, PROTOCOLS)}')


def recognize_protocol(data: bytes, settings: Settings) -> Protocol | None:
    """
    Return the format that explains the last 8192 bytes; None if ambiguous, or too few bytes.

    The settings may be incomplete for it; `csv` is recognized by the number of their columns.
    """
    data, scores = data[-8192:], []
    for protocol in PROTOCOLS.values():  # the share of the bytes in frames, and these frames
        splitter, parse = protocol.splitter(), protocol.parser(settings)
        found = splitter.feed(data)
        good = [frame.data for frame in found if parse(frame.data) is not None]
        explained = 0.0
        if good:
            received = splitter.discarded_bytes + sum(len(frame.data) for frame in found)
            begun = min(found[0].skipped_bytes, max(map(len, good)))
            explained = sum(map(len, good)) / (received - begun)
        scores.append((explained, good, protocol))
    (share, frames, best), (next_share, *_) = sorted(scores, key=lambda each: -each[0])[:2]
    # Fewer than three frames may be chance. A line may damage half of the bytes; of equal frames,
    # as zeros may pass a weak check, 5 %.
    least = 0.5 if len(set(frames)) > 2 else 0.95
    return best if len(frames) > 2 and share >= least and next_share < 0.8 * share else None
