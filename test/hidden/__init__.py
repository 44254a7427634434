"""
Logs with something hidden in them, made apart from the package: nothing of it is imported here.

`hide` makes logs of a random gyro; `FORMS` are the effects of the catalogue, `OUTSIDE` those that are not in it.

Reading order: `filters`, `motion`, `noise`, `effects`, `outside`, `size`, `log`.

"""

from .effects import FORMS
from .log import ALL, Cause, Gyro, HiddenLog, Truth, draw_gyro, hide, record
from .motion import Session, described, session
from .noise import KINDS, NoiseFigures
from .outside import OUTSIDE
from .size import DETECTABLE

__all__ = ['ALL', 'DETECTABLE', 'FORMS', 'KINDS', 'OUTSIDE', 'Cause', 'Gyro', 'HiddenLog', 'NoiseFigures', 'Session', 'Truth',
           'described', 'draw_gyro', 'hide', 'record', 'session']
