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
Faults of single samples of an output.

Codes are the values of a digital output, with their step, the dead band about zero, and the limit.
Repeated samples have the value of the sample before, more often than coarse codes explain.
Outliers are samples far from their neighbours that motion does not explain.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

from gyro_calibration.diagnosis.expected_output import bridge_gaps, OutputComparison
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.logs.quality import find_runs, QuantizationCodes
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import stats
from scipy.ndimage import maximum_filter1d
from scipy.special import ndtr

#: Neighbouring codes with which the count of the extreme code is compared: their number, and their
#: range as a share of the white noise, whichever is larger.
_NEIGHBOUR_CODES, _NEIGHBOUR_NOISE_SHARE = 4, 0.05
#: Step of codes, as a share of the white noise, below which codes hardly repeat by chance.
_FINE_STEP_NOISE_RATIO = 0.1
#: Least number of separate runs of an extreme code, which a repetition fault does not cause.
_MIN_LIMIT_RUNS = 3
#: Output of a rest, as a share of the largest; a limit is higher, and a dead band is lower.
_REST_RATE_SHARE = 0.1
#: Largest ratio of relative steps of values that are printed with the same number of digits.
_MAX_DIGIT_STEP_RATIO = 10.0
#: Least half-width of a dead band in steps of codes.
_MIN_DEAD_BAND_STEPS = 1.5
#: Margin of a dead band for the expected output, in standard deviations.
_DEAD_BAND_MARGIN_SIGMAS = 2.0


def local_code_steps(codes: QuantizationCodes, output: Array) -> Array:
    """
    Return an upper bound of the step of codes near each value, shape (n,).

    Steps grow with the values of 32-bit floats and of decimals with a number of significant
    digits; or they are too small to be determined. They are at most the smallest gap between
    values of the same size or larger, and at most that usual for the smallest relative step.

    """
    steps = np.full(len(output), max(
        codes.step, float(np.diff(codes.values).min()) if len(codes.values) > 1 else 1.0))
    sides = {sign: np.sort(sign * codes.values[sign * codes.values >= 0.0])
             for sign in (1.0, -1.0)}
    finest = min(float((np.diff(sizes) / sizes[1:]).min(initial=np.inf))
                 for sizes in sides.values())
    for sign, sizes in sides.items():
        if len(sizes) > 1:
            side = sign * output >= 0.0
            closest = np.minimum.accumulate(np.diff(sizes)[::-1])[::-1]
            place = np.minimum(np.searchsorted(sizes, sign * output[side]), len(closest) - 1)
            steps[side] = np.maximum(
                steps[side],
                np.minimum(closest[place], _MAX_DIGIT_STEP_RATIO * finest * np.abs(output[side])))
    return steps


@dataclass(frozen=True)
class DeadBand:
    """
    A frequent value without other values near it.

    Attributes
    ----------
    value : rad/s
    half_width : distance of the nearest other value, rad/s

    """

    value: float
    half_width: float

    def contains(self, output: Array) -> Mask:
        """Mark the samples in it."""
        return np.abs(output - self.value) < 0.5 * self.half_width

    def membership_chance(self, comparison: OutputComparison) -> Array:
        """Return the chance of each sample to be in it, by its expected output, or by a rest."""
        rest = (np.full(len(comparison.output), np.median(comparison.output))
                if comparison.expected is None else comparison.expected)
        off = np.nan_to_num(rest - self.value)
        deviation = max(sample_deviation(comparison), 1e-9 * self.half_width)
        reach = self.half_width + _DEAD_BAND_MARGIN_SIGMAS * deviation
        return ndtr((reach - off) / deviation) - ndtr((-reach - off) / deviation)


def find_dead_band(codes: QuantizationCodes, output: Array) -> DeadBand | None:
    """Return the dead band of an output, or None where it shows none."""
    counts = np.where(np.abs(codes.values) < _rest_rate_limit(output), codes.counts, 0)
    place = int(np.argmax(counts))
    away = np.abs(np.delete(codes.values, place) - codes.values[place])
    band = DeadBand(float(codes.values[place]), float(away.min(initial=np.inf)))
    runs = np.count_nonzero(np.diff(band.contains(output), prepend=False, append=False)) // 2
    return (band if counts[place] > 1 and runs > 1
            and band.half_width > _MIN_DEAD_BAND_STEPS * codes.step else None)


