"""
Show what trips who takes the formulas of the two papers as they are printed; the numbers are those of docs/self_calibration.md.

    python misprints.py

"""

import numpy as np

from gyro_calibration.heading import integrate
from gyro_calibration.motion import CALIBRATION, Motion, from_rates
from gyro_calibration.self_calibration import fit_heading, fit_likelihood, fit_rate

S, B = -0.1, 0.1  # scale factor error, and bias in rad/s, of the simulations of Hong and Park (2008)
#: s and rad/s: a rest, then a fast turn in one direction, and nothing after it.
ONE_TURN = from_rates(np.array([0.0, 2.0, 2.25, 6.25, 6.5]), np.array([0.0, 0.0, 3.0, 3.0, 0.0]))


def samples(motion: Motion, sample_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return time, s, and output, rad/s, of a gyro without noise."""
    time = np.arange(round(motion.duration * sample_rate) + 1) / sample_rate
    return time, (1.0 + S) * motion.rate_at(time) + B


def by_trapezoids(time: np.ndarray, rate: np.ndarray, motion: Motion) -> tuple[float, float]:
    """Return s and b by eq. 7, with the trapezoid rule in place of the rectangle rule of eq. 4."""
    g = np.column_stack([integrate(time, rate), time])
    scale, offset = np.linalg.lstsq(g, motion.heading_at(time), rcond=None)[0]
    return 1.0 / scale - 1.0, -offset / scale


def percent(found_over_true: float) -> float:
    """Return an error in percent, rounded, and without a sign where it is zero."""
    return round(100.0 * (found_over_true - 1.0), 2) + 0.0


def rectangle_rule() -> None:
    """Errors of the four ways on motions without noise."""
    print('error of s and of b, in % of the true value')
    for name, motion, sample_rate in (('one turn', ONE_TURN, 20.0), ('built-in', CALIBRATION, 20.0), ('built-in', CALIBRATION, 100.0)):
        time, rate = samples(motion, sample_rate)
        fits = {method.__name__: method(time, rate, motion) for method in (fit_heading, fit_rate, fit_likelihood)}
        found = {way: (fit.scale_factor_error, fit.bias) for way, fit in fits.items()}
        found['by_trapezoids'] = by_trapezoids(time, rate, motion)
        for way, (s, b) in found.items():
            print(f'{name:9} {sample_rate:4.0f} Hz  {way:15} {percent(s / S):7.2f} {percent(b / B):7.2f}')


def exchanged_columns() -> None:
    """Hong and Park, eq. 8, as printed and put right."""
    time, r_m = samples(CALIBRATION, 20.0)
    r = CALIBRATION.rate_at(time)
    printed = np.array([[r_m.sum(), r_m @ r_m], [len(r_m), r_m.sum()]])
    wanted = np.array([r @ r_m, r.sum()])
    print('eq. 8 as printed gives [s_bar, b_bar] =', np.round(np.linalg.solve(printed, wanted), 4))
    print('columns exchanged             it gives =', np.round(np.linalg.solve(printed[:, ::-1], wanted), 4))
    print('true                                   =', np.round([1.0 / (1.0 + S), -B / (1.0 + S)], 4))


def colliding_index(p: int = 3, q: int = 2) -> None:
    """Ojeda, Chung and Borenstein (2000), eq. 10: in which column the powers go."""
    for stride in (p, p + 1):
        columns = {i + (j - 1) * stride for i in range(1, p + 2) for j in range(1, q + 2)}
        print(f'eq. 10 with the index i + (j - 1) {stride}: {len(columns)} different columns of {(p + 1) * (q + 1)}')


if __name__ == '__main__':
    rectangle_rule()
    exchanged_columns()
    colliding_index()
