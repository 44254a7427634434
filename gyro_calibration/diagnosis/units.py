# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Numbers as people read them: the units, the digits that an interval leaves, and chances."""

from __future__ import annotations

from dataclasses import dataclass
import math
import re

from gyro_calibration.diagnosis.findings import Estimate, LEAST_PROBABILITY
from gyro_calibration.logs.log import DEGREE

_HOUR = 3600.0

#: Unit of SI -> unit of people and the factor to it, where it is not simply degrees for radians.
_UNITS = {'1': ('%', 100.0), '1/K': ('%/K', 100.0), 'degC': ('°C', 1.0),
          'rad/√s': ('deg/√h', math.sqrt(_HOUR) / DEGREE),
          'rad/s/√s': ('deg/h/√h', _HOUR ** 1.5 / DEGREE), 'K/s': ('K/min', 60.0)}
#: Parameters that people read in another unit than others of the same unit of SI.
_PARAMETERS = {'bias_instability': ('deg/h', _HOUR / DEGREE),
               'rate_ramp': ('deg/s/h', _HOUR / DEGREE), 'k': ('s', 1.0), 'unit_error': ('', 1.0),
               'outliers': ('', 1.0), 'stuck_samples': ('', 1.0), 'dropped_samples': ('', 1.0)}
#: (unit, below this many, the finer unit, how many of it).
_FINER = (('s', 0.5, 'ms', 1e3), ('%', 0.01, 'ppm', 1e4))
_RADIANS = re.compile(r'(/?)rad([²³]?)')


def for_people(unit: str, parameter: str = '') -> tuple[str, float]:
    """Return the unit that people read instead of one of SI, and the factor to it."""
    if parameter in _PARAMETERS or unit in _UNITS:
        return _PARAMETERS.get(parameter) or _UNITS[unit]
    radians = _RADIANS.search(unit)
    if radians is None:
        return unit, 1.0
    power = {'': 1, '²': 2, '³': 3}[radians[2]] * (-1 if radians[1] else 1)
    return unit.replace('rad', 'deg'), DEGREE ** -power


@dataclass(frozen=True)
class Quantity:
    """
    An estimate in the unit and with the digits that people read.

    Attributes
    ----------
    value, interval : both without the power; the interval is empty where there is none
    power : such as × 10⁻⁵; empty where there is none
    unit : of people

    """

    value: str
    interval: str
    power: str
    unit: str

    def __str__(self) -> str:
        """Return it for a sentence, such as 20.1 (19.8 to 20.4) ms."""
        return _joined(self.value, f'({self.interval})' if self.interval else '', self.power,
                       self.unit)

    @property
    def estimate(self) -> str:
        """Return the value alone."""
        return _joined(self.value, self.power, self.unit)

    @property
    def bounds(self) -> str:
        """Return the interval alone, without the unit."""
        return (_joined(f'({self.interval})', self.power) if self.interval and self.power
                else self.interval)


def _joined(*parts: str) -> str:
    return ' '.join(filter(None, parts))


def quantity(estimate: Estimate, parameter: str = '') -> Quantity:
    """Return an estimate as people read it."""
    unit, factor = for_people(estimate.unit, parameter)
    unit, factor = _finer(unit, factor, estimate.estimate, parameter)
    numbers = [factor * number for number in (estimate.estimate, *estimate.interval)]
    power = _power(max((abs(number) for number in numbers if math.isfinite(number)), default=0.0))
    value, low, high = (number / 10.0 ** power for number in numbers)
    width = high - low
    decimals = _decimals(0.5 * width) if 0.0 < width < math.inf else None
    interval = f'{_fixed(low, decimals)} to {_fixed(high, decimals)}' if width > 0.0 else ''
    return Quantity(_fixed(value, decimals), interval, _times(power), unit)


def _finer(unit: str, factor: float, value: float, parameter: str) -> tuple[str, float]:
    for name, below, finer, many in _FINER:
        if unit == name and 0.0 < abs(value * factor) < below and parameter not in _PARAMETERS:
            return finer, factor * many
    return unit, factor


def _power(largest: float) -> int:
    """Return the power of ten to write beside numbers up to this one: 0 if readable without."""
    return 0 if largest == 0.0 or 1e-4 <= largest < 1e6 else math.floor(math.log10(largest))


def _decimals(deviation: float) -> int:
    """Return the decimals that show two digits of a deviation."""
    return min(max(0, 1 - math.floor(math.log10(deviation))), 8)


def _fixed(value: float, decimals: int | None) -> str:
    if not math.isfinite(value):
        return 'not known' if math.isnan(value) else '∞' if value > 0.0 else '−∞'
    text = f'{value:.4g}' if decimals is None else f'{value:.{decimals}f}'
    return text.replace('-', '−')


def _times(power: int) -> str:
    return f'× 10{raised(power)}' if power else ''


def raised(power: int) -> str:
    """Return a power as it is written beside a ten."""
    return str(power).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))


def amount(value: float, unit: str, parameter: str = '', digits: int = 3) -> str:
    """Return a value of SI as people read it, such as 0.123 deg/s."""
    name, factor = for_people(unit, parameter)
    name, factor = _finer(name, factor, value, parameter)
    return _joined(number(value * factor, digits), name)


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many digits."""
    if not math.isfinite(value):
        return _fixed(value, None)
    power = _power(abs(value))
    text = (f'{value / 10.0 ** power:.{digits}g}' if abs(value) < 10.0 ** digits or power
            else f'{value:.0f}')
    return _joined(text, _times(power)).replace('-', '−')


def span(seconds: float) -> tuple[str, float]:
    """Return the unit in which people read times up to this one, and the factor to it."""
    for unit, size, most in (('s', 1.0, 600.0), ('min', 60.0, 4.0 * _HOUR)):
        if seconds <= most:
            return unit, 1.0 / size
    return 'h', 1.0 / _HOUR


def chance(probability: float) -> str:
    """Return a probability in words."""
    if math.isnan(probability):
        return 'not known'
    if probability < LEAST_PROBABILITY:
        return f'below 1 in {1.0 / LEAST_PROBABILITY:,.0f}'.replace(',', ' ')
    if probability >= 0.1:
        return f'{100.0 * probability:.0f} %'
    return f'1 in {float(f"{1.0 / probability:.2g}"):,.0f}'.replace(',', ' ')
