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
Every cause that a diagnosis can name: effects of the gyro, faults of reference or record, noise.

What an effect is, and in which units, stands in `effects`. Here stands what it is taken for, and
what would tell the two apart.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from gyro_calibration.diagnosis.findings import Finding
from gyro_calibration.model.effects import CATALOGUE, Effect
from gyro_calibration.model.gyro_model import GyroModel

#: Either of these serves as a reference.
REFERENCES = ('reference_rate', 'reference_heading')


@dataclass(frozen=True)
class Cause:
    """
    One cause.

    Attributes
    ----------
    name : as the catalogue of effects has it; files hold it
    sentence : what it is, for people
    units : parameter -> SI unit, for those that a diagnosis estimates
    needs : columns of a log without which it cannot be shown; 'reference' is one of `REFERENCES`
    confounders : the causes that may look the same
    separate_by : the experiment that parts it from them; '' where it has none
    along : the variable along which it shows
    of : 'gyro', 'reference', 'record' or 'noise': what is to be mended

    """

    name: str
    sentence: str
    units: Mapping[str, str]
    needs: frozenset[str]
    confounders: tuple[str, ...]
    separate_by: str
    along: str
    of: str


@dataclass(frozen=True)
class _Likeness:
    """What the diagnosis knows of an effect in addition to the catalogue of effects."""

    along: str
    confounders: tuple[str, ...] = ()
    separate_by: str = ''


_ACCELERATIONS = ('swing fast with quick reversals: a delay keeps the size of what it delays, '
                  'a lag does not')
_TEMPERATURE_CORNERS = 'heat and cool with corners, at two speeds, while the gyro rests'
_UP_AND_DOWN = 'heat and cool the gyro within one log, and start it both cold and warm'

_OF_THE_GYRO: Mapping[str, _Likeness] = {
    'bias': _Likeness('rate', ('acceleration_sensitivity', 'vibration_rectification'),
                      'turn the axis over within one power-on, with all motors off'),
    'scale_factor_error': _Likeness('rate', ('clock_rate', 'reference_scale', 'unit_error'),
                                    'close whole turns on a mark, or take a second reference'),
    'scale_factor_asymmetry': _Likeness('rate', ('quadratic_nonlinearity',),
                                        'turn both ways at many speeds, slow ones too'),
    'quadratic_nonlinearity': _Likeness('rate', ('scale_factor_asymmetry',),
                                        'turn both ways at many speeds, slow ones too, '
                                        'with the sensor on the axis of the table'),
    'cubic_nonlinearity': _Likeness('rate', ('sine_response', 'saturation'),
                                    'turn at many speeds up to full scale'),
    'sine_response': _Likeness('rate', ('cubic_nonlinearity',),
                               'turn at many speeds up to full scale'),
    'bias_temperature': _Likeness('temperature', ('rate_ramp', 'warm_up', 'supply_sensitivity'),
                                  _UP_AND_DOWN),
    'bias_temperature_quadratic': _Likeness('temperature'),
    'scale_factor_temperature': _Likeness('temperature'),
    'bias_temperature_rate': _Likeness('temperature_rate',
                                       ('thermal_lag', 'thermal_hysteresis', 'bias_step'),
                                       _TEMPERATURE_CORNERS),
    'thermal_lag': _Likeness('temperature_rate', ('bias_temperature_rate',), _TEMPERATURE_CORNERS),
    'thermal_hysteresis': _Likeness('temperature_rate', ('bias_temperature_rate', 'bias_step'),
                                    'go through the same cycle of temperature twice, '
                                    'at two speeds'),
    'warm_up': _Likeness('time', ('rate_ramp', 'bias_temperature'),
                         'start the gyro both cold and warm, and let it rest'),
    'rate_ramp': _Likeness('time', ('bias_temperature', 'warm_up', 'rate_random_walk'),
                           'record it again, from a power-on at another temperature: '
                           'what is no ramp does not repeat'),
    'bias_step': _Likeness('time', ('bias_temperature_rate', 'thermal_hysteresis'),
                           'record it again: a step happens once'),
    'heading_sensitivity': _Likeness('heading',
                                     ('reference_once_per_rev', 'acceleration_sensitivity'),
                                     'turn at several speeds, and stop at eight headings'),
    'acceleration_sensitivity': _Likeness('specific_force', ('bias', 'heading_sensitivity'),
                                          'rest in several poses within one power-on'),
    'vibration_rectification': _Likeness('vibration', ('bias',), 'rest with the motor on and off'),
    'supply_sensitivity': _Likeness('supply', ('bias_temperature',),
                                    'step the supply voltage at one temperature'),
    'interference_tone': _Likeness('frequency'),
    'bandwidth': _Likeness('rate_change', ('time_offset',), _ACCELERATIONS),
    'time_offset': _Likeness('rate_change', ('bandwidth', 'unit_error'), _ACCELERATIONS),
    'clock_rate': _Likeness('time', ('scale_factor_error',),
                            'record long, with sharp reversals at both ends'),
    'dead_zone': _Likeness('rate', ('quantization',), 'sweep slowly through zero'),
    'saturation': _Likeness('rate', ('cubic_nonlinearity',),
                            'turn faster than the limit: its code is repeated there'),
    'quantization': _Likeness('output', ('dead_zone', 'stuck_samples'),
                              'turn slowly: the set of codes shows it'),
}


