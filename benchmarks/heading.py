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
Compare heading errors after 20 s of calibration: this program, its peers, the paper and bounds.

    python benchmarks/heading.py [--drives N] [--gyros NAME ...] [--courses TEXT] [--only TEXT]
                                 [--part drives slow] [--processes 2] [--seed N]

The gyros and courses are those of `drives`: the built-in motion `robot`, and random drives of 160
s and 30 min with turns, slow turns, wobble on straight lines, rests, and rests too short to
detect; in about half of the time the robot rests or goes straight. Each drive has noise of its
own. It begins with the built-in motion `calibration`, which all rows use; a refused calibration is
run again, as a robot would.

The first table has the mean over the drives of a drive's mean absolute heading error, and its
standard error; the second the error that 95 % of the samples keep; the third how often the heading
is inside of its own 95 %: at the end of a drive, at a random time, and of all samples. The
settings of the peers (`peers`) are the published ones, and the best on drives of their own.

Slow turns: the share of a turn of ten minutes, after a rest of 30 s, that is missing or in excess
at its end.

`--only` selects the rows whose names match a regular expression, `--courses` courses alike. The
row of a missing package says so. Prints tables in Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing import get_context
import re

import bounds
from drives import Course, COURSES, Drive, GYROS, simulate, slow_path
from gyro_calibration.calibration.self_calibration import (
    fit_heading, self_calibrate, to_model_record)
from gyro_calibration.heading.integration import integrate, Threshold, ThresholdFilter
from gyro_calibration.heading.log_compensation import smooth_track
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.compensation import rate_sensitivity, uncertainty_covariance
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.motion import CALIBRATION_MOTION
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.presets import Preset
import numpy as np
from peers import PEERS, tuned

#: The variance is looked at so often, s.
LOOK = 1.0
#: Of each normal error squared over its variance, 95 % are below this.
BAND = 3.841
#: Drives on which the settings of the peers are found.
TUNING = {160.0: 40, 1800.0: 8}
PUBLISHED, WINDOWED = Threshold(0.3 * DEGREE, 0.0), Threshold(0.3 * DEGREE, 0.2)
SLOW = (0.02, 0.05, 0.1, 0.3, 1.0)


@dataclass(frozen=True, eq=False)
class Known:
    """A drive with its calibrations: by the likelihood, and by eq. 7 of Hong and Park."""

    drive: Drive
    likely: SelfCalibration
    published: SelfCalibration


@dataclass(frozen=True)
class Estimate:
    """Headings of all samples, rad, and variances every `LOOK` s, rad², or None."""

    heading: Array
    variance: Array | None = None


def known(gyro: Preset, course: Course, generator: np.random.Generator) -> Known:
    """Simulate a drive and calibrate; a calibration that is refused is run again."""
    while True:
        drive = simulate(gyro, course, generator)
        try:
            likely = self_calibrate(*drive.run, CALIBRATION_MOTION, noise=gyro.model.noise)
        except DataRefused:
            continue
        return Known(
            drive, to_model_record(likely, 'likelihood', '', None),
            to_model_record(fit_heading(*drive.run, CALIBRATION_MOTION), 'heading', '', None))


# Rows

Row = Callable[[Known], 'Estimate | None']


def _integrated(calibration: str, threshold: Threshold | None, known: Known) -> Estimate:
    """Return the integral of rates: of the paper, or of its parts put right."""
    time, rate = known.drive.time, known.drive.output
    if calibration:
        rate = getattr(known, calibration).correct(rate)
    return Estimate(integrate(time, rate if threshold is None
                              else ThresholdFilter(threshold).apply_to_all(time, rate)))


@lru_cache(1)
def _tracked(known: Known, factor: float = 1.0, wheels: bool = False) -> tuple[Estimate, Estimate]:
    """Return what this program makes of a drive, live and with hindsight, told this noise."""
    drive, model = known.drive, GyroModel(self_calibration=known.likely)
    noise = Noise(*(factor * figure for figure in vars(drive.gyro.model.noise).values()))
    rate = np.asarray(known.likely.correct(drive.output))
    sensitivity, still = (rate_sensitivity(model, drive.output, value, 25.0)
                          for value in (rate, 0.0))
    tracker = HeadingTracker(noise, uncertainty_covariance(model), TrackerSettings(),
                             keeps_steps=True)
    heading, variance, *_ = tracker.follow(
        drive.time, rate, np.ascontiguousarray(sensitivity.T),
        drive.moving.tolist() if wheels else None, still).T
    later, with_hindsight, _ = smooth_track(tracker, drive.time, rate)
    looks = _looks(drive)
    return Estimate(heading, variance[looks]), Estimate(later, with_hindsight[looks])


def _looks(drive: Drive) -> np.ndarray:
    """Return the samples at which the variance is looked at; the last is the end."""
    every = round(LOOK / drive.gyro.interval)
    return np.arange((len(drive.time) - 1) % every, len(drive.time), every)


@lru_cache(1)
def _given_rests(known: Known) -> list[Estimate]:
    """Return the bounds of who is told the rests, live and with hindsight."""
    looks = _looks(known.drive)
    return [Estimate(heading, variance[looks])
            for heading, variance in bounds.knows_rests(known.drive)]


