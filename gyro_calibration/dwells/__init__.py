"""
Dwells: stretches of constant rate, each one row of means, out of which a rate table's calibration is made.

A rate table without time holds them already. In a log in time they are found: where the reference is steady, without the ramps and the
settling after them.

Reading order, each imports only from those before it: `samples` (of gyro and reference, as far as both are there), `steadiness` (of a
reference rate), `straightness` (of a reference heading), `cleaning` (of wild and stuck samples), `settling` (what ramps leave behind),
`stretches` (that are left of a log), `averaging` (of each), `sweeps` (that dwells belong to), `table` (of all dwells).

"""

from gyro_calibration.dwells.samples import Numbers, listed
from gyro_calibration.dwells.table import Dwells, Steadiness, dwells, find_dwells, from_table, join, take

__all__ = ['Dwells', 'Numbers', 'Steadiness', 'dwells', 'find_dwells', 'from_table', 'join', 'listed', 'take']
