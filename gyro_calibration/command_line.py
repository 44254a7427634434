"""
The program ``gyro_calibration``: one verb a way of working.

A verb is a function from its arguments to an `Answer`; `main` alone prints. Units that people use are converted here, at the rim.

"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np

from gyro_calibration import __version__
from gyro_calibration.compensation import compensate, covariance, quadratic_form, rate_sensitivity
from gyro_calibration.emulator import Emulator, emulate
from gyro_calibration.heading import Threshold, filter_rates, integrate_with_deviation
from gyro_calibration.log import DEGREE, Array, Log, LogError, read_log, write_log
from gyro_calibration.model import GyroModel, with_self_calibration
from gyro_calibration.model_file import ModelError, read_model, write_model
from gyro_calibration.motion import NAMED, Motion, MotionError, from_headings, from_rates, read_motion
from gyro_calibration.protocols import PLANNED, PROTOCOLS, Protocol, Sample, Settings, find
from gyro_calibration.self_calibration import METHODS, CalibrationRefused, record, self_calibrate
from gyro_calibration.simulation import simulate

DONE, NO_ANSWER, WRONG_USE = 0, 1, 2


class UsageError(ValueError):
    """The program was called in a way that cannot work; the message is one sentence."""


@dataclass(frozen=True)
class Answer:
    """What a verb found: plain words for people, and the same as data."""

    text: str
    data: dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb, print its answer and return 0 (done), 1 (the data allow no answer) or 2 (wrong use)."""
    given = _parser().parse_args(arguments)
    try:
        answer = given.verb(given)
    except CalibrationRefused as error:
        print(f'gyro_calibration: {error}', file=sys.stderr)
        return NO_ANSWER
    except (LogError, ModelError, MotionError, UsageError, OSError) as error:
        print(f'gyro_calibration: {error}', file=sys.stderr)
        return WRONG_USE
    if answer is not None:
        print(json.dumps(answer.data) if given.json else answer.text)
    return DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='gyro_calibration', description='Calibrate a gyro, so that a robot knows its heading.')
    parser.add_argument('--version', action='version', version=__version__)
    verbs = parser.add_subparsers(required=True, metavar='VERB')
    for add in (_add_compensate, _add_self_calibrate, _add_simulate, _add_emulate, _add_demo):
        verb = add(verbs)
        verb.add_argument('--json', action='store_true', help='print one JSON object and nothing else')
    return parser


def _verb(verbs: Any, name: str, function: Callable[[argparse.Namespace], Answer | None], summary: str,
          example: str) -> argparse.ArgumentParser:
    parser = verbs.add_parser(name, help=summary, description=f'{summary[0].upper()}{summary[1:]}.',
                              epilog=f'example: gyro_calibration {name} {example}')
    parser.set_defaults(verb=function, name=name)
    return parser