def _of_an_effect(name: str, likeness: _Likeness) -> Cause:
    effect = CATALOGUE[name]
    units = {parameter.name: parameter.unit
             for parameter in effect.parameters if parameter.default is None}
    needs = effect.looks_at & {'temperature', 'specific_force', 'supply'}
    turned = likeness.along in {'rate', 'heading', 'rate_change'} and name != 'bias'
    needs = needs | {'time'} | ({'reference'} if turned or 'rate' in effect.looks_at else set())
    return Cause(name, effect.cause, units, frozenset(needs), likeness.confounders,
                 likeness.separate_by, likeness.along, 'gyro')


def _other(name: str, sentence: str, unit: str, of: str, along: str,
           needs: tuple[str, ...] = ('time',), confounders: tuple[str, ...] = (),
           separate_by: str = '') -> Cause:
    return Cause(name, sentence, {name: unit}, frozenset(needs), confounders, separate_by, along,
                 of)


_WITH_REFERENCE = ('time', 'reference')

_OTHERS = (
    _other('outliers',
           'Single samples are outliers, as from a disturbed line or a corrected checksum.', '1',
           'record', 'time'),
    _other('stuck_samples', 'The last value is repeated where a new one was due.', '1', 'record',
           'time', confounders=('quantization',),
           separate_by='turn without rest: the code of a gyro that works changes then'),
    _other('dropped_samples', 'Samples are missing from the record.', '1', 'record', 'time'),
    _other('reference_once_per_rev',
           'The reference errs once in a revolution, as an eccentric encoder or a wobbling table '
           'does.', '1', 'reference', 'heading', _WITH_REFERENCE, ('heading_sensitivity',),
           'turn at several speeds, and stop at eight headings'),
    _other('reference_scale', 'The scale of the reference itself is wrong.', '1', 'reference',
           'rate', _WITH_REFERENCE, ('scale_factor_error',),
           'close whole turns on a mark, or take a second reference'),
    _other('reference_slip',
           'The motion slipped: the reference shows a turn that the gyro did not make.', 'rad',
           'reference', 'rate_change', _WITH_REFERENCE, (), ''),
    _other('reference_quantization',
           'The reference counts in steps, and its rate between samples is as coarse.', 'rad',
           'reference', 'heading', ('time', 'reference_heading')),
    _other('unit_error',
           'The output is in another unit, or of the other sign, than its name says.', '1',
           'record', 'rate', ('reference',), ('scale_factor_error', 'time_offset'),
           'look up what the wire carries: the number itself is the evidence'),
    _other('angle_random_walk', 'The angle random walk differs from the simulated one.',
           'rad/√s', 'noise', 'frequency'),
    _other('bias_instability', 'The bias instability differs from the simulated one.', 'rad/s',
           'noise', 'frequency', confounders=('rate_random_walk',),
           separate_by='record at rest for hours'),
    _other('rate_random_walk', 'The rate random walk differs from the simulated one.',
           'rad/s/√s', 'noise', 'frequency', confounders=('bias_instability', 'rate_ramp'),
           separate_by='record at rest for hours, and again: a walk does not repeat'),
)

CAUSES: dict[str, Cause] = {
    **{name: _of_an_effect(name, likeness) for name, likeness in _OF_THE_GYRO.items()},
    **{cause.name: cause for cause in _OTHERS}}


def add_causes(effects: Iterable[Effect]) -> None:
    """Add effects of one's own, which are in the catalogue, to what a diagnosis looks for."""
    for effect in effects:
        CAUSES[effect.name] = _of_an_effect(
            effect.name, _Likeness(effect.along, separate_by=effect.shown_by))


_REMEDIES = {
    'gyro': 'add it to the model of the gyro',
    'reference': 'mend or replace the reference, or see that it does not enter a calibration',
    'record': 'mend the recording',
    'noise': 'take the figures of the extended model'}


def with_remedies(findings: Sequence[Finding], shares: Mapping[str, float],
                  model: GyroModel) -> list[Finding]:
    """Return findings with their share of the heading error, and what to do about them."""
    inside = {term.effect.name for term in model.terms}
    return [replace(each, share_of_heading_error=shares.get(each.effect), remedy=each.remedy or (
        '' if CAUSES[each.effect].of == 'gyro' and each.effect not in inside
        else _REMEDIES[CAUSES[each.effect].of])) for each in findings]
