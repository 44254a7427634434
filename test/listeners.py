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
Subscribers in a process of their own, each a participant of its own, to all that nodes say.

    python listeners.py NUMBER

"""

import signal
import sys
import threading

from diagnostic_msgs.msg import DiagnosticArray
from gyro_calibration.ros.runner import SENSOR_QOS
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu


def listener(number):
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f'listener_{number}', context=context)
    node.create_subscription(Imu, 'imu/data', lambda message: None, SENSOR_QOS)
    node.create_subscription(DiagnosticArray, '/diagnostics', lambda message: None, 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    return executor


def main():
    stop = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    executors = [listener(number) for number in range(int(sys.argv[1]))]
    print('listening', flush=True)
    while not stop.is_set():
        for executor in executors:
            executor.spin_once(timeout_sec=0.001)


if __name__ == '__main__':
    main()
