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
Dwells: stretches of constant rate, each one row of means, to which a calibration is fitted.

The rows of a rate table without time are dwells. In a log in time they are found: where the
reference is steady, without the ramps and the settling after them.

Reading order, each imports only from those before it: `samples` (those with gyro and reference),
`steadiness` (of a reference rate), `straightness` (of a reference heading), `settling` (after
ramps), `stretches` (of a log that are dwells, without outliers and repeated samples),
`averaging` (of each), `sweeps` (to which dwells belong), `table` (of all dwells).

"""

from gyro_calibration.calibration.dwells.samples import format_list, Numbers
from gyro_calibration.calibration.dwells.table import (
    Dwells,
    dwells_from_table,
    extract_dwells,
    find_dwells,
    join_dwells,
    select_dwells,
    SteadinessLimits,
)

__all__ = ['Dwells', 'Numbers', 'SteadinessLimits', 'extract_dwells', 'find_dwells',
           'dwells_from_table', 'join_dwells', 'format_list', 'select_dwells']
