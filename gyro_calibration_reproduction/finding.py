# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The results of a reproduction: published and computed numbers, and contradictions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
import math
import textwrap
from typing import Any


@dataclass(frozen=True)
class Comparison:
    """A published number and the one computed here, both in the unit of the source."""

    quantity: str
    unit: str
    ours: float  # the computed number
    # as printed, since its last digit shows its accuracy; ``< 2`` is a bound, ``~ 10`` an order of
    # magnitude, '' means that the source has no such number
    published: str = ''
    place: str = ''  # in the source
    uncertainty: float = 0.0  # of the computed number, from the finite number of runs
    why: str = ''  # reason of a difference, in a few words, printed where there is one
    note: str = ''  # in a few words, printed in any case
    # whether the computed number follows from other figures of the source alone, so that a
    # difference is a contradiction within it
    own_figures: bool = False

    @property
    def published_value(self) -> float:
        """Return the published number; nan where there is none."""
        return float(self.published.lstrip('<~ ')) if self.published else math.nan

    @property
    def is_reproduced(self) -> bool:
        """Return whether both numbers agree within last digit and uncertainty."""
        if self.published.startswith('<'):
            return self.ours + self.uncertainty < self.published_value
        if self.published.startswith('~'):
            return (self.ours * self.published_value > 0.0
                    and round(math.log10(self.ours / self.published_value)) == 0)
        return (abs(self.ours - self.published_value) <= 0.5
                * 10.0 ** -_count_decimals(self.published) * (1.0 + 1e-9) + self.uncertainty)

    @property
    def verdict(self) -> str:
        """Return the result of the comparison; '' where nothing is published."""
        if not self.published:
            return ''
        if self.is_reproduced:
            return 'reproduced'
        return 'contradicts itself' if self.own_figures else 'differs'

    def data(self) -> dict[str, Any]:
        return {**asdict(self), 'verdict': self.verdict}

    def cells(self) -> tuple[str, ...]:
        """Return quantity, unit, place, published, ours and verdict as words for people."""
        ours = _format_rounded(self.ours, self.uncertainty, self.published)
        verdict = '; '.join(filter(None, [': '.join(
            filter(None, [self.verdict, '' if self.is_reproduced else self.why])), self.note]))
        return self.quantity, self.unit, self.place, self.published or '-', ours, verdict


def _format_rounded(ours: float, uncertainty: float, published: str) -> str:
    """Return a number with two digits of its uncertainty, or one digit more than published."""
    if uncertainty:
        digits = max(0, 1 - math.floor(math.log10(uncertainty)))
        return f'{ours:.{digits}f} +- {uncertainty:.{digits}f}'
    if not published or published.startswith('<'):
        return f'{ours:#.4g}' if abs(ours) > 1e-6 else '0'
    digits = _count_decimals(published) + 1 if '.' in published or ours != round(ours) else 0
    return f'{ours:.{digits}f}'


def _count_decimals(number: str) -> int:
    return len(number.partition('.')[2])


def from_own_figures(quantity: str, unit: str, ours: float, published: str, place: str,
                     why: str = '', note: str = '') -> Comparison:
    """Return a comparison of a printed number with the one by other figures of its source."""
    return Comparison(quantity, unit, ours, published, place, why=why, note=note, own_figures=True)


@dataclass(frozen=True)
class Contradiction:
    """A contradiction in a source, shown by computed numbers."""

    numbers: Mapping[str, float]  # by name, in the units of the sentence
    pattern: str  # the sentence, with the numbers' names in braces

    @property
    def sentence(self) -> str:
        return self.pattern.format(**self.numbers)

    def data(self) -> dict[str, Any]:
        return {'sentence': self.sentence, 'numbers': dict(self.numbers)}


@dataclass(frozen=True)
class Reproduction:
    """The reproduction of a source."""

    title: str  # authors, title and year
    assumed: tuple[str, ...]  # what the source does not state and was chosen here, as sentences
    comparisons: tuple[Comparison, ...]
    contradictions: tuple[Contradiction, ...]

    def data(self) -> dict[str, Any]:
        return {'title': self.title, 'assumed': list(self.assumed),
                'comparisons': [each.data() for each in self.comparisons],
                'contradictions': [each.data() for each in self.contradictions]}


_TABLE_HEADER = ('quantity', 'unit', 'where', 'published', 'ours', 'verdict')


def render_page(reproduction: Reproduction) -> str:
    """Return title, assumptions, table and contradictions in Markdown."""
    parts = [f'## {reproduction.title}', _bullet_list('Assumed:', reproduction.assumed),
             _table(reproduction.comparisons), _bullet_list('What does not hold:', [
                 contradiction.sentence for contradiction in reproduction.contradictions])]
    return '\n\n'.join(parts)


def _bullet_list(heading: str, sentences: Iterable[str]) -> str:
    items = [textwrap.fill(sentence, 130, initial_indent='* ', subsequent_indent='  ',
                           break_on_hyphens=False) for sentence in sentences]
    return '\n'.join([heading, '', *items])


def _table(comparisons: Iterable[Comparison]) -> str:
    rows = [_TABLE_HEADER, *(comparison.cells() for comparison in comparisons)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_TABLE_HEADER))]
    lines = ['| ' + ' | '.join(cell.ljust(width) for cell, width in zip(row, widths)) + ' |'
             for row in rows]
    return '\n'.join([lines[0], '|' + '|'.join('-' * (width + 2) for width in widths) + '|',
                      *lines[1:]])
