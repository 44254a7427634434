# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Parameters of a node as a table, and checks of their values, without rclpy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
import reprlib
from types import SimpleNamespace

_TYPE_NAMES: dict[type, str] = {bool: 'true or false', int: 'a whole number', float: 'a number',
                                str: 'text', list: 'a list of strings'}


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node; its type is the type of its default."""

    name: str  # groups are separated by a dot, as in ``calibration.maximum_bias``
    default: bool | int | float | str | Sequence[str]
    description: str  # one sentence, without the unit
    unit: str = ''
    range: tuple[float, float] | None = None  # noqa: A003  lowest and highest value allowed
    dynamic: bool = False  # may be set while the node runs
    choices: tuple[str, ...] = ()  # allowed values of a text; empty for any

    @property
    def attribute(self) -> str:
        """Return the attribute in the record of values: ``calibration_maximum_bias``."""
        return self.name.replace('.', '_')

    @property
    def choices_text(self) -> str:
        """Return the choices as text; '' if any value is allowed."""
        return f'{", ".join(self.choices[:-1])} or {self.choices[-1]}' if self.choices else ''

    def check(self, value: object) -> object:
        """
        Return the value in the type of the default; an integer is accepted for a float.

        A `ValueError` states the valid ones.

        """
        if isinstance(self.default, float) and type(value) is int and abs(value) < 1 << 63:
            value = float(value)
        several = isinstance(self.default, Sequence) and not isinstance(self.default, str)
        wanted: type = list if several else type(self.default)
        texts = value if isinstance(value, list) else [value]
        if (type(value) is not wanted
                or several and not all(isinstance(each, str) for each in texts)):
            self._refuse(value, self.choices_text or f'{_TYPE_NAMES[wanted]}, for example '
                         f'{self.default!r}')
        if any('\0' in each for each in texts if isinstance(each, str)):
            self._refuse(value, 'without a zero byte')
        if isinstance(value, float) and not math.isfinite(value):
            self._refuse(value, f'finite, for example {self.default!r}')
        if self.range and isinstance(value, (int, float)):
            low, high = self.range
            if not low <= value <= high:
                self._refuse(value, f'from {low} to {high} {self.unit}'.rstrip())
        if self.choices and value not in self.choices:
            self._refuse(value, self.choices_text)
        return value

    def _refuse(self, value: object, wanted: str) -> None:
        raise ValueError(f'parameter {self.name} is {reprlib.repr(value)}, but must be {wanted}')


def parameter_values(table: Sequence[Parameter],
                     given: Mapping[str, object] | None = None) -> SimpleNamespace:
    """Return the values of a table by attribute: checked given values, else defaults."""
    given = given or {}
    return SimpleNamespace(**{each.attribute: each.check(given[each.name]) if each.name in given
                              else each.default for each in table})
