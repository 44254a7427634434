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
from gyro_calibration.diagnosis.regression import fit_causes, FittedValues
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.search import restrict_search, Search, search_causes
from gyro_calibration.logs.log import Array, Mask
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

#: Window over which heading errors are counted, s.
HEADING_WINDOW = 60.0
#: Longest window as a share of a held-out part.
MAX_WINDOW_SHARE = 0.75
#: One of so many blocks is held out.
HELD_OUT_STRIDE = 3
#: Least number of samples of a log that remain for the fit.
_MIN_SAMPLES = 20
#: False-alarm rate of a cause, found in the whole logs, when it is selected without the held-out
#: blocks.
_REPEATED_ALARM_RATE = 0.01
#: Least number of parts for an interval of the gain.
_MIN_PARTS = 2


def measure_gain(search: Search, causes: Collection[str], has_model: bool) -> Gain | None:
    """
    Hold out every third block, select and fit causes without them, and predict them.

    Parameters
    ----------
    search : of the whole logs
    causes : the named causes and their confounders
    has_model : whether there is a model; the error before is then that of the model, otherwise
        that of the best bias and scale factor

    Returns
    -------
    the gain; None if the logs are too short, or too few of their samples are used

    """
    replays = search.problem.replays
    length = min(HEADING_WINDOW, max(each.duration for each in replays) / 6.0)
    held_out_masks = [held_out_mask(each, length) for each in replays]
    if (not any(out.any() for out in held_out_masks)
            or any(np.count_nonzero(each.valid & ~out) < _MIN_SAMPLES
                   for each, out in zip(replays, held_out_masks))):
        return None
    reduced_search = restrict_search(
        search, [_drop_samples(each, out) for each, out in zip(replays, held_out_masks)], causes,
        _REPEATED_ALARM_RATE)
    named = search_causes(reduced_search)
    straight, plain, extended = (
        FittedValues(fit_causes(reduced_search.problem, some), reduced_search.problem.replays,
                     lasting_only=True)
        for some in ((), [each for each in named if each.candidate.cause == 'time_offset'], named))
    models = {'given': None, 'straight': straight, 'plain': plain, 'extended': extended}
    squares: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    counts: list[tuple[int, int]] = []
    for run, (each, out) in enumerate(zip(replays, held_out_masks)):
        left = {name: _rate_residuals(each, run, found) for name, found in models.items()}
        number = _block_numbers(each, length)
        for part in (out & (number == place) for place in np.unique(number[out])):
            counts.append((int(np.count_nonzero(part)), 1))
            for name, (of_rate, increments) in left.items():
                turned = float(np.mean(increments[part]) * np.ptp(each.channels.time[part]))
                squares[name].append((float(np.sum(of_rate[part] ** 2)), turned ** 2))
    which = 'the log' if len(replays) == 1 else 'each log'
    return gain_from_squares(f'every third {length:.3g} s of {which}, {len(counts)} '
                             'parts', squares, counts, 'given' if has_model else 'straight',
                             HEADING_WINDOW if length >= HEADING_WINDOW else None)


def gain_from_squares(held_out: str, squares: Mapping[str, ArrayLike], counts: ArrayLike,
                      before: str, window: float | None) -> Gain:
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
    rate, heading = (jackknife_change(np.array([squares[before], squares['extended']])[:, :, k].T,
                                      np.array(counts, float)[:, k]) for k in (0, 1))
    if window is None:
        return Gain(held_out, rate, None, HEADING_WINDOW)
    whole = np.sum(counts, axis=0)[1]
    return Gain(held_out, rate, heading, window,
                {name: float(np.sqrt(np.sum(each, axis=0)[1] / whole))
                 for name, each in squares.items() if name != 'straight'})


def held_out_mask(replay: Replay, block_duration: float) -> Mask:
    """Mark the samples that are held out, shape (n,)."""
    number, time = _block_numbers(replay, block_duration), replay.channels.time
    count = int((time[-1] - time[0]) / block_duration + 1e-9)
    return replay.valid & (number % HELD_OUT_STRIDE == 1) & (number < count)


def _block_numbers(replay: Replay, block_duration: float) -> Array:
    return np.floor((replay.channels.time - replay.channels.time[0]) / block_duration)


def _drop_samples(replay: Replay, dropped: Mask) -> Replay:
    left = (replay.valid & ~dropped)[replay.valid]
    place = replay.grid_index[left]
    return replace(replay, valid=replay.valid & ~dropped, grid_index=place - place[0],
                   fill_noise=replay.fill_noise[place[0]:])


