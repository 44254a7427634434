"""
Allan deviation, and the noise figures in it, against textbook definitions and simulated noise.

"""

import numpy as np
import pytest

from gyro_calibration.allan import allan_deviation


def textbook(rate, interval, size):
    """Return the overlapping Allan deviation as IEEE Std 952 defines it: means over neighbouring windows, at every sample."""
    means = np.convolve(rate, np.full(size, 1.0 / size), mode='valid')
    return np.sqrt(0.5 * np.mean((means[size:] - means[:-size]) ** 2))


@pytest.mark.parametrize('samples', [100, 1001, 70000])
def test_the_deviation_is_the_textbooks(samples):
    generator = np.random.default_rng(952)
    rate = 3.0 + np.cumsum(generator.standard_normal(samples)) + 30.0 * generator.standard_normal(samples)
    chart = allan_deviation(rate, 0.01)
    wanted = [textbook(rate, 0.01, size) for size in chart.size]
    np.testing.assert_allclose(chart.deviation, wanted, rtol=1e-9)
    assert chart.time[-1] == pytest.approx(samples // 3 * 0.01) and len(chart.size) >= 13
