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
Published numbers of the sources of gyro_calibration, the numbers computed here, contradictions.

This package is evidence and no part of the product: it imports gyro_calibration as any other
program does, and only the verbs `reproduce` and `demo` import it.

There is one file for each source; `finding` holds the common records. Published numbers are in the
units of their source. Each file has a function ``reproduce(generator, runs)``: the
generator of the noise; the number of simulated drives or turntable runs (a twentieth of it for
calibrations on a rate table).
"""

from gyro_calibration_reproduction import bot_thoughts, hong_park, ojeda_chung_borenstein

#: In order of publication.
SOURCES = {'ojeda': ojeda_chung_borenstein.reproduce, 'hong_park': hong_park.reproduce,
           'bot_thoughts': bot_thoughts.reproduce}
