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
Calibrate a gyro, so that a robot knows its heading.

Words. The *output* is what the gyro reports, the *rate* is the true rate about its input axis, the
*heading* is the integral of the rate. Each error is one *effect*, and
``output = rate + errors(rate, output, temperature) + noise``.

Frames. Everything is about one axis, z of the gyro's frame, counter-clockwise positive (REP-103).

Units. SI inside: rad, rad/s, s, K for differences; temperatures are in degC. Other units exist
only in files, wires and the command line, where the name says so: ``gyro_dps``.

Reading order: `logs`, `model`, `heading`, `calibration`, `allan`, `diagnosis`, `fleet`, `reproduction`;
then, with ports, processes and ROS 2, `driver`, `ros`, `cli`. Each folder imports only what
stands before it, and so does each module of a folder, by the reading order that its docstring
gives. `files` opens and writes files for all of them.

"""

__version__ = '0.2.0'
