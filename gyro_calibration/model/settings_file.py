# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""YAML files of settings, as data only: nothing in them is run, and they name no other files."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import re
from typing import Any

from gyro_calibration.files import (
    MAX_DEPTH, MAX_MAGNITUDE, read_bytes, suggest_nearest, to_printable)
import numpy as np
import yaml

_FLOAT = re.compile(r'[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?')


def read_settings(path: str | Path) -> Any:
    """
    Read a YAML file of names, texts, numbers, true, false, null and lists, or raise `ValueError`.

    Dates are texts, and 1e-4 is a number. A file that names its format must end with a line end: a
    truncated 9.3e-06 could read as 9.3.
    """
    try:
        # twice the size of a model with the covariance of 150 values
        text = read_bytes(path, 1_000_000).decode('utf-8-sig')
        content = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        problem, mark = error, None
        if isinstance(error, yaml.MarkedYAMLError):
            problem, mark = (error.problem or error.context,
                             error.problem_mark or error.context_mark)
        place = f'line {mark.line + 1}: ' if mark else ''
        raise ValueError(place + ' '.join(str(problem).split())[:200]) from error
    if isinstance(content, dict) and 'format' in content and not text.endswith(('\n', '\r')):
        raise ValueError('its last line has no end, as that of a file which was cut off')
    return content


class InvalidValue(ValueError):
    """A value does not fit its schema; the message is part of a sentence."""

    def __init__(self, key_path: str, value: Any, expected: str):
        super().__init__(f'{to_printable(key_path[:100])} is '
                         f'{"empty" if value is None else repr(value)[:100]}; wanted {expected}')


def validate(key_path: str, value: Any, schema: Any) -> Any:
    """
    Return a value, at a place such as `noise.angle_random_walk`, as parsed by its schema.

    A schema is a function of place and value; a mapping of optional names to schemas; or None, for
    a mapping of any names. Raise `InvalidValue` for others.
    """
    if callable(schema):
        return schema(key_path, value)
    if not isinstance(value, dict):
        raise InvalidValue(key_path, value, 'names with values')
    if schema is None:
        return value
    refuse_unknown_names(key_path, value, schema)
    return {name: validate(f'{key_path}.{name}', each, schema[name])
            for name, each in value.items()}


def refuse_unknown_names(key_path: str, given: Mapping[str, Any],
                         known: Sequence[str] | Mapping[str, Any]) -> None:
    """Raise `InvalidValue` for an unknown name."""
    for name in given:
        if name not in known:
            place = name if key_path == 'the file' else f'{key_path}.{name}'
            raise InvalidValue(place, given[name],
                               f'one of {", ".join(known)}{suggest_nearest(name, known)}')


def parse_number(key_path: str, value: Any, low: float = -MAX_MAGNITUDE,
                 high: float = MAX_MAGNITUDE) -> float:
    """Return a finite number within bounds, or raise `InvalidValue`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        least = '' if low == -MAX_MAGNITUDE else f' of at least {low:g}'
        wanted = (f'a finite number{least}' if high == MAX_MAGNITUDE
                  else f'a number from {low:g} to {high:g}')
        raise InvalidValue(key_path, value, wanted)
    return float(value)


def parse_text(key_path: str, value: Any) -> str:
    """Return a scalar as text, also one that YAML reads as a number."""
    if isinstance(value, (list, dict)):
        raise InvalidValue(key_path, value, 'a text')
    return str(value)


def format_settings(content: Any) -> str:
    """Return finite numbers, texts, lists and names as YAML, as `read_settings` reads it."""
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def _parse_plain(text: str) -> Any:
    if text in ('', '~', 'null', 'Null', 'NULL'):
        return None
    if text.lower() in ('true', 'false'):
        return text.lower() == 'true'
    if re.fullmatch('[-+]?[0-9]{1,400}', text):
        return int(text)
    if text.lower().lstrip('+-') in ('.inf', '.nan'):
        return float(text.lower().replace('.', ''))
    return float(text) if len(text) < 400 and _FLOAT.fullmatch(text) else text


class _Loader(yaml.BaseLoader):
    """Reads names, texts, numbers and lists, and refuses aliases, tags and names given twice."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        # a few lines with aliases expand to gigabytes; deep nesting overflows the stack of Python
        event: Any = self.peek_event()
        if event.anchor is not None:
            _refuse_node('an anchor or alias is not read; write out what it stands for', event)
        if event.tag is not None:
            _refuse_node('a tag is not read; leave it out', event)
        if self._depth == MAX_DEPTH:
            _refuse_node(f'more than {MAX_DEPTH} levels are nested', event)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_scalar(self, node: Any) -> Any:
        return node.value if node.style else _parse_plain(node.value)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[str, Any]:
        names: dict[str, Any] = {}
        for name, value in node.value:
            if not isinstance(name, yaml.ScalarNode):
                _refuse_node('a name is a list, or holds names', name)
            if name.value in names:
                _refuse_node(f'{name.value[:50]!r} is given twice; keep one of them', name)
            names[name.value] = self.construct_object(value, deep)
        return names


def _refuse_node(problem: str, node: Any) -> None:
    raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


class _Dumper(yaml.SafeDumper):
    """Quotes texts that would be read as numbers or line ends."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_str(self, data: str) -> Any:
        quoted = _parse_plain(data) != data or re.search('[\x85\u2028\u2029]', data)
        return self.represent_scalar('tag:yaml.org,2002:str', data, '"' if quoted else None)

    def represent_float(self, data: float) -> Any:
        if not math.isfinite(data):
            raise ArithmeticError(f'{data:g} is no number that a file may hold')
        return super().represent_float(data)


_Dumper.add_representer(str, _Dumper.represent_str)
_Dumper.add_representer(float, _Dumper.represent_float)
_Dumper.add_multi_representer(np.generic, lambda dumper, value: dumper.represent_data(
    float(value) if isinstance(value, np.floating) else value.item()))
