"""
The sources worked through again: each number is what a small computation of its own gives, and verdicts can fail.

"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gyro_calibration.command_line import main
from gyro_calibration.reproduction import SOURCES
from gyro_calibration.reproduction.finding import Comparison

RUNS = 10  # instead of 200; the page of the documents has all


@cache
def reproduced(source):
    """Return what a source gives with few runs."""
    return SOURCES[source](np.random.default_rng(0), RUNS)


def row(source, quantity):
    """Return the comparison of that name."""
    found = [each for each in reproduced(source).comparisons if each.quantity == quantity]
    assert len(found) == 1, [each.quantity for each in reproduced(source).comparisons]
    return found[0]


@pytest.mark.parametrize('published, ours, verdict', [
    ('4.8', 4.849, 'reproduced'), ('4.8', 4.851, 'differs'), ('< 2', 1.9, 'reproduced'), ('< 2', 2.1, 'differs'),
    ('~ 10', 30.0, 'reproduced'), ('~ 10', 33.0, 'differs'), ('~ 10', -10.0, 'differs'), ('', 1.0, ''),
])
def test_a_verdict_is_what_the_last_digit_allows(published, ours, verdict):
    assert Comparison('', '', ours, published).verdict == verdict
    if verdict == 'differs':
        assert Comparison('', '', ours, published, own_figures=True).verdict == 'contradicts itself'


def test_the_uncertainty_of_ours_counts():
    assert Comparison('', '', 5.0, '4.8', uncertainty=0.2).agrees and not Comparison('', '', 5.0, '4.8', uncertainty=0.1).agrees
    assert not Comparison('', '', 1.9, '< 2', uncertainty=0.2).agrees


@pytest.mark.parametrize('source', SOURCES)
def test_a_wrong_published_value_does_not_come_out(source):
    wrong = [replace(each, published=f'{3.0 * each.value + 7.0:.3f}') for each in reproduced(source).comparisons
             if each.verdict == 'reproduced' and each.published[0] not in '<~']
    assert len(wrong) > 2 and not [each for each in wrong if each.agrees]


@pytest.mark.parametrize('source', SOURCES)
def test_the_same_seed_gives_the_same_numbers(source):
    assert SOURCES[source](np.random.default_rng(0), RUNS) == reproduced(source)


@pytest.mark.parametrize('source', SOURCES)
def test_every_number_of_a_contradiction_is_in_its_sentence(source):
    for contradiction in reproduced(source).contradictions:
        assert all(np.isfinite(value) for value in contradiction.numbers.values())
        assert not [name for name in contradiction.numbers if f'{{{name}:' not in contradiction.pattern], contradiction.pattern


def test_the_verb_prints_one_object_with_all_sources(capsys, monkeypatch):
    monkeypatch.setattr('gyro_calibration.verbs.reproduce.SOURCES', {'hong_park': lambda *_, **__: reproduced('hong_park')})
    assert main(['reproduce', '--json']) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer['sources']['hong_park']['comparisons'][0]['verdict'] == 'reproduced' and answer['seed'] == 0