def _by_peer(name: str, settings: Mapping[str, float] | None, known: Known) -> Estimate | None:
    """Return the heading by a peer with settings, or the published ones; None without it."""
    peer = PEERS[name]
    return Estimate(peer.run(known.drive, known.likely, peer.published if settings is None
                             else settings)) if peer.installed else None


def rows(settings: Mapping[str, Mapping[str, float]]) -> dict[str, Row]:
    """Return what makes the rows, by their names, with the best settings of peers."""
    found: dict[str, Row] = {
        name: partial(_integrated, *given) for name, given in {
            'pure integration': ('', None), 'self-calibration by eq. 7': ('published', None),
            'threshold as published': ('', PUBLISHED),
            'both as published': ('published', PUBLISHED),
            'eq. 7, threshold on 0.2 s': ('published', WINDOWED), 'likelihood': ('likely', None),
            'likelihood, threshold on 0.2 s': ('likely', WINDOWED)}.items()}
    ways = list(enumerate(('live', 'with hindsight')))
    for words, told in (('', (1.0,)), (' given half the noise', (0.5,)),
                        (' given twice the noise', (2.0,)), (' with wheels', (1.0, True))):
        found |= {f'this program{words}, {way}': lambda known, told=told, place=place: _tracked(
            known, *told)[place] for place, way in ways}
    for name, best in settings.items():
        found |= {f'{name}, as published': partial(_by_peer, name, None),
                  f'{name}, best settings': partial(_by_peer, name, best)}
    found |= {f'given the rests, {way}': lambda known, place=place: _given_rests(known)[place]
              for place, way in ways}
    return found | {
        'knows s and b(t)': lambda known: Estimate(bounds.knows_errors(known.drive)),
        'knows s, b(t) and the rests': lambda known: Estimate(
            bounds.knows_errors_and_rests(known.drive))}


# Scores

@dataclass(frozen=True)
class Score:
    """Accuracy of a heading over a drive."""

    mean: float  # absolute error, rad
    errors: Array  # absolute, at some times, rad
    #: Share inside the 95 % at the end, a random time and all looks; nan without a variance.
    inside: tuple[float, float, float]


def score(drive: Drive, estimate: Estimate, generator: np.random.Generator) -> Score:
    """Return how good a heading was."""
    error = estimate.heading - drive.heading
    spread = np.linspace(0, len(error) - 1, 100).astype(int)
    inside = (np.nan, np.nan, np.nan)
    if estimate.variance is not None:
        inner = error[_looks(drive)] ** 2 <= BAND * estimate.variance
        inside = (float(inner[-1]), float(inner[generator.integers(len(inner))]),
                  float(inner.mean()))
    return Score(float(np.abs(error).mean()), np.abs(error[spread]), inside)


def scores(job: tuple[str, str, int, int, str,
                      Mapping[str, Mapping[str, float]]]) -> dict[str, Score]:
    gyro, course, number, seed, only, settings = job
    generator = np.random.default_rng([seed, number, *gyro.encode(), *course.encode()])
    drive = known(GYROS[gyro], COURSES[course], generator)
    return {name: score(drive.drive, estimate, generator) for name, row in rows(settings).items()
            if re.search(only, name) and (estimate := row(drive)) is not None}


def tune(job: tuple[str, str, str, int]) -> Mapping[str, float]:
    """Return the best settings of a peer, on drives of its own."""
    peer, gyro, course, seed = job
    generator = np.random.default_rng([seed, *b'settings', *gyro.encode(), *course.encode()])
    if not PEERS[peer].installed:
        return {}
    count = TUNING[1800.0 if '30 min' in course else 160.0]
    several = [known(GYROS[gyro], COURSES[course], generator) for _ in range(count)]
    return tuned(PEERS[peer], [(each.drive, each.likely) for each in several])


# Tables

Columns = Mapping[tuple[str, str], Sequence[Mapping[str, Score]]]


def table(columns: Columns, names: Iterable[str], cell: Callable[[Sequence[Score]], str],
          title: str) -> str:
    heads = [f'{gyro}, {course}' for gyro, course in columns]
    lines = [f'| {title} | {" | ".join(heads)} |', f'|:---|{"---:|" * len(heads)}']
    for name in names:
        several = [[drive[name] for drive in drives if name in drive]
                   for drives in columns.values()]
        cells = [cell(each) if each else 'not installed' for each in several]
        if any(cells):
            lines.append(f'| {name} | {" | ".join(cells)} |')
    return '\n'.join(lines)


def mean_error(several: Sequence[Score]) -> str:
    means = np.array([each.mean for each in several]) / DEGREE
    return f'{means.mean():.3f} ± {means.std(ddof=1) / np.sqrt(len(means)):.3f}'


def error_of_most(several: Sequence[Score]) -> str:
    return f'{np.quantile(np.concatenate([each.errors for each in several]), 0.95) / DEGREE:.3f}'