def _rest_rate_limit(output: Array) -> float:
    """Return the largest absolute output of a rest, by a quantile that excludes outliers."""
    return _REST_RATE_SHARE * float(np.quantile(np.abs(output), 0.99))


def sample_deviation(comparison: OutputComparison) -> float:
    """Return the standard deviation of samples from the expected output, rad/s."""
    return (comparison.noise_deviation if comparison.expected is None
            else max(comparison.noise_deviation, comparison.scatter))


@dataclass(frozen=True)
class Limit:
    """
    Largest and smallest code of a saturated output.

    Attributes
    ----------
    low, high : the limit on each side, infinite where there is none
    p_value : the chance that an output without one repeats its extreme codes as often

    """

    low: float
    high: float
    p_value: float

    @property
    def size(self) -> float:
        """Return the limit as a rate without sign."""
        return min(-self.low, self.high)

    def is_reached(self, output: Array) -> Mask:
        """Mark the samples at the limit."""
        slack = 1e-9 * self.size
        return (output >= self.high - slack) | (output <= self.low + slack)


def find_limit(codes: QuantizationCodes, comparison: OutputComparison,
               level: float) -> Limit | None:
    """
    Return the limit of an output, or None where it shows none.

    An extreme code is a limit if it is larger than the output at rest; if it is more frequent than
    its neighbours, which are more frequent without a limit; and if the expected output is beyond
    it, which is not so for a coarse code at a constant rate.

    Parameters
    ----------
    codes : of the output
    comparison : output and expectation
    level : chance of a false alarm on one side

    """
    chances = {}
    for sign in (1.0, -1.0):
        values, counts = ((codes.values, codes.counts) if sign > 0.0
                          else (-codes.values[::-1], codes.counts[::-1]))
        chance = _extreme_code_chance(values, counts,
                                      float(local_code_steps(codes, sign * values[-1:])[0]),
                                      comparison.noise_deviation)
        if (chance < level and values[-1] > _rest_rate_limit(comparison.output)
                and _is_clipped(comparison, sign, values[-1], codes.step)):
            chances[sign] = (sign * values[-1], chance)
    if not chances:
        return None
    return Limit(chances.get(-1.0, (-np.inf, 1.0))[0], chances.get(1.0, (np.inf, 1.0))[0],
                 min(chance for _, chance in chances.values()))


def _extreme_code_chance(values: Array, counts: Array, step: float,
                         noise_deviation: float) -> float:
    """Return the chance of as many samples at the last code, if the density falls towards it."""
    reach = max(_NEIGHBOUR_CODES * step, _NEIGHBOUR_NOISE_SHARE * noise_deviation)
    neighbours = min(reach / step, 1e6)
    neighbour_count = int(counts[:-1][values[:-1] > values[-1] - reach - 0.5 * step].sum())
    return float(
        stats.binom.sf(counts[-1] - 2, counts[-1] - 1 + neighbour_count, 1.0 / (neighbours + 1.0)))


def _is_clipped(comparison: OutputComparison, sign: float, extreme: float, step: float) -> bool:
    """Tell whether samples at the largest value in one sense would have gone beyond it."""
    at_extreme = sign * comparison.output >= extreme - 1e-9 * abs(extreme)
    runs = int(np.count_nonzero(np.diff(at_extreme.astype(np.int8), prepend=0) > 0))
    fine = step < _FINE_STEP_NOISE_RATIO * comparison.noise_deviation
    expected = np.array([]) if comparison.expected is None else comparison.expected[at_extreme]
    beyond = sign * expected[np.isfinite(expected)] - extreme
    if not beyond.size:
        return fine and runs >= _MIN_LIMIT_RUNS
    middle = float(np.median(beyond))
    # The expected output errs by bias wander and nonlinearity, which these samples share.
    deviation = sample_deviation(comparison)
    return (middle > 0.5 * step + 2.0 * deviation
            or (fine and (runs >= _MIN_LIMIT_RUNS or middle > -3.0 * deviation)))


