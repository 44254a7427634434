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
The nodes: samples, wheels and services on topics, joined to the computing modules.

`pipeline` and `calibration_session` are what a node does with samples, commands and time, without
rclpy; the nodes join them to topics.

Reading order: `parameters`, `clock`, `runner`, `diagnostics`, `health_monitor`, `state_store`,
`wheels`, `driver_report`, `driver_node`, `recorder_node`, `calibration_session`, `pipeline`,
`compensation_report`, `compensation_node`.

"""

NOT_REPORTED = -1.0
"""Element 0 of the covariance of a quantity that a message does not report (REP-145)."""

UNMEASURED_VARIANCE = 1e6
"""
Variance of what a gyro with one axis does not measure, in (rad/s)², rad² or m².

All zeros would say that the whole covariance is unknown, z included. A standard deviation of
1000 rad/s gives these axes no weight in a filter, and the matrix can still be inverted.

"""