def inside(several: Sequence[Score]) -> str:
    shares = 100.0 * np.mean([each.inside for each in several], axis=0)
    return '' if np.isnan(shares).any() else ' / '.join(f'{share:.1f}' for share in shares)


def drives_tables(given: argparse.Namespace) -> Iterator[str]:
    """Yield the tables of the drives, and the settings of the peers."""
    places = [(gyro, course) for gyro in given.gyros
              for course in COURSES if re.search(given.courses, course)]
    wanted = [peer for peer in PEERS if re.search(given.only, f'{peer}, best settings')
              or re.search(given.only, f'{peer}, as published')]
    with get_context('fork').Pool(given.processes) as pool:
        tunings = [(peer, *place, given.seed) for place in places for peer in wanted]
        best: dict[tuple[str, str],
                   dict[str, Mapping[str, float]]] = {place: {} for place in places}
        for (peer, *place, _), found in zip(tunings, pool.map(tune, tunings, chunksize=1)):
            best[place[0], place[1]][peer] = found
        jobs = [(*place, number, given.seed, given.only, best[place]) for place in places
                for number in range(given.drives)]
        found_scores = pool.map(scores, jobs, chunksize=1)
    columns = {place: found_scores[given.drives * index:given.drives * (index + 1)]
               for index, place in enumerate(places)}
    names = [name for name in rows({peer: {} for peer in wanted}) if re.search(given.only, name)]
    yield table(columns, names, mean_error, f'mean error, deg, {given.drives} drives')
    yield table(columns, names, error_of_most, '95 % of the errors are below, deg')
    yield table(columns, names, inside,
                'inside of its 95 %: at the end / at a random time / of all samples, %')
    yield '\n'.join(f'* {gyro}, {course}: {peer}: {settings}'
                    for (gyro, course), each in best.items() for peer, settings in each.items())


# Slow turns

def slow_errors(job: tuple[str, float, int, int,
                           Mapping[str, Mapping[str, float]]]) -> dict[str, float]:
    """Return the error at the end of a slow turn as a share of the turn."""
    gyro, rate, number, seed, settings = job
    generator = np.random.default_rng([seed, number, round(1e6 * rate), *gyro.encode()])
    one = known(GYROS[gyro], Course(partial(slow_path, rate * DEGREE)), generator)
    made = rows(settings)
    return {name: abs((estimate.heading[-1] / one.drive.heading[-1]) - 1.0)
            for name in SLOW_ROWS if (estimate := made[name](one)) is not None}


SLOW_ROWS = ('likelihood', 'likelihood, threshold on 0.2 s', 'this program, live',
             'this program with wheels, live',
             *(f'{peer}, {which}' for peer in ('VQF', 'x-io Fusion')
               for which in ('as published', 'best settings')))


def slow_table(given: argparse.Namespace) -> str:
    """Return the table of slow turns; peers have the best settings for random drives of 30 min."""
    peers = ('VQF', 'x-io Fusion')
    lines = [f'| mean error of a turn of 10 min, % of the turn, {given.slow_drives} drives | '
             + ' | '.join(f'{gyro}, {rate:g} deg/s' for gyro in given.gyros for rate in SLOW)
             + ' |', '|:---|' + '---:|' * (len(SLOW) * len(given.gyros))]
    with get_context('fork').Pool(given.processes) as pool:
        tunings = [(peer, gyro, 'random, 30 min', given.seed) for gyro in given.gyros
                   for peer in peers]
        best: dict[str, dict[str, Mapping[str, float]]] = {gyro: {} for gyro in given.gyros}
        for (peer, gyro, *_), settings in zip(tunings, pool.map(tune, tunings, chunksize=1)):
            best[gyro][peer] = settings
        jobs = [(gyro, rate, number, given.seed, best[gyro])
                for gyro in given.gyros for rate in SLOW for number in range(given.slow_drives)]
        errors = pool.map(slow_errors, jobs, chunksize=1)
    for row in SLOW_ROWS:
        cells = [[each[row] for each in errors[begin:begin + given.slow_drives] if row in each]
                 for begin in range(0, len(jobs), given.slow_drives)]
        lines.append(f'| {row} | ' + ' | '.join(f'{100.0 * np.mean(cell):.1f}' if cell
                                                else 'not installed' for cell in cells) + ' |')
    return '\n'.join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--drives', type=int, default=200, help='of each gyro and course')
    parser.add_argument('--slow-drives', type=int, default=50, help='of each gyro and slow rate')
    parser.add_argument('--gyros', nargs='+', choices=list(GYROS), default=list(GYROS))
    parser.add_argument('--courses', default='',
                        help='in whose names this regular expression is found')
    parser.add_argument('--only', default='',
                        help='rows in whose names this regular expression is found')
    parser.add_argument('--part', nargs='+', choices=['drives', 'slow'],
                        default=['drives', 'slow'])
    parser.add_argument('--processes', type=int, default=2)
    parser.add_argument('--seed', type=int, default=0)
    given = parser.parse_args()
    if 'drives' in given.part:
        for text in drives_tables(given):
            print(text, flush=True, end='\n\n')
    if 'slow' in given.part:
        print(slow_table(given))


if __name__ == '__main__':
    main()
