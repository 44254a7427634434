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
Published numbers of the sources of gyro_calibration beside ours, and contradictions in them.

This is evidence, not a part of the product: it uses gyro_calibration as any other program does,
and only the verbs `reproduce` and `demo` use it.

One file a source; `finding` holds what they share. Published numbers are in the units of their
source. Each has a function ``reproduce(generator, runs, progress)``: the source of the noise; the
number of simulated drives or turntable runs, of which calibrations on a rate table are a
twentieth; and a display of how many are done.

"""

from gyro_calibration_reproduction import bot_thoughts, hong_park, ojeda_chung_borenstein

#: In the order of their years.
SOURCES = {'ojeda': ojeda_chung_borenstein.reproduce, 'hong_park': hong_park.reproduce,
           'bot_thoughts': bot_thoughts.reproduce}
