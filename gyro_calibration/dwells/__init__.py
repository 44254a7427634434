"""
Dwells: stretches of constant rate, each one row of means, to which a calibration is fitted.

The rows of a rate table without time are dwells. In a log in time they are found: where the
reference is steady, without the ramps and the settling after them.

Reading order, each imports only from those before it: `samples` (those with gyro and reference),
`steadiness` (of a reference rate), `straightness` (of a reference heading), `cleaning` (of
outliers and repeated samples), `settling` (after ramps), `stretches` (of a log that are dwells),
`averaging` (of each), `sweeps` (to which dwells belong), `table` (of all dwells).

"""

from gyro_calibration.dwells.samples import listed, Numbers
from gyro_calibration.dwells.table import (
    Dwells,
    dwells,
    find_dwells,
    from_table,
    join,
    Steadiness,
    take,
)

__all__ = ['Dwells', 'Numbers', 'Steadiness', 'dwells', 'find_dwells', 'from_table', 'join',
           'listed', 'take']
