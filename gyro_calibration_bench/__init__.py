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
A public bench for methods that name the causes of a gyro's error in a log with a reference.

    python -m gyro_calibration_bench make DIR --seed 1
    python -m gyro_calibration_bench answer DIR --out ANSWERS.json
    python -m gyro_calibration_bench score DIR ANSWERS.json

`docs/reference/bench.md` describes cases, answers and scores. Only the method `gyro_calibration`
imports that package; all else needs NumPy, SciPy and tqdm.

Reading order: `hidden` (the generator), `cases`, `scores`, `methods`.
"""
