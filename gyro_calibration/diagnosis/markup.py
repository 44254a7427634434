# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Elements of HTML and SVG: all else is escaped, so that no text can become an element."""

from __future__ import annotations

from html import escape

from gyro_calibration.diagnosis.words import clean

_EMPTY = {'path', 'line', 'circle', 'rect', 'meta', 'br'}


class Markup(str):
    """Text that is HTML already."""


def element(name: str, *children: str | None, **attributes: str | float | None) -> Markup:
    """
    Return an element.

    Parameters
    ----------
    name : of its tag
    children : elements, or texts, which are escaped; None is left out
    attributes : with _ for -, and one at the end to avoid a word of Python; None is left out

    """
    given = {key.rstrip('_').replace('_', '-'): _text(value) for key, value in attributes.items()
             if value is not None}
    named = ''.join(f' {key}="{_escaped(value)}"' for key, value in given.items())
    inside = ''.join(child if isinstance(child, Markup) else _escaped(child) for child in children
                     if child is not None)
    return Markup(f'<{name}{named}/>' if name in _EMPTY else f'<{name}{named}>{inside}</{name}>')


def joined(*parts: str) -> Markup:
    """Return parts one after the other, texts escaped."""
    return Markup(''.join(part if isinstance(part, Markup) else _escaped(part) for part in parts))


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f'{value:.2f}'.rstrip('0').rstrip('.')


def _escaped(text: str) -> str:
    return escape('\n'.join(clean(line) for line in text.split('\n')))
