"""The verb self-calibrate: scale factor error and bias from about 20 s of known motion."""

from __future__ import annotations

import argparse
from datetime import datetime, timezone
from typing import Any

import numpy as np

from gyro_calibration.compensation import compensate
from gyro_calibration.log import Array, DataRefused, Log
from gyro_calibration.model import GyroModel, with_self_calibration
from gyro_calibration.model_file import read_model, write_model
from gyro_calibration.motion import Motion, from_headings, from_rates, read_motion
from gyro_calibration.self_calibration import METHODS, record, self_calibrate
from gyro_calibration.verbs.verb import Answer, UsageError, add_log, output_of, read, time_of, verb


def add(verbs: Any) -> argparse.ArgumentParser:
    parser = verb(verbs, 'self-calibrate', _self_calibrate, 'find scale factor error and bias from about 20 s of known motion',
                   'run.csv --profile profile.csv --out model.yaml')
    add_log(parser)
    parser.add_argument('--profile', metavar='PROFILE.csv', help='time_s and heading_deg or rate_dps; default: the reference of the log')
    parser.add_argument('--method', choices=list(METHODS), default='likelihood', help='default: likelihood; the others as published')
    parser.add_argument('--model', metavar='MODEL.yaml', help='compensate by it first')
    parser.add_argument('--out', metavar='MODEL.yaml', help='write the model with this self-calibration')
    return parser


def _self_calibrate(given: argparse.Namespace) -> Answer:
    model = read_model(given.model) if given.model else GyroModel()
    log = read(given)
    time, output = time_of(given, log), output_of(given, log)
    motion, begin = (read_motion(given.profile), time[0]) if given.profile else _reference(given, log, time)
    time = time - begin
    run = np.isfinite(output) & (time >= -1.0) & (time <= motion.duration + 1.0)
    rates = compensate(with_self_calibration(model, None), output, log.temperature).rate
    fit = self_calibrate(time[run], rates[run], motion, given.method, noise=model.noise)
    temperature = None if log.temperature is None else float(log.temperature[run].mean())
    calibration = record(fit, given.method, datetime.now(timezone.utc).isoformat(timespec='seconds'), temperature)
    if given.out:
        write_model(given.out, with_self_calibration(model, calibration))
    data = {**calibration.figures(), 'samples': int(run.sum()), 'time_offset_s': fit.time_offset, 'out': given.out}
    lines = [f'{str(calibration)[0].upper()}{str(calibration)[1:]}, from {run.sum()} samples.']
    if given.method == 'likelihood':
        lines.append(f'The gyro lags the profile by {fit.time_offset:.4f} s.')
    return Answer('\n'.join(lines + ([f'Written to {given.out}.'] if given.out else [])), data)


def _reference(given: argparse.Namespace, log: Log, time: Array) -> tuple[Motion, float]:
    """Return the motion that the reference of a log shows, and when by the log's time it begins, s."""
    for values, motion in ((log.reference_heading, from_headings), (log.reference_rate, from_rates)):
        if values is not None:
            known = np.isfinite(values)
            if known.sum() < 2:
                raise DataRefused(f'{given.log}: the reference is lost nearly everywhere; give the motion by --profile')
            return motion(time[known], values[known]), float(time[known][0])
    raise UsageError(f'{given.log}: holds no reference; give the motion by --profile')
