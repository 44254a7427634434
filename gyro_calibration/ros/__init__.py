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
