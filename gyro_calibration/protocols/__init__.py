"""
Wire formats of serial gyros: bytes to samples and back. No port, no ROS, no clock.

>>> decoder = find('kvh_dsp3000').decoder()
>>> decoder.feed(b'       0.015733   1\\r\\n')
[Sample(output=-0.00027459265121626786, temperature=None, time=None)]

"""

from .csv_lines import CSV
from .kvh_dsp3000 import KVH_DSP3000
from .kvh_ecore import KVH_ECORE
from .minimu9 import MINIMU9
from .protocol import Decoder, Protocol, Sample, Settings

PROTOCOLS = {protocol.name: protocol for protocol in (KVH_DSP3000, KVH_ECORE, MINIMU9, CSV)}

PLANNED = ('kvh_1750', 'fizoptika', 'witmotion', 'razor')
"""Formats that will stand here later."""

__all__ = ['PLANNED', 'PROTOCOLS', 'Decoder', 'Protocol', 'Sample', 'Settings', 'find']


def find(name: str) -> Protocol:
    """
    Return a protocol by its name.

    Raises
    ------
    ValueError : there is none of that name, or not yet

    """
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    known = ', '.join(PROTOCOLS)
    if name in PLANNED:
        raise ValueError(f'protocol {name} is planned, but cannot be read yet: choose one of {known}, or send lines of the protocol csv')
    raise ValueError(f'protocol {name!r} is not known: choose one of {known}')
