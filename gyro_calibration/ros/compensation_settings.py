"""The parameters of the compensation node, and what they mean to the rooms that it joins."""

from __future__ import annotations

from types import SimpleNamespace

from gyro_calibration.assumptions import Assumptions
from gyro_calibration.heading import Threshold
from gyro_calibration.log import DEGREE
from gyro_calibration.noise import Noise
from gyro_calibration.ros.runner import Parameter
from gyro_calibration.ros.wheels import Standing
from gyro_calibration.self_calibration import Limits, Reference
from gyro_calibration.tracking import Settings

PARAMETERS = (
    Parameter('model_file', '', 'Model of the gyro (YAML); empty for none.'),
    Parameter('calibration_file', '', 'Where calibrations are kept; empty for a file in ROS_HOME named after the node.'),
    Parameter('bias_file', '', 'Where biases at rest are kept; empty for a file beside the calibration.'),
    Parameter('standing', 'rest', 'What finds rests: rest, threshold or none.', dynamic=True, choices=('rest', 'threshold', 'none')),
    Parameter('rest_false_alarms', 0.1, 'Rests taken for motion, in an hour at rest.', '1/h', (0.001, 100.0), True),
    Parameter('threshold', 0.3 * DEGREE, 'Below this rate the robot stands; 0 switches the filter off.', 'rad/s', (0.0, 0.1), True),
    Parameter('threshold_window', 0.2, 'The mean over it counts; 0 looks at single samples.', 's', (0.0, 5.0), True),
    Parameter('rest_test', True, 'Where the noise is known, a window that varies by more is motion, whatever its mean.', dynamic=True),
    Parameter('wheels', 'none', 'What tells of the wheels: none, odom, cmd_vel or both.', choices=('none', 'odom', 'cmd_vel', 'both')),
    Parameter('cmd_vel_stamped', False, 'Whether cmd_vel is a TwistStamped.'),
    Parameter('wheel_linear_limit', 0.001, 'Up to this speed wheels stand.', 'm/s', (0.0, 1.0)),
    Parameter('wheel_angular_limit', 0.0002, 'Up to this speed wheels stand.', 'rad/s', (0.0, 1.0)),
    Parameter('uncalibrated_bias', 0.5 * DEGREE, 'Standard deviation of a bias that nobody calibrated.', 'rad/s', (0.0, 1.0)),
    Parameter('uncalibrated_scale_factor_error', 0.03, 'Standard deviation of a scale factor error that nobody calibrated.', '1',
              (0.0, 1.0)),
    Parameter('bias_temperature_coefficient', 0.03 * DEGREE,
              'Standard deviation of what the bias does with the temperature; 0 for a gyro that compensates it by itself.', 'rad/s/K',
              (0.0, 0.1)),
    Parameter('check_false_alarms', 0.001, 'False alarms of the check of noise and bias, in an hour at rest; 0 switches it off.', '1/h',
              (0.0, 1.0)),
    Parameter('maximum_gap', 1.0, 'Over a longer gap in the stamps nothing is integrated.', 's', (0.01, 60.0)),
    Parameter('temperature_timeout', 10.0, 'An older temperature is held, and counts as less and less known.', 's', (0.1, 3600.0)),
    Parameter('sample_timeout', 5.0, 'A calibration is given up when no sample comes for so long.', 's', (0.1, 60.0)),
    Parameter('reference', 'profile', 'What calibrate compares with: profile, odometry or turns.', dynamic=True,
              choices=('profile', 'odometry', 'turns')),
    Parameter('profile_file', '', 'Motion profile of calibrate (CSV); empty for the built-in one of 20 s.'),
    Parameter('reference_duration', 20.0, 'Length of a calibration by odometry.', 's', (5.0, 600.0), True),
    Parameter('odometry_scale_deviation', 0.01, 'Standard deviation of the scale of turns by odometry.', '1', (0.0, 0.5), True),
    Parameter('turns', 5, 'Whole turns of a calibration by turns, counter-clockwise positive; 0 lets the gyro count.', '', (-100, 100),
              True),
    Parameter('bias_duration', 15.0, 'Length of a calibration at rest.', 's', (1.0, 600.0), True),
    Parameter('drive_profile', False, 'Drive the motion profile on cmd_vel during calibrate.', dynamic=True),
    Parameter('check_after_run', True, 'Two seconds at rest after a run decide whether its calibration holds.', dynamic=True),
    Parameter('maximum_time_offset', 1.0, 'The gyro may lag the motion profile by so much, either way.', 's', (0.0, 10.0)),
    Parameter('maximum_residual', 1.0 * DEGREE,
              'A calibration is refused where a stretch turned otherwise than the profile by more than this.', 'rad', (0.0, 1.0)),
    Parameter('maximum_scale_factor_error', 0.3, 'A calibration with a larger one is refused.', '1', (0.0, 0.9)),
    Parameter('maximum_bias', 10.0 * DEGREE, 'A calibration with a larger one is refused.', 'rad/s', (0.0, 10.0)),
)


def tracking_settings(values: SimpleNamespace, noise: Noise) -> Settings:
    """Return how the heading is tracked; without known noise, rests are found by the threshold filter alone."""
    rate = 0.0 if values.standing == 'none' else values.threshold
    threshold = Threshold(rate, values.threshold_window, noise.angle_random_walk if values.rest_test else 0.0)
    return Settings(values.rest_false_alarms if values.standing == 'rest' else 0.0, threshold, values.maximum_gap)


def assumptions(values: SimpleNamespace) -> Assumptions:
    """Return what is taken of values that nobody calibrated."""
    return Assumptions(values.uncalibrated_bias, values.uncalibrated_scale_factor_error, values.bias_temperature_coefficient)


def limits(values: SimpleNamespace) -> Limits:
    """Return what a calibration must keep to."""
    return Limits(scale_factor_error=values.maximum_scale_factor_error, bias=values.maximum_bias, residual=values.maximum_residual,
                  time_offset=values.maximum_time_offset)


def odometry(values: SimpleNamespace) -> Reference:
    """Return how good odometry is."""
    return Reference(scale_deviation=values.odometry_scale_deviation)


def standing_wheels(values: SimpleNamespace) -> Standing:
    """Return the speeds up to which wheels stand."""
    return Standing(values.wheel_linear_limit, values.wheel_angular_limit)