#: Number of classes of motion, by the expected change from one sample to the next.
_MOTION_CLASSES = 8
#: Probability of repeats from which on single repeats of a coarse output are not tested.
_COARSE_REPEAT_CHANCE = 0.3
#: Largest probability of a repeat for which single repeats are marked as a fault.
_RARE_REPEAT_CHANCE = 0.02
#: Least relative excess of repeats over the expected number.
_MIN_RELATIVE_EXCESS = 0.5
#: Largest ratio of a run at a limit to the longest run of repeats for which it is one of them.
_MAX_RUN_LENGTH_RATIO = 2.0
#: Ratio of a code to the noise below which the probability is computed by its density.
_NARROW_CODE_RATIO = 1e-5


@dataclass(frozen=True)
class RepeatedSamples:
    """
    Samples that repeat the one before.

    Attributes
    ----------
    is_repeat : mask of the unexplained repeats, shape (n,)
    expected_count : expected number of repeats by codes and noise
    p_value : of the number of repeats, or of the length of runs

    """

    is_repeat: Mask
    expected_count: float
    p_value: float

    @property
    def run_count(self) -> int:
        """Return how often it was repeated."""
        return len(find_runs(self.is_repeat))

    def includes_limit_run(self, at_limit: Mask) -> bool:
        """Tell whether samples at a limit are one run like the others, of an extreme value."""
        lengths, usual = ([run.stop - run.start for run in find_runs(each)]
                          for each in (at_limit, self.is_repeat))
        return len(lengths) == 1 and lengths[0] - 1 <= _MAX_RUN_LENGTH_RATIO * max(usual)


def find_repeated_samples(comparison: OutputComparison, codes: QuantizationCodes,
                          band: DeadBand | None, valid: Mask,
                          level: float) -> RepeatedSamples | None:
    """
    Find repeated samples, or return None.

    Parameters
    ----------
    comparison : output and expectation
    codes : of the output
    band : of rates that the output has one value for, if it has one
    valid : samples to look at; the codes explain repeats at a limit
    level : chance of a false alarm

    """
    known, change = valid[1:] & valid[:-1], np.diff(comparison.output)
    same = (change == 0.0) & known
    expected = (np.zeros(len(change)) if comparison.expected is None
                else np.nan_to_num(np.diff(comparison.expected)))
    if not same.any():
        return None
    width = local_code_steps(codes, comparison.output[:-1])
    chance, run_chance = _repeat_chances(change, expected, width, known)
    if band is not None:  # a sample in it repeats while the next is due in it
        within = band.contains(comparison.output[:-1])
        chances = band.membership_chance(comparison)[1:]
        chance, run_chance = (np.where(within, np.maximum(each, chances), each)
                              for each in (chance, run_chance))
        width = np.where(within, 2.0 * band.half_width, width)
    repeats, p_value = np.zeros(len(valid), dtype=bool), 1.0
    rare = (chance < _COARSE_REPEAT_CHANCE) & known
    excess, expected_count = int(np.count_nonzero(same & rare)), float(chance[rare].sum())
    by_number = (float(stats.poisson.sf(excess - 1, expected_count))
                 if excess > expected_count * (1.0 + _MIN_RELATIVE_EXCESS) else 1.0)
    if by_number < level:
        repeats[1:], p_value = same & (chance < _RARE_REPEAT_CHANCE), by_number
    product, cumulative_expected = (np.concatenate([[0.0], np.cumsum(each)])
                                    for each in (np.log(np.maximum(run_chance, 1e-12)), expected))
    for start, stop in ((run.start, run.stop) for run in find_runs(same)
                        if run.stop - run.start > 1):
        if chance[start:stop].max() < _COARSE_REPEAT_CHANCE:
            unlikely = math.exp(max(product[stop] - product[start], -700.0))
        else:
            # Repeats of a coarse code depend on each other: a fault only if it should have left.
            left = abs(cumulative_expected[stop] - cumulative_expected[start]) - width[start]
            unlikely = float(2.0 * stats.norm.sf(
                left / (math.sqrt(2.0) * sample_deviation(comparison)))) if left > 0.0 else 1.0
        if unlikely * len(valid) < level:
            repeats[start + 1:stop + 1], p_value = True, min(p_value, unlikely * len(valid))
    return RepeatedSamples(repeats, float(chance[known].sum()), p_value) if repeats.any() else None


