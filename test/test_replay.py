"""A log is laid out for the search whatever its reference lost, and however it was smoothed."""

from dataclasses import replace

import numpy as np
import pytest

from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.steps import diagnose
from gyro_calibration.log import Log

LATE = 0.004


@pytest.fixture(scope='module')
def smoothed():
    """Return a log at 250 Hz of a hand's motion, late by 4 ms, whose noise, of the gyro and more of the reference, was smoothed."""
    generator = np.random.default_rng(5)
    time = np.arange(30_000) / 250.0
    turns = [(frequency, generator.normal(), generator.uniform(0.0, 6.0)) for frequency in (0.13, 0.31, 0.7, 1.1, 1.9, 3.1, 5.3)]

    def rate(when):
        return sum(size * np.sin(2.0 * np.pi * frequency * when + phase) for frequency, size, phase in turns)

    def averaged(values):
        return np.convolve(values, np.full(7, 1.0 / 7.0), 'same')

    noise = 0.03 * generator.standard_normal(len(time))
    output = rate(time - LATE) + averaged(averaged(0.002 * generator.standard_normal(len(time))))
    reference = rate(time) + averaged(averaged(averaged(averaged(noise))))
    return Log(time=time, output=output + 1e-6 * generator.standard_normal(len(time)), reference_rate=reference)


@pytest.fixture(scope='module')
def gaping(smoothed):
    """Return the same log, where the reference is lost for half a second."""
    lost = (smoothed.time > 40.0) & (smoothed.time < 40.5)
    return replace(smoothed, reference_rate=np.where(lost, np.nan, smoothed.reference_rate))


def laid_out(log):
    return replay(log, np.ones(len(log.time), dtype=bool), np.random.default_rng(0))


def test_effects_look_at_a_rate_without_gaps_and_lost_samples_are_not_compared(gaping):
    each = laid_out(gaping)
    assert np.isfinite(each.channels.rate).all()
    assert not each.kept[np.isnan(gaping.reference_rate)].any()


def test_a_smoothed_record_is_averaged_until_no_smoothing_is_seen(smoothed):
    assert laid_out(smoothed).every > 1


def test_a_record_that_is_not_smoothed_is_left_as_it_is(smoothed):
    rate = np.sin(smoothed.time)
    noise = 1e-3 * np.random.default_rng(2).standard_normal(len(rate))
    assert laid_out(replace(smoothed, output=rate + noise, reference_rate=rate)).every == 1


def test_stamps_in_bursts_lose_no_sample():
    time = 0.01 * np.arange(20_000)
    late = 0.04 * (np.arange(len(time)) // 4) + 1e-3 * (np.arange(len(time)) % 4)
    noise = 1e-3 * np.random.default_rng(3).standard_normal(len(time))
    each = laid_out(Log(time=late, output=noise))
    assert each.place[-1] == len(time) - 1 and each.interval == pytest.approx(0.01, rel=1e-3)


def test_a_delay_is_named_as_one_beside_a_noisy_and_gaping_reference(gaping):
    found = diagnose([gaping], np.random.default_rng(1)).findings[0]
    assert found.effect == 'time_offset' and found.parameters['time_offset'].estimate == pytest.approx(LATE, rel=0.03)
