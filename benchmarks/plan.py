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
Compare a planned motion of 20 s with plain ones, predicted and simulated, and with longer ones.

    python benchmarks/plan.py [RUNS]

The robot turns at 60 deg/s at most, with 120 deg/s² (60 deg/s² with the short cable) and rests of
1 s. The gyro has the noise of the Epson XV-3500 and a random scale factor error and bias for each
run, of 3 % and 0.5 deg/s; 100 Hz. After the run and its rest it drives on for 160 s: the motion
`robot`, which turns up to 100 deg and comes back each time, or a steady turn of ten rounds. The
noise of a run is one record, from before the motion to the end of the drive; each row uses the
same records. Standard deviations of the bias are of its difference from the mean bias of the
drive. Some rows have a gyro that is late against the profile, or a robot with a first-order lag,
unknown to the fit.

Prints a table in Markdown; n runs determine a standard deviation to 1 / sqrt(2 n), 200 runs to 5
%, and a mean heading error to about 5 %.
"""

from __future__ import annotations

from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from functools import partial
import sys

from gyro_calibration.calibration.likelihood import fit_likelihood
from gyro_calibration.calibration.motion_design import (
    CalibrationForecast, find_best_motion, plain_motion, RobotLimits)
from gyro_calibration.calibration.self_calibration import check_rest, RunLimits, SETTLING_TIME
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, constant_rate_motion, Motion, ROBOT_MOTION)
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
import numpy as np

RATE, DRIVE = 100, 160.0
#: Samples until the robot has settled after a run, and until the end of its rest.
SETTLED = round(SETTLING_TIME * RATE)
REST = SETTLED + round(RunLimits.rest_duration * RATE)
#: Lengths of planned motions, s.
LENGTHS = (20.0, 30.0, 60.0, 120.0)
#: Flicker and its drift begin so long before the run, s.
BEFORE = 160.0
DRIVES = {'robot': ROBOT_MOTION, 'ten rounds': constant_rate_motion([(DRIVE, 22.5)])}
ABILITIES = {'cable, 180 deg': RobotLimits(60.0 * DEGREE, 120.0 * DEGREE, lowest=-180.0 * DEGREE,
                                           highest=180.0 * DEGREE),
             'cable, 20 deg': RobotLimits(60.0 * DEGREE, 60.0 * DEGREE, lowest=-20.0 * DEGREE,
                                          highest=20.0 * DEGREE),
             'free': RobotLimits(60.0 * DEGREE, 120.0 * DEGREE)}


def followed(motion: Motion, time: Array, late: float, lag: float) -> Array:
    """Return the rate, rad/s, of a robot with a first-order lag, s, by a gyro with a delay, s."""
    fine = np.arange(round(time[-1] * 1000.0) + 1) / 1000.0
    response = np.exp(-np.arange(2000) / 1000.0 / lag) if lag else np.ones(1)
    return np.convolve(motion.rate_at(fine - late),
                       response / response.sum())[:len(fine):1000 // RATE]


def errors(motion: Motion, late: float, lag: float, seed: int) -> Array:
    """Return the errors of s, of b against the drive's mean, and of the headings, shape (4,)."""
    generator = np.random.default_rng([11, seed])
    s, b = 0.03 * generator.standard_normal(), 0.5 * DEGREE * generator.standard_normal()
    before, run, drive = (round(length * RATE) for length in (BEFORE, motion.duration, DRIVE))
    # the drive is at the end of the record: same noise for motions of any length
    count = before + round(LENGTHS[-1] * RATE) + REST + drive
    wander = simulate_noise(replace(XV3500.noise, angle_random_walk=0.0), count, 1.0 / RATE,
                            generator)
    noise = wander + simulate_noise(Noise(XV3500.noise.angle_random_walk), count, 1.0 / RATE,
                                    generator)
    begin = count - drive - REST - run
    time = np.arange(run + REST + 1) / RATE
    output = (1.0 + s) * followed(motion, time, late, lag) + b + noise[begin:count - drive + 1]
    fit = fit_likelihood(time[:run + 1], output[:run + 1], motion, 0.2)
    rest = slice(run + SETTLED, None)
    fit = check_rest(time[rest], output[rest], fit, XV3500.noise).fit
    bias = fit.bias - b - wander[count - drive:].mean()
    after = (np.arange(drive) + 1.0) / RATE
    walked = np.cumsum(noise[count - drive:]) / RATE
    headings = [((1.0 + s) * each.heading_at(after) + walked + (b - fit.bias) * after) / (
        1.0 + fit.scale_factor_error) - each.heading_at(after) for each in DRIVES.values()]
    return np.array([fit.scale_factor_error - s, bias,
                     *(np.abs(heading).mean() for heading in headings)])


def forecasts(duration: float) -> list[CalibrationForecast]:
    return [CalibrationForecast(XV3500.noise, duration, drive, DRIVE)
            for drive in DRIVES.values()]


def planned(place: str, duration: float) -> Motion:
    return find_best_motion(ABILITIES[place], forecasts(duration)[0], duration,
                            np.random.default_rng(1))[0]


def row(pool: Executor, runs: int, name: str, motion: Motion, late: float = 0.0,
        lag: float = 0.0) -> str:
    """Return a row of the table, with what was predicted / simulated."""
    predicted = [forecast.predict(motion) for forecast in forecasts(motion.duration)]
    found = np.array(list(pool.map(partial(errors, motion, late, lag), range(runs), chunksize=10)))
    scale, bias = np.sqrt((found[:, :2] ** 2).mean(axis=0))
    cells = [f'{100.0 * predicted[0].scale_deviation:.4f} / {100.0 * scale:.4f} %',
             f'{predicted[0].bias_deviation / DEGREE:.5f} / {bias / DEGREE:.5f} deg/s']
    cells += [f'{each.heading_error / DEGREE:.3f} / {mean / DEGREE:.3f} deg'
              for each, mean in zip(predicted, found[:, 2:].mean(axis=0))]
    return f'| {name} | {" | ".join(cells)} |'


def main(runs: int) -> None:
    twenty = LENGTHS[0]
    motions = {place: planned(place, twenty) for place in ABILITIES}
    rows = [('built-in profile', CALIBRATION_MOTION)]
    for place, motion in motions.items():
        rows += [(f'{place}: one turn there and back', plain_motion(ABILITIES[place], twenty)),
                 (f'{place}: planned', motion)]
    cable = motions['cable, 180 deg']
    late = [('cable, 180 deg: planned, gyro 20 ms late', cable, 0.02),
            ('cable, 180 deg: planned, gyro 50 ms late', cable, 0.05),
            ('cable, 180 deg: planned, robot lags by 0.1 s', cable, 0.0, 0.1),
            ('cable, 20 deg: planned, robot lags by 0.1 s', motions['cable, 20 deg'], 0.0, 0.1)]
    longer = [(f'cable, 180 deg: planned, {length:g} s', planned('cable, 180 deg', length))
              for length in LENGTHS[1:]]
    print(f'Predicted / simulated, {runs} runs a row.\n\n'
          f'| motion | scale | bias | mean heading error, {" | ".join(DRIVES)} |')
    print('|---|---|---|---|---|')
    with ProcessPoolExecutor() as pool:
        for arguments in rows + late + longer:
            print(row(pool, runs, *arguments), flush=True)


if __name__ == '__main__':
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
