"""Dwells: stretches of constant rate, each one row of means, out of which a rate table's calibration is made."""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration.log import Array


@dataclass(frozen=True)
class Dwells:
    """
    Means over stretches of constant rate (Ojeda et al., eq. 5 to 7), each array of shape (n,).

    Attributes
    ----------
    rate : of the reference, rad/s
    output : of the gyro, rad/s
    temperature : degC; None where the log holds none
    deviation : standard deviation of the mean output against the mean reference, rad/s; nan where it is not known
    sweep : number of the sweep, or block of time, that a dwell belongs to; what is left out together
    place : where each dwell stands in its file, for messages
    remarks : what was found and left out, one sentence each

    """

    rate: Array
    output: Array
    temperature: Array | None
    deviation: Array
    sweep: Array
    place: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rate)