def _add_log(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('log', metavar='LOG', help='file in the log format, .csv or .csv.gz')
    parser.add_argument('--rate', type=_positive, metavar='HZ', help='the samples come at this rate; for logs without a usable time_s')
    parser.add_argument('--sensitivity', type=_positive, metavar='DPS', help='deg/s a count, for logs that hold gyro_counts alone')
    parser.add_argument('--invert', action='store_true', help='the gyro counts clockwise turns positive')


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value


def _not_negative(text: str) -> float:
    return 0.0 if float(text) == 0.0 else _positive(text)


def _read_log(given: argparse.Namespace) -> Log:
    """Read the log that a verb was given, as its options say."""
    log = read_log(given.log, None if given.sensitivity is None else given.sensitivity * DEGREE, given.rate)
    return replace(log, output=-_output(given, log)) if given.invert else log


def _output(given: argparse.Namespace, log: Log) -> Array:
    if log.output is None:
        raise UsageError(f'{given.log}: holds gyro_counts alone; say with --sensitivity how many deg/s a count is')
    return log.output


def _timed(given: argparse.Namespace, log: Log) -> Array:
    if log.time is None:
        raise UsageError(f'{given.log}: has no time_s, which {given.name} needs; say with --rate how many samples a second it holds')
    return log.time


# compensate

def _add_compensate(verbs: Any) -> argparse.ArgumentParser:
    parser = _verb(verbs, 'compensate', _compensate, 'add compensated rates, and for samples in time the heading, to a log',
                   'drive.csv --model model.yaml --out compensated.csv')
    _add_log(parser)
    parser.add_argument('--model', required=True, metavar='MODEL.yaml')
    parser.add_argument('--out', required=True, metavar='OUT.csv', help='.csv or .csv.gz')
    parser.add_argument('--threshold', type=_not_negative, default=0.0, metavar='DPS',
                        help='a robot that turns slower stands, as 0.3 in the node; default: 0, off')
    parser.add_argument('--window', type=_not_negative, default=0.2, metavar='S', help='of the threshold filter; 0 is single samples')
    return parser


def _compensate(given: argparse.Namespace) -> Answer:
    model, log = read_model(given.model), _read_log(given)
    output = _output(given, log)
    known = np.isfinite(output)
    if not known.any():
        raise CalibrationRefused(f'{given.log}: no output of the gyro is a number; record again')
    time, temperature = (None if each is None else each[known] for each in (log.time, log.temperature))
    columns = _compensated_columns(given, model, time, output[known], temperature)
    write_log(given.out, log, {name: _at(known, values) for name, values in columns.items()})
    return _compensated_answer(given, log, columns)


def _compensated_columns(given: argparse.Namespace, model: GyroModel, time: Array | None, output: Array,
                         temperature: Array | None) -> dict[str, Array]:
    result, uncertainty = compensate(model, output, temperature), covariance(model)
    sensitivity = rate_sensitivity(model, output, result.rate, result.temperature)
    variance = quadratic_form(uncertainty, sensitivity)
    columns = {'rate_rad_s': result.rate}
    if time is not None:
        variance = variance + model.noise.rate_variance(float(np.median(np.diff(time))))
        threshold = Threshold(given.threshold * DEGREE, given.window, model.noise.angle_random_walk)
        columns['rate_rad_s'] = filter_rates(threshold, time, result.rate)
        columns['heading_rad'], columns['heading_std_rad'] = integrate_with_deviation(
            time, result.rate, columns['rate_rad_s'], sensitivity, uncertainty, model.noise)
    columns['rate_std_rad_s'] = np.sqrt(np.broadcast_to(variance, output.shape))
    columns['temperature_clipped'] = np.broadcast_to(result.temperature_clipped, output.shape)
    columns['beyond_range'] = result.beyond_range
    return columns


def _at(known: Array, values: Array) -> Array:
    """Return the values at the rows where the output is known, and nan at the others."""
    whole = np.full(len(known), np.nan)
    whole[known] = values
    return whole


def _compensated_answer(given: argparse.Namespace, log: Log, columns: dict[str, Array]) -> Answer:
    data: dict[str, Any] = {'out': given.out, 'rows': len(log), 'rows_without_output': len(log) - len(columns['rate_rad_s']),
                            'temperature_known': log.temperature is not None}
    data.update({name: int(columns[name].sum()) for name in ('temperature_clipped', 'beyond_range')})
    lines = [f'{len(log)} rows compensated by {given.model}, written to {given.out}.']
    if 'heading_rad' in columns:
        heading, deviation = (float(columns[name][-1]) for name in ('heading_rad', 'heading_std_rad'))
        data.update(heading_rad=heading, heading_std_rad=None if math.isnan(deviation) else deviation)
        known = '' if math.isnan(deviation) else f' +- {deviation / DEGREE:.2f}'
        lines.append(f'Heading at the end: {heading / DEGREE:.2f}{known} deg.')
    if log.temperature is None:
        lines.append('The log holds no temperature: the model was used at its reference temperature.')
    for name, words in (('rows_without_output', 'rows have no output of the gyro; the heading is integrated across them.'),
                        ('temperature_clipped', 'rows are outside the calibrated temperatures; the nearest end was used.'),
                        ('beyond_range', 'rows are beyond the calibrated rates; the correction is extrapolated.')):
        if data[name]:
            lines.append(f'{data[name]} {words}')
    return Answer('\n'.join(lines), data)


# self-calibrate

def _add_self_calibrate(verbs: Any) -> argparse.ArgumentParser:
    parser = _verb(verbs, 'self-calibrate', _self_calibrate, 'find scale factor error and bias from about 20 s of known motion',
                   'run.csv --profile profile.csv --out model.yaml')
    _add_log(parser)
    parser.add_argument('--profile', metavar='PROFILE.csv', help='time_s and heading_deg or rate_dps; default: the reference of the log')
    parser.add_argument('--method', choices=list(METHODS), default='likelihood', help='default: likelihood; the others as published')
    parser.add_argument('--model', metavar='MODEL.yaml', help='compensate by it first')
    parser.add_argument('--out', metavar='MODEL.yaml', help='write the model with this self-calibration')
    return parser


def _self_calibrate(given: argparse.Namespace) -> Answer:
    model = read_model(given.model) if given.model else GyroModel()
    log = _read_log(given)
    time, output = _timed(given, log), _output(given, log)
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
                raise CalibrationRefused(f'{given.log}: the reference is lost nearly everywhere; give the motion by --profile')
            return motion(time[known], values[known]), float(time[known][0])
    raise UsageError(f'{given.log}: holds no reference; give the motion by --profile')


# simulate

def _add_motion(parser: argparse.ArgumentParser, **how: Any) -> None:
    parser.add_argument('--motion', metavar='FILE|NAME', help=f'a motion profile, or one of {", ".join(NAMED)}', **how)
    parser.add_argument('--sample-rate', type=_positive, default=100.0, metavar='HZ', help='default: 100')
    parser.add_argument('--temperature', type=float, metavar='DEGC', help='default: the reference temperature of the model')
    parser.add_argument('--seed', type=int, help='of the noise; default: another one each time')


def _add_simulate(verbs: Any) -> argparse.ArgumentParser:
    parser = _verb(verbs, 'simulate', _simulate, 'write the log of a simulated gyro',
                   '--model model.yaml --motion robot --out log.csv --seed 1')
    parser.add_argument('--model', required=True, metavar='MODEL.yaml')
    _add_motion(parser, required=True)
    parser.add_argument('--out', required=True, metavar='LOG.csv', help='.csv or .csv.gz')
    return parser


def _simulate(given: argparse.Namespace) -> Answer:
    log, seed = _simulated(given)
    duration = float(_timed(given, log)[-1])
    write_log(given.out, replace(log, notes=(f'simulated with {given.model}, motion {given.motion}, seed {seed}',)))
    data = {'out': given.out, 'rows': len(log), 'duration_s': duration, 'seed': seed}
    return Answer(f'{len(log)} samples over {duration:g} s, seed {seed}, written to {given.out}.', data)


def _simulated(given: argparse.Namespace) -> tuple[Log, int]:
    seed = secrets.randbits(32) if given.seed is None else given.seed
    if given.motion not in NAMED and not Path(given.motion).exists():
        raise UsageError(f'{given.motion}: there is no such motion; name a file, or one of {", ".join(NAMED)}')
    motion = NAMED[given.motion] if given.motion in NAMED else read_motion(given.motion)
    return simulate(read_model(given.model), motion, given.sample_rate, np.random.default_rng(seed), given.temperature), seed


# emulate

def _add_emulate(verbs: Any) -> argparse.ArgumentParser:
    parser = _verb(verbs, 'emulate', _emulate, 'be a gyro on a pseudo-terminal, from a model and a motion or from a log; prints its path',
                   '--protocol kvh_dsp3000 --model model.yaml --motion robot --link /tmp/gyro')
    parser.add_argument('--protocol', required=True, metavar='NAME', help=f'one of {", ".join(PROTOCOLS)}; later {", ".join(PLANNED)}')
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument('--log', metavar='LOG', help='send a recording')
    source.add_argument('--model', metavar='MODEL.yaml', help='send what a simulated gyro says')
    _add_motion(parser, default='rest')
    parser.add_argument('--rate', type=_positive, metavar='HZ', help='the log was taken at this rate; for logs without a usable time_s')
    parser.add_argument('--sensitivity', type=_positive, metavar='DPS', help='deg/s a count of the wire format; default: its own')
    parser.add_argument('--columns', default='time_s,gyro_dps,temperature_degc', help='of the protocol csv; default: %(default)s')
    parser.add_argument('--link', metavar='PATH', help='a link to the pseudo-terminal, whose own name changes')
    parser.add_argument('--speed', type=_positive, default=1.0, help='times real time; default: 1')
    parser.add_argument('--wait', action='store_true', help='begin when a program has opened the port')
    parser.add_argument('--repeat', action='store_true', help='begin again at the end')
    parser.set_defaults(invert=False)
    return parser


def _emulate(given: argparse.Namespace) -> None:
    """Print the path at once, since the answer of this verb is what goes on until it ends."""
    protocol, settings = _wire(given)
    log = _read_log(given) if given.log else _simulated(given)[0]
    samples = _samples(_timed(given, log), _output(given, log), log.temperature, given.repeat)
    emulator = Emulator(protocol, samples, settings, given.speed, given.link, given.wait)
    _handle_signals(lambda *_: emulator.stop())
    try:
        emulate(emulator, lambda path: print(json.dumps({'path': path, 'protocol': protocol.name}) if given.json else path, flush=True))
    finally:
        _handle_signals(signal.SIG_IGN)  # launch sends a second one, which must not hit a program that is about to end


def _handle_signals(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _wire(given: argparse.Namespace) -> tuple[Protocol, Settings]:
    sensitivity = None if given.sensitivity is None else given.sensitivity * DEGREE
    try:
        protocol, settings = find(given.protocol), Settings(sensitivity=sensitivity, columns=tuple(given.columns.split(',')))
        protocol.check(settings)
    except ValueError as error:
        raise UsageError(str(error)) from None
    return protocol, settings


def _samples(time: Array, output: Array, temperature: Array | None, again: bool) -> Iterator[Sample]:
    """Give the samples of a log that have an output, and all of them again and again where that is wanted."""
    known = np.isfinite(output)
    times, outputs = time[known] - time[known][0], output[known].tolist()
    temperatures = repeat(None) if temperature is None else temperature[known].tolist()
    length = float(times[-1] + np.median(np.diff(times)))
    for start in chain([0.0], (length * number for number in range(1, sys.maxsize if again else 1))):
        yield from (Sample(output, temperature, start + time) for time, output, temperature in zip(times.tolist(), outputs, temperatures))


# demo

def _add_demo(verbs: Any) -> argparse.ArgumentParser:
    parser = _verb(verbs, 'demo', _demo, 'emulated gyro, driver, compensation, self-calibration and a drive, on this machine', '--out demo')
    parser.add_argument('--out', default='demo', metavar='DIR', help='where picture, table and log go; default: %(default)s')
    parser.add_argument('--seed', type=int, help='of the noise; default: another one each time')
    return parser


def _demo(given: argparse.Namespace) -> Answer:
    try:
        from gyro_calibration.demo import run_demo
    except ImportError as error:
        raise UsageError(f'the demo needs ROS 2 and matplotlib ({error}); source ROS 2, or install gyro_calibration[ros,plot]') from None
    seed = secrets.randbits(32) if given.seed is None else given.seed
    result = run_demo(Path(given.out), seed)
    return Answer(result.text, result.data)
