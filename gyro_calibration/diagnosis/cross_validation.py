# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Gain of the extended model on parts of the logs that are held out of selection and fit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from gyro_calibration.diagnosis.findings import Change, Gain, HeadingCurve
from gyro_calibration.diagnosis.regression import fitted, FittedValues
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.search import relaid, Search, searched
from gyro_calibration.logs.log import Array, Mask
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

#: Window over which heading errors are counted, s.
WINDOW = 60.0
#: Longest window as a share of a held-out part.
WITHIN = 0.75
#: One of so many blocks is held out.
EVERY = 3
#: Least number of samples of a log that remain for the fit.
_FEWEST = 20
#: False-alarm rate of a cause, found in the whole logs, when it is selected without the held-out
#: blocks.
_RATE = 0.01
#: Least number of parts for an interval of the gain.
_FEWEST_PARTS = 2


def gain(search: Search, causes: Collection[str], given: bool) -> Gain | None:
    """
    Hold out every third block, select and fit causes without them, and predict them.

    Parameters
    ----------
    search : of the whole logs
    causes : the named causes and their confounders
    given : whether there is a model; the error before is then that of the model, otherwise that of
        the best bias and scale factor

    Returns
    -------
    the gain; None if the logs are too short, or too few of their samples are used

    """
    replays = search.problem.replays
    length = min(WINDOW, max(each.duration for each in replays) / 6.0)
    held = [held_out(each, length) for each in replays]
    if (not any(out.any() for out in held)
            or any(np.count_nonzero(each.kept & ~out) < _FEWEST
                   for each, out in zip(replays, held))):
        return None
    rest = relaid(search, [_without(each, out) for each, out in zip(replays, held)], causes, _RATE)
    named = searched(rest)
    straight, plain, extended = (
        FittedValues(fitted(rest.problem, some), rest.problem.replays, lasting=True)
        for some in ((), [each for each in named if each.candidate.cause == 'time_offset'], named))
    models = {'given': None, 'straight': straight, 'plain': plain, 'extended': extended}
    squares: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    counts: list[tuple[int, int]] = []
    for run, (each, out) in enumerate(zip(replays, held)):
        left = {name: _left(each, run, found) for name, found in models.items()}
        number = _numbers(each, length)
        for part in (out & (number == place) for place in np.unique(number[out])):
            counts.append((int(np.count_nonzero(part)), 1))
            for name, (of_rate, increments) in left.items():
                turned = float(np.mean(increments[part]) * np.ptp(each.channels.time[part]))
                squares[name].append((float(np.sum(of_rate[part] ** 2)), turned ** 2))
    which = 'the log' if len(replays) == 1 else 'each log'
    return gain_of(f'every third {length:.3g} s of {which}, {len(counts)} parts', squares, counts,
                   'given' if given else 'straight', WINDOW if length >= WINDOW else None)


def gain_of(held_out: str, squares: Mapping[str, ArrayLike], counts: ArrayLike, before: str,
            window: float | None) -> Gain:
    """
    Return the gain on held-out parts.

    Parameters
    ----------
    held_out : description of the parts
    squares : model -> sums of squares of each part: of the rate error, and of the heading error
        over windows, shape (parts, 2)
    counts : numbers of squares in the sums, shape (parts, 2)
    before : the model that the extended one is compared with
    window : s; None if the parts are shorter

    """
    rate, heading = (change_over(np.array([squares[before], squares['extended']])[:, :, k].T,
                                 np.array(counts, float)[:, k]) for k in (0, 1))
    if window is None:
        return Gain(held_out, rate, None, WINDOW)
    whole = np.sum(counts, axis=0)[1]
    return Gain(held_out, rate, heading, window, {
        name: float(np.sqrt(np.sum(each, axis=0)[1] / whole))
        for name, each in squares.items() if name != 'straight'})


def held_out(each: Replay, length: float) -> Mask:
    """Mark the samples that are held out, shape (n,)."""
    number = _numbers(each, length)
    return (each.kept & (number % EVERY == 1)
            & (number < int((each.channels.time[-1] - each.channels.time[0]) / length + 1e-9)))


def _numbers(each: Replay, length: float) -> Array:
    return np.floor((each.channels.time - each.channels.time[0]) / length)


