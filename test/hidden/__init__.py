"""
Logs with hidden effects, made independently of the package: nothing of it is imported here.

`hide` makes logs of a random gyro; `FORMS` are the effects of the catalogue, `OUTSIDE` those that
are not in it; `twin` and `part` make the logs on which two causes are confounded, and on which
they are distinguishable; `oracle_gain` is the improvement with the truth known.

A size is a multiple of the minimum detectable effect beside a bias of each recording and one scale
(`size`), with these exceptions: faults of samples are counted, and three are just detectable;
quantization and encoder steps have the size whose added variance is just detectable; a wrong unit
has no size; a figure of the noise changes until its spectrum is as far from the expected one as a
just detectable effect is from none.

Reading order: `filters`, `motion`, `noise`, `effects`, `outside`, `size`, `likeness`, `log`,
`twins`, `oracle`.

"""

from hidden.effects import FORMS
from hidden.log import ALL, Cause, Gyro, HiddenLog, Truth, draw_gyro, hide, record
from hidden.motion import Session, described, session
from hidden.noise import KINDS, NoiseFigures
from hidden.oracle import OracleGain, oracle_gain
from hidden.outside import OUTSIDE
from hidden.size import DETECTABLE
from hidden.twins import TWINS, part, twin

__all__ = ['ALL', 'DETECTABLE', 'FORMS', 'KINDS', 'OUTSIDE', 'TWINS', 'Cause', 'Gyro', 'HiddenLog',
           'NoiseFigures', 'OracleGain', 'Session', 'Truth', 'described', 'draw_gyro', 'hide',
           'oracle_gain', 'part', 'record', 'session', 'twin']
