"""
What the extended model wins, on parts of the logs that took no part in the choice of causes or in the fit.

"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gyro_calibration.diagnosis.field import work
from gyro_calibration.diagnosis.finding import Change, Gain
from gyro_calibration.diagnosis.outcome import Outcome
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.search import Search, relaid, searched
from gyro_calibration.log import Array, Mask

#: The heading is compared over so long, s.
WINDOW = 60.0
#: Of so many blocks one is held out.
EVERY = 3
#: Chance at which a cause is chosen again without what is held out; that it is there was shown by the whole logs.
_RATE = 0.01
#: Times that blocks are drawn anew for an interval.
RESAMPLED = 2000


@dataclass(frozen=True)
class _Block:
    """What is left of one block: sums of squares of the rate's residual, how many, and the heading's; before and after."""

    squares: tuple[float, float]
    count: int
    heading: tuple[float, float]


def gain(search: Search, causes: Collection[str], generator: np.random.Generator) -> Gain | None:
    """
    Hold out every third block, choose again among the causes and fit them without it, and predict what was held out.

    Parameters
    ----------
    search : in the whole logs
    causes : those that were named, and their rivals
    generator : draws blocks for the intervals

    Returns
    -------
    None where the logs are too short to hold anything out

    """
    replays = search.field.replays
    length = min(WINDOW, max(each.duration for each in replays) / 6.0)
    held = [held_out(each, length) for each in replays]
    blocks = []
    trained = [_without(each, out) for each, out in zip(replays, held)]
    if not any(out.any() for out in held) or any(np.count_nonzero(each.kept) < 20 for each in trained):
        return None
    rest = relaid(search, trained, causes, _RATE)
    before, after = (Outcome(work(rest.field, named), rest.field.replays) for named in ((), searched(rest)))
    for run, (each, out) in enumerate(zip(replays, held)):
        left = [_left(each, run, found) for found in (before, after)]
        blocks += [_block(each, left, part) for part in _parts(each, out, length)]
    blocks = [block for block in blocks if block.count]
    words = (f'every third {length:.3g} s of the log' if len(replays) == 1 else f'every third {length:.3g} s of each log')
    heading = _change(np.array([block.heading for block in blocks]) ** 2, np.ones(len(blocks)), generator) if length >= WINDOW else None
    return Gain(f'{words}, {len(blocks)} parts', _change(np.array([block.squares for block in blocks]),
                                                         np.array([block.count for block in blocks], float), generator), heading, WINDOW)


def held_out(each: Replay, length: float) -> Mask:
    """Mark the samples that are held out, shape (n,)."""
    time = each.channels.time - each.channels.time[0]
    number = np.floor(time / length).astype(int)
    return (number % EVERY == 1) & (number < int(time[-1] / length + 1e-9))


def _without(each: Replay, out: Mask) -> Replay:
    left = (each.kept & ~out)[each.kept]
    place = each.place[left]
    return replace(each, kept=each.kept & ~out, place=place - place[0], filling=each.filling[place[0]:])


def _left(each: Replay, run: int, found: Outcome) -> tuple[Array, Array]:
    """Return what is left of rate and of increments of the heading in a whole log."""
    added = found.explains(each, run) + found.biases[run]
    return each.channels.output - each.channels.rate - added, each.channels.output - each.reference - added


def _parts(each: Replay, out: Mask, length: float) -> list[Mask]:
    number = np.floor((each.channels.time - each.channels.time[0]) / length).astype(int)
    return [out & each.kept & (number == block) for block in np.unique(number[out])]


def _block(each: Replay, left: Sequence[tuple[Array, Array]], part: Mask) -> _Block:
    squares = tuple(float(np.sum(rate[part] ** 2)) for rate, _ in left)
    heading = tuple(float(np.mean(increments[part]) * np.ptp(each.channels.time[part])) if part.any() else 0.0 for _, increments in left)
    return _Block((squares[0], squares[1]), int(np.count_nonzero(part)), (heading[0], heading[1]))


def _change(squares: Array, count: Array, generator: np.random.Generator) -> Change:
    """Return root mean squares before and after, from sums of squares, shape (blocks, 2), and the interval of their difference."""
    before, after = np.sqrt(squares.sum(axis=0) / count.sum())
    drawn = generator.integers(len(count), size=(RESAMPLED, len(count)))
    each = np.sqrt(squares[drawn].sum(axis=1) / count[drawn].sum(axis=1)[:, None])
    low, high = np.quantile(each[:, 0] - each[:, 1], [0.025, 0.975])
    return Change(float(before), float(after), (float(low), float(high)))
