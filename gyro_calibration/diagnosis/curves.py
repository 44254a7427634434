"""
The residual along each variable, for people to see: by the simulation as it was, and as extended.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from gyro_calibration.allan import allan_deviation
from gyro_calibration.diagnosis.finding import Curve, HeadingCurve, NoiseCurve
from gyro_calibration.diagnosis.outcome import Outcome, joined
from gyro_calibration.diagnosis.replay import Replay, white_deviation
from gyro_calibration.log import Array
from gyro_calibration.noise import Noise

#: Bins of a curve, and points of a line over time.
BINS, POINTS = 40, 600
#: Samples of which the Allan deviation is taken.
_ALLAN_SAMPLES = 1 << 18


def curves(before: Outcome, after: Outcome) -> list[Curve]:
    """Return the mean residual in bins of each variable that changes in the logs."""
    replays = before.replays
    kept = [each.kept for each in replays]
    left = [joined([residual[mask] - bias for residual, mask, bias in zip(found.residuals, kept, found.biases)])
            for found in (before, after)]
    white = joined([np.full(int(mask.sum()), white_deviation(residual[mask])) for residual, mask in zip(after.residuals, kept)])
    added = joined([each.added[mask] + bias for each, mask, bias in zip(replays, kept, before.biases)])
    found = [_curve(name, unit, joined([of(each)[each.kept] for each in replays]), left, white, added)
             for name, unit, of in _variables(replays)]
    return [each for each in found if len(each.at) > 1] + [_spectrum(before, after)]


def _variables(replays: Sequence[Replay]) -> Iterator[tuple[str, str, Callable[[Replay], Array]]]:
    has = frozenset.intersection(*(each.has for each in replays))
    """Give name, unit, and what takes it from a log."""
    yield 'time', 's', lambda each: each.channels.time - each.channels.time[0]
    if any(np.ptp(each.channels.rate) > 0.0 for each in replays):
        yield 'rate', 'rad/s', lambda each: each.channels.rate
        yield 'rate_change', 'rad/s²', lambda each: np.gradient(each.channels.rate, each.channels.time)
        yield 'heading', 'rad', lambda each: np.mod(each.channels.heading, 2.0 * np.pi)
    if 'temperature' in has:
        yield 'temperature', 'degC', lambda each: each.channels.temperature
        yield 'temperature_rate', 'K/s', lambda each: (each.channels.temperature - each.lagged('temperature', 10.0)) / 10.0
    if 'specific_force' in has:
        yield 'specific_force', 'm/s²', lambda each: each.channels.specific_force
        yield 'vibration', '(m/s²)²', lambda each: each.lagged('vibration', 1.0)
    if 'supply' in has:
        yield 'supply', 'V', lambda each: np.asarray(each.channels.supply)


def _curve(name: str, unit: str, at: Array, left: Sequence[Array], white: Array, added: Array) -> Curve:
    """Bin by even steps between the quantiles that hold nearly all, and leave out bins with few samples."""
    low, high = np.quantile(at, [0.001, 0.999])
    if not high > low:
        return Curve(name, unit, *(np.empty(0) for _ in range(5)))
    place = np.clip(((at - low) / (high - low) * BINS).astype(int), 0, BINS - 1)
    count = np.bincount(place, minlength=BINS)
    enough = count > 9

    def mean(values: Array) -> Array:
        return np.bincount(place, values, BINS)[enough] / count[enough]

    return Curve(name, unit, mean(at), mean(left[0]), mean(left[1]), np.sqrt(mean(white ** 2) / count[enough]), mean(added))


def _spectrum(before: Outcome, after: Outcome) -> Curve:
    """Return the largest amplitude of the first log's residual in bins of frequency."""
    each = before.replays[0]
    series = [each.on_grid(found.residuals[0] - found.biases[0]) for found in (before, after)]
    amplitude = [np.sqrt(2.0) * np.abs(np.fft.rfft(values))[1:] * np.sqrt(2.0) / len(values) for values in series]
    frequency = np.fft.rfftfreq(len(series[0]), each.step)[1:]
    edges = np.unique(np.searchsorted(frequency, np.geomspace(frequency[0], frequency[-1], BINS + 1)))[:-1]
    largest = [np.maximum.reduceat(values, edges) for values in amplitude]
    middle = np.sqrt(frequency[edges] * frequency[np.append(edges[1:], len(frequency)) - 1])
    usual = np.sqrt(np.add.reduceat(amplitude[1] ** 2, edges) / np.diff(np.append(edges, len(frequency))))
    return Curve('frequency', 'Hz', middle, largest[0], largest[1], usual, np.zeros(len(middle)))


def heading_curve(before: Outcome, after: Outcome) -> HeadingCurve:
    """Return what the heading of the first log is wrong by, if the simulation is believed."""
    each = before.replays[0]
    lines = [np.cumsum(each.on_grid(found.residuals[0] - found.biases[0])) * each.step for found in (before, after)]
    some = np.unique(np.linspace(0, each.points - 1, POINTS).astype(int))
    return HeadingCurve(some * each.step, lines[0][some], lines[1][some])


def noise_curve(after: Outcome, fitted: Noise, expected: Noise) -> NoiseCurve:
    """Return the Allan deviation of what is left of the first log, and of the noise that was fitted and simulated."""
    each = after.replays[0]
    chart = allan_deviation(each.on_grid(after.residuals[0])[:_ALLAN_SAMPLES], each.step)
    times = chart.time
    return NoiseCurve(times, chart.deviation, np.sqrt(fitted.allan_variance(times)),
                      np.sqrt(expected.allan_variance(times)) if expected.angle_random_walk else None)
