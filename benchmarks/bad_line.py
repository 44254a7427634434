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
Count the samples that arrive over a bad line, and those with a wrong rate, for each wire format.

    python benchmarks/bad_line.py

A share of all bytes is hit: a third of those is lost, a third is doubled, a third has a bit
flipped. The gyro turns at one rate, so each other rate is wrong. Formats with a CRC pass no wrong
rate, those with a sum few, and lines of text any that still reads as a number; there a full scale
that fits the robot, here 1.5 rad/s, rejects the largest. Needs neither port nor ROS; takes a
minute.
"""

from collections.abc import Iterator
from dataclasses import replace
import math
from pathlib import Path
import sys

from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample
from gyro_calibration.logs.log import DEGREE
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from fake_port import SETTINGS  # noqa: E402, I100, I202

SHARES = (0.001, 0.01, 0.1)
FRAMES = 50_000
SENT = 0.5  # rad/s
FULL_SCALE = 1.5  # rad/s
CHECKS = {'kvh_1750': 'CRC-32', 'fizoptika': 'sum, 16 bits', 'kvh_ecore': 'sum, 7 bits',
          'witmotion': 'sum, 8 bits'}


def damaged(data: bytes, generator: np.random.Generator, lost: float, doubled: float,
            flipped: float) -> bytes:
    """Return what arrives of bytes; each is lost, comes twice, or with one of its bits flipped."""
    drawn = generator.random(len(data))
    arrived = np.frombuffer(data, np.uint8).copy()
    struck = (drawn >= lost + doubled) & (drawn < lost + doubled + flipped)
    arrived[struck] ^= (1 << generator.integers(8, size=int(struck.sum()))).astype(np.uint8)
    times = np.where(drawn < lost, 0, np.where(drawn < lost + doubled, 2, 1))
    return np.repeat(arrived, times).tobytes()


def arrived(name: str, share: float, full_scale: float | None) -> list[float]:
    """Return the rates that arrive, rad/s, and as the first one that which a good line gives."""
    protocol, generator = find_protocol(name), np.random.default_rng(1)
    settings = replace(SETTINGS[name], full_scale=full_scale)
    encode, decoder = protocol.encoder(settings), protocol.decoder(settings)
    good = protocol.preamble + b''.join(encode(Sample(SENT, 25.0, 1.0, number))
                                        for number in range(4))
    rates = [protocol.decoder(settings).feed(good)[-1].output]
    for number in range(FRAMES):
        data = damaged(encode(Sample(SENT, 25.0, number / protocol.rate, number)), generator,
                       *(3 * [share / 3.0]))
        rates += [sample.output for sample in decoder.feed(data)]
    return rates


def row(name: str, share: float) -> str:
    exact, *rates = arrived(name, share, None)
    wrong = [rate for rate in rates if abs(rate - exact) > 1e-9]
    _, *limited = arrived(name, share, FULL_SCALE)
    left = [rate for rate in limited if abs(rate - exact) > 1e-9]
    worst = max(map(abs, wrong), default=math.nan) / DEGREE
    return (f'| `{name}` | {CHECKS.get(name, "none")} | {100.0 * share:g} % '
            f'| {100.0 * len(rates) / FRAMES:.1f} % | {len(wrong)} | {worst:.3g} | {len(left)} |')


def table() -> Iterator[str]:
    yield (f'| format | check | bytes struck | of {FRAMES} samples arrive | wrong ones '
           '| the largest, deg/s | wrong ones within full scale |')
    yield '|:---|:---|---:|---:|---:|---:|---:|'
    for name in sorted(PROTOCOLS):
        yield from (row(name, share) for share in SHARES)


def main() -> None:
    for line in table():
        print(line, flush=True)


if __name__ == '__main__':
    main()