def _repeat_chances(change: Array, expected: Array, step: Array,
                    known: Mask) -> tuple[Array, Array]:
    """
    Return the probability of each repeat, and its upper bound within a run, shape (n - 1,).

    The probability is averaged over the noise and over the position of the expected output within
    a code, for changes of similar expectation. In a long run the expected output is probably near
    the middle of the code, which gives the upper bound.

    """
    chances, run_chances = np.ones((2, len(change)))
    edges = np.quantile(np.abs(expected), np.linspace(0.0, 1.0, _MOTION_CLASSES + 1)[1:-1])
    classes = np.searchsorted(edges, np.abs(expected), side='left')
    for each in np.unique(classes):
        members = np.flatnonzero((classes == each) & known)
        if len(members):
            expected_changes, steps = expected[members], step[members]
            deviation = _change_deviation(change[members] - expected_changes,
                                          change[members] == 0.0, float(np.median(steps)))
            # no less than an upper bound of the share of changes by one code or two, each way
            size = np.abs(change[members])
            count = np.count_nonzero((size > 0.5 * steps) & (size < 2.5 * steps))
            chances[members] = np.maximum(_same_code_chance(expected_changes, deviation, steps),
                                          (count + 2.0 * np.sqrt(count)) / 4.0 / len(size))
            # that of the code in the middle between two expectations
            scale = np.maximum(deviation / math.sqrt(2.0), 1e-9 * steps)
            run_chances[members] = np.maximum(
                ndtr(0.5 * (steps - expected_changes) / scale)
                - ndtr(-0.5 * (steps + expected_changes) / scale), chances[members])
    return chances, run_chances


def _change_deviation(change: Array, same: Mask, step: float) -> float:
    """Return the standard deviation of changes by noise; zeros count as those due."""
    changed_sizes = np.abs(change[~same])
    if len(changed_sizes) < 2:
        return 0.0
    changed_sizes = np.minimum(changed_sizes, 4.0 * np.median(changed_sizes))
    square = float(np.mean(changed_sizes ** 2))
    variance = square
    for _ in range(20):
        same_code = _same_code_chance(np.zeros(1), np.sqrt(variance), np.array([step]))
        variance = square * (1.0 - float(same_code[0]))
    return float(np.sqrt(variance))


def _same_code_chance(expected: Array, deviation: float, step: Array) -> Array:
    """Return the mean of max(0, 1 - |D| / step) for normal D: the chance of the same code."""
    scale = np.maximum(deviation, 1e-9 * step)
    low, middle, high = ((edge - expected) / scale for edge in (-step, 0.0, step))
    above, below = ndtr(high) - ndtr(middle), ndtr(middle) - ndtr(low)
    sizes = expected * (above - below) + scale * (2.0 * _normal_density(middle)
                                                  - _normal_density(high) - _normal_density(low))
    # Differences of nearly nothing are rounding.
    return np.where(step < _NARROW_CODE_RATIO * scale, step / scale * _normal_density(middle),
                    np.clip(above + below - sizes / step, 0.0, 1.0))


def _normal_density(values: Array) -> Array:
    return np.exp(-0.5 * values ** 2) / math.sqrt(2.0 * math.pi)


#: Least deviation of an outlier in standard deviations; more for very long logs.
_MIN_OUTLIER_SIGMAS = 6.0
#: Number of neighbours on each side with which a sample is compared.
NEIGHBOURS_PER_SIDE = 3
#: Largest time between a jolt in the output and in the reference, in samples.
_JOLT_SAMPLES = 10
#: Samples in a block of constant scatter.
_SCATTER_BLOCK_SAMPLES = 256
#: Number of kinds of motion, by the range of the expected output near a sample.
_MOTION_KINDS = 16
#: Tail probabilities at which the scatter is estimated, for rough motion.
_TAIL_SHARES = (0.05, 0.01)
#: Largest number of consecutive outliers.
_MAX_OUTLIER_RUN = 2
#: Mean rank of outliers among all samples by motion, from which on motion causes them.
_MAX_MEAN_MOTION_RANK = 0.85
#: Least number of outliers for a test of their pattern, and its p-value.
_MIN_PATTERN_OUTLIERS, _PATTERN_CHANCE = 3, 1e-3
#: Deviation, in standard deviations, from which on to that of outliers there are at most half as
#: many samples as outliers; more are a tail of the noise.
_NEAR_OUTLIER_SIGMAS = 4.5


