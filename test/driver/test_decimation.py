# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The mean of several samples in place of each."""

from gyro_calibration.driver.connection import Decimator
from gyro_calibration.driver.protocols import Sample
import pytest

PERIOD = 1e-3
EPOCH = 1.7e9


def means(size, numbers):
    """Return what becomes of samples that hold their numbers, as many periods after 1970."""
    decimation = Decimator(size)
    samples = [Sample(1e-4 * number, 30.0, specific_force=9.81) for number in numbers]
    complete = list(decimation.add(samples,
                                   [EPOCH + PERIOD * number for number in numbers], PERIOD))
    return complete, list(decimation.flush())


def test_one_sample_a_message_stays_as_it_is():
    complete, rest = means(1, range(5))
    assert ([mean.sample.output for mean in complete] == [1e-4 * number for number in range(5)]
            and not rest)
    assert {mean.sample_count for mean in complete} == {1}


def test_a_mean_has_the_mean_time_of_its_samples():
    complete, rest = means(10, range(25))
    assert [mean.sample.output for mean in complete] == pytest.approx([4.5e-4, 14.5e-4])
    assert [mean.stamp - EPOCH for mean in complete] == pytest.approx([4.5e-3, 14.5e-3], abs=1e-6)
    assert ({(mean.sample.temperature, round(mean.sample.specific_force, 9)) for mean in complete}
            == {(30.0, 9.81)})
    assert [mean.sample_count for mean in [*complete, *rest]] == [10, 10, 5]


@pytest.mark.parametrize('numbers, sizes', [([*range(4), *range(50, 60)], [4, 10]),
                                            ([100, 101, 50, 51], [2, 2])],
                         ids=['a gap', 'stamps that are set back'])
def test_a_jump_of_the_stamps_ends_a_group(numbers, sizes):
    complete, rest = means(10, numbers)
    assert [mean.sample_count for mean in [*complete, *rest]] == sizes


def test_a_group_that_has_begun_is_given_once():
    decimation = Decimator(1000)
    assert not list(decimation.add([Sample(0.1)], [EPOCH], PERIOD))
    assert ([mean.sample for mean in decimation.flush()] == [Sample(0.1)]
            and not list(decimation.flush()))


def test_unknown_temperatures_do_not_count():
    decimation = Decimator(3)
    samples = [Sample(0.0, 20.0), Sample(0.0), Sample(0.0, 30.0)]
    mean, = decimation.add(samples, [EPOCH + PERIOD * number for number in range(3)], PERIOD)
    assert mean.sample.temperature == 25.0 and mean.sample.specific_force is None