def _without(each: Replay, out: Mask) -> Replay:
    left = (each.kept & ~out)[each.kept]
    place = each.place[left]
    return replace(each, kept=each.kept & ~out, place=place - place[0],
                   filling=each.filling[place[0]:])


def _left(each: Replay, run: int, found: FittedValues | None) -> tuple[Array, Array]:
    """Return the residuals of a log against smooth and measured reference, after a fit if any."""
    added = 0.0 if found is None else found.explains(each, run) + found.biases[run]
    return (each.channels.output - each.channels.rate - added,
            each.channels.output - each.reference - added)


def over_windows(change: Array, time: Array, window: float) -> Array:
    """Return changes over windows, (m,), from changes, (n,), between times, (n + 1,)."""
    whole = np.concatenate([[0.0], np.cumsum(change)])
    later = np.searchsorted(time, time + window - 0.5 * float(np.median(np.diff(time))))
    inside = np.flatnonzero(later < len(time))
    return np.asarray(whole[later[inside]] - whole[inside])


def shares(logs: Sequence[tuple[Mapping[str, Array], Array]],
           own: float = 0.0) -> dict[str, float]:
    """
    Return the share of each cause in the mean square of the heading error over a minute.

    The part of a cause that is proportional to a bias or a scale factor error is counted as these,
    because their refit would absorb it.

    Parameters
    ----------
    logs : for each log, the contributions of causes and of what is 'left' to the change of heading
        between times, rad, shape (n,), and the times, s, shape (n + 1,)
    own : mean square of the errors of the reference, rad²

    """
    over: dict[str, list[Array]] = {name: [] for parts, _ in logs for name in parts}
    for parts, time in logs:
        window = min(WINDOW, WITHIN * float(time[-1] - time[0]))
        # a cause may be in one of the logs
        turned = {name: over_windows(parts.get(name, 0.0 * parts['left']), time, window)
                  for name in over}
        plain = np.column_stack([np.ones(len(turned['left'])), turned['scale_factor_error']])
        for name in over.keys() - {'bias', 'scale_factor_error', 'left'}:
            alike = plain * np.linalg.lstsq(plain, turned[name], rcond=None)[0]
            turned[name] -= alike.sum(axis=1)
            turned['bias'] += alike[:, 0]
            turned['scale_factor_error'] += alike[:, 1]
        for name, each in turned.items():
            over[name].append(each)
    found = {name: np.concatenate(each) for name, each in over.items()}
    total = sum(found.values(), np.zeros(len(found['left'])))
    square = float(np.mean(total ** 2)) if len(total) else 0.0
    if not square > 0.0:
        return {}
    part_of = {name: float(np.mean(part * total)) / square for name, part in found.items()}
    left = part_of.pop('left')
    return {**part_of, 'reference': min(own / square, max(left, 0.0)),
            'left': max(left - own / square, 0.0)}


def heading_curve(parts: Mapping[str, Array], time: Array) -> HeadingCurve:
    """Return the heading error over a log, of all contributions and of the rest (see `shares`)."""
    total = sum(parts.values(), 0.0 * parts['left'])
    before, after = (np.concatenate([[0.0], np.cumsum(each)]) for each in (total, parts['left']))
    return HeadingCurve(time, before, after)


def change_over(squares: Array, count: Array) -> Change:
    """
    Return root mean squares before and after, and the interval of their difference.

    Bootstrap intervals are too narrow for few parts, so the jackknife is used (Tukey 1958): each
    part is left out in turn, and the change has Student's distribution.

    Parameters
    ----------
    squares : sums of squares of each part, before and after, shape (parts, 2)
    count : numbers of squares in the sums, shape (parts,)

    """
    before, after = np.sqrt(squares.sum(axis=0) / count.sum())
    parts = len(count)
    if parts < _FEWEST_PARTS:
        return Change(float(before), float(after), None)
    others = np.sqrt(np.maximum(squares.sum(axis=0) - squares, 0.0)
                     / (count.sum() - count)[:, None])
    deviation = (parts - 1) / np.sqrt(parts) * np.std(others[:, 0] - others[:, 1], ddof=1)
    half = float(student.ppf(0.975, parts - 1) * deviation)
    won = float(before - after)
    return Change(float(before), float(after), (won - half, won + half))