@dataclass(frozen=True)
class Outliers:
    """
    Single samples far from their neighbours.

    Attributes
    ----------
    is_outlier : shape (n,)
    largest_sigmas : in standard deviations
    p_value : the chance of as many among Gaussian ones

    """

    is_outlier: Mask
    largest_sigmas: float
    p_value: float


def find_outliers(comparison: OutputComparison, valid: Mask, min_scatter: float,
                  level: float) -> Outliers | None:
    """
    Find outliers, or return None.

    Parameters
    ----------
    comparison : output and expectation
    valid : samples that count; next to three and more of six that do not, as after a run of
        repeats, one is not tested
    min_scatter : the scatter is at least this, rad/s: half a code
    level : chance of a false alarm

    """
    output = bridge_gaps(np.where(valid, comparison.output, np.nan))
    expected = (None if comparison.expected is None or not np.isfinite(comparison.expected).any()
                else bridge_gaps(comparison.expected))
    limit = max(_MIN_OUTLIER_SIGMAS, float(stats.norm.isf(0.25 * level / len(output))))
    # how much the output is expected to change about each sample
    expected_change = np.zeros(len(output))
    if expected is not None:
        padded = np.pad(expected, 2 * NEIGHBOURS_PER_SIDE, mode='edge')
        expected_change = np.ptp(sliding_window_view(padded, 4 * NEIGHBOURS_PER_SIDE + 1), axis=1)
    sigmas = _outlier_sigmas(output, expected_change, valid, min_scatter)
    if expected is not None:
        sigmas = np.maximum(
            sigmas, _outlier_sigmas(output - expected, expected_change, valid, min_scatter))
        # near a jump of the reference of half the size: a jolt, or the reference is outlying
        jumps = maximum_filter1d(_distance_to_median(expected), 2 * _JOLT_SAMPLES + 1)
        off = np.minimum(_distance_to_median(output), _distance_to_median(output - expected))
        sigmas[jumps > 0.5 * off] = 0.0
    missing = np.count_nonzero(_neighbour_samples(~valid, NEIGHBOURS_PER_SIDE), axis=1)
    tested = valid & (missing < NEIGHBOURS_PER_SIDE)
    outlying = _drop_long_runs((sigmas > limit) & tested)
    count = int(np.count_nonzero(outlying))
    near = int(np.count_nonzero((sigmas > _NEAR_OUTLIER_SIGMAS) & (sigmas <= limit) & tested))
    usual = stats.poisson.isf(0.01, 2.0 * len(output) * stats.norm.sf(_NEAR_OUTLIER_SIGMAS))
    if (not count or near > 0.5 * count + usual
            or _is_due_to_motion(outlying, expected_change, comparison)):
        return None
    p_value = float(stats.poisson.sf(count - 1, 4.0 * len(output) * stats.norm.sf(limit)))
    return Outliers(outlying, float(sigmas[outlying].max()), p_value) if p_value < level else None


def _neighbour_samples(values: Array | Mask, side: int) -> Array:
    """Return the samples before and after each one, shape (n, 2 side)."""
    # Turned over about the first and last sample, a slope goes on as it is. These two are what
    # the neighbouring samples say, as one that is an outlier would agree with itself.
    if len(values) > NEIGHBOURS_PER_SIDE + 1 and values.dtype != bool:
        ends = [np.median([part[0], 2.0 * part[1] - part[2], 2.0 * part[2] - part[4]])
                for part in (values, values[::-1])]
        values = np.concatenate([ends[:1], values[1:-1], ends[1:]])
    window = sliding_window_view(np.pad(values, side, mode='reflect', reflect_type='odd'),
                                 2 * side + 1)
    return np.delete(window, side, axis=1)


