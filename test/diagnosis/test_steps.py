# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""How far a diagnosis is: never less than before, and within the step that is under way."""

from gyro_calibration.diagnosis.steps import ProgressSteps


def test_parts_of_unknown_number_stay_within_their_step():
    told = []
    steps = ProgressSteps(lambda share, words: told.append((share, words)), {
        'a': 1,
        'b': 8,
        'c': 1})
    steps.begin('a')
    steps.begin('b')
    for number in range(40):
        steps.begin_part(f'part {number}')
    steps.begin('c')
    shares = [share for share, _ in told]
    assert shares == sorted(shares) and shares[:3] == [0.0, 0.1, 0.1] and shares[-1] == 0.9
    assert told[12][1] == 'part 10' and 0.6 < told[12][0] < 0.8