def _rate_residuals(replay: Replay, log_index: int,
                    fit: FittedValues | None) -> tuple[Array, Array]:
    """Return the residuals of a log against smooth and measured reference, after a fit if any."""
    added = (0.0 if fit is None
             else fit.total_contribution(replay, log_index) + fit.biases[log_index])
    return (replay.channels.output - replay.channels.rate - added,
            replay.channels.output - replay.reference - added)


def window_changes(changes: Array, time: Array, window: float) -> Array:
    """Return changes over windows, (m,), from changes, (n,), between times, (n + 1,)."""
    whole = np.concatenate([[0.0], np.cumsum(changes)])
    later = np.searchsorted(time, time + window - 0.5 * float(np.median(np.diff(time))))
    inside = np.flatnonzero(later < len(time))
    return np.asarray(whole[later[inside]] - whole[inside])


def heading_error_shares(logs: Sequence[tuple[Mapping[str, Array], Array]],
                         reference_square: float = 0.0) -> dict[str, float]:
    """
    Return the share of each cause in the mean square of the heading error over a minute.

    The part of a cause that is proportional to a bias or a scale factor error is counted as these,
    because their refit would absorb it.

    Parameters
    ----------
    logs : for each log, the contributions of causes and of what is 'left' to the change of heading
        between times, rad, shape (n,), and the times, s, shape (n + 1,)
    reference_square : mean square of the errors of the reference, rad²

    """
    window_errors: dict[str, list[Array]] = {name: [] for parts, _ in logs for name in parts}
    for parts, time in logs:
        window = min(HEADING_WINDOW, MAX_WINDOW_SHARE * float(time[-1] - time[0]))
        # a cause may be in one of the logs
        turned = {name: window_changes(parts.get(name, 0.0 * parts['left']), time, window)
                  for name in window_errors}
        plain = np.column_stack([np.ones(len(turned['left'])), turned['scale_factor_error']])
        for name in window_errors.keys() - {'bias', 'scale_factor_error', 'left'}:
            plain_part = plain * np.linalg.lstsq(plain, turned[name], rcond=None)[0]
            turned[name] -= plain_part.sum(axis=1)
            turned['bias'] += plain_part[:, 0]
            turned['scale_factor_error'] += plain_part[:, 1]
        for name, each in turned.items():
            window_errors[name].append(each)
    found = {name: np.concatenate(each) for name, each in window_errors.items()}
    total = sum(found.values(), np.zeros(len(found['left'])))
    square = float(np.mean(total ** 2)) if len(total) else 0.0
    if not square > 0.0:
        return {}
    part_of = {name: float(np.mean(part * total)) / square for name, part in found.items()}
    left = part_of.pop('left')
    return {**part_of, 'reference': min(reference_square / square, max(left, 0.0)),
            'left': max(left - reference_square / square, 0.0)}


def heading_curve(parts: Mapping[str, Array], time: Array) -> HeadingCurve:
    """Return the heading error of a log and its rest, as `heading_error_shares` splits it."""
    total = sum(parts.values(), 0.0 * parts['left'])
    before, after = (np.concatenate([[0.0], np.cumsum(each)]) for each in (total, parts['left']))
    return HeadingCurve(time, before, after)


def jackknife_change(square_sums: Array, counts: Array) -> Change:
    """
    Return root mean squares before and after, and the interval of their difference.

    Bootstrap intervals are too narrow for few parts, so the jackknife is used (Tukey 1958): each
    part is left out in turn, and the change has Student's distribution.

    Parameters
    ----------
    square_sums : sums of squares of each part, before and after, shape (parts, 2)
    counts : numbers of squares in the sums, shape (parts,)

    """
    before, after = np.sqrt(square_sums.sum(axis=0) / counts.sum())
    parts = len(counts)
    if parts < _MIN_PARTS:
        return Change(float(before), float(after), None)
    others = np.sqrt(
        np.maximum(square_sums.sum(axis=0) - square_sums, 0.0) / (counts.sum() - counts)[:, None])
    deviation = (parts - 1) / np.sqrt(parts) * np.std(others[:, 0] - others[:, 1], ddof=1)
    half = float(student.ppf(0.975, parts - 1) * deviation)
    won = float(before - after)
    return Change(float(before), float(after), (won - half, won + half))