def _distance_to_median(values: Array) -> Array:
    """Return how far each sample is from the median of its neighbours."""
    return np.abs(values - np.median(_neighbour_samples(values, NEIGHBOURS_PER_SIDE), axis=1))


def _outlier_sigmas(values: Array, expected_change: Array, valid: Mask,
                    min_scatter: float) -> Array:
    """Return distances from neighbours in local standard deviations, also those by motion."""
    near = _neighbour_samples(values, NEIGHBOURS_PER_SIDE)
    off = np.abs(values - np.median(near, axis=1))
    # A step, a corner or a steep slope is off the median, but within the range of its neighbours.
    outside = np.maximum(values - near.max(axis=1), near.min(axis=1) - values)
    scale = np.maximum(_local_deviation(off, valid),
                       _deviation_by_motion(off, expected_change, valid))
    scale = np.maximum(scale, max(min_scatter, 1e-300))
    return np.where(outside > 0.5 * off, off / scale, 0.0)


def _local_deviation(distance: Array, valid: Mask) -> Array:
    """Return the robust standard deviation in blocks, the largest of those next to a sample."""
    blocks = max(1, len(distance) // _SCATTER_BLOCK_SAMPLES)
    parts, kept = np.array_split(distance, blocks), np.array_split(valid, blocks)
    scales = [_robust_deviation(part[own]) for part, own in zip(parts, kept)]
    return np.repeat(maximum_filter1d(scales, 3, mode='nearest'), [len(part) for part in parts])


def _robust_deviation(off: Array) -> float:
    return float(np.quantile(off, 0.6827)) if off.size else 0.0


def _deviation_by_motion(distance: Array, expected_change: Array, valid: Mask) -> Array:
    """Return the standard deviation among samples of like motion, by far ones too if enough."""
    shares = np.linspace(0.0, 1.0, _MOTION_KINDS + 1)[1:-1]
    edges = np.unique(np.quantile(expected_change[valid], shares)) if valid.any() else np.array([])
    kinds = np.searchsorted(edges, expected_change, side='left')
    scales = np.zeros(len(edges) + 1)
    for kind in range(len(scales)):
        members = distance[(kinds == kind) & valid]
        if members.size:
            tails = [np.quantile(members, 1.0 - share) / stats.norm.isf(0.5 * share)
                     for share in _TAIL_SHARES if share * members.size > 5]
            scales[kind] = max([_robust_deviation(members), *tails])
    return scales[kinds]


def _drop_long_runs(outlying: Mask) -> Mask:
    """Leave out those with more outlying ones at their side than single samples have."""
    single = np.zeros(len(outlying), dtype=bool)
    for run in find_runs(outlying):
        single[run] = run.stop - run.start <= _MAX_OUTLIER_RUN
    return single


def _is_due_to_motion(outlying: Mask, expected_change: Array,
                      comparison: OutputComparison) -> bool:
    """Tell whether outlying samples stand where motion changes most, or at certain rates."""
    if (np.count_nonzero(outlying) < _MIN_PATTERN_OUTLIERS or comparison.expected is None
            or not np.ptp(expected_change) > 0.0):
        return False
    ranks = _relative_ranks(expected_change[outlying], expected_change)
    by_chance = 0.5 + stats.norm.isf(_PATTERN_CHANCE) / np.sqrt(12.0 * len(ranks))
    if ranks.mean() > max(_MAX_MEAN_MOTION_RANK, by_chance):
        return True
    turning = ((expected_change > 3.0 * comparison.noise_deviation)
               & np.isfinite(comparison.expected))
    if np.count_nonzero(outlying & turning) < _MIN_PATTERN_OUTLIERS:
        return False
    speeds = np.abs(comparison.expected)
    return bool(stats.kstest(_relative_ranks(speeds[outlying & turning], speeds[turning]),
                             'uniform').pvalue < _PATTERN_CHANCE)


def _relative_ranks(values: Array, among: Array) -> Array:
    return np.searchsorted(np.sort(among), values) / len(among)
