"""
A stand-in for the package ``diagnostic_updater``, where that is not installed: the same names, parameters and messages.

Like the real one (version 4.0.0) it publishes ``/diagnostics`` with a queue of one, tells of a task when it is added, goes by a timer of
the node's clock, declares its two parameters, holds a lock while tasks run, and warns where no hardware is named.

"""

import threading

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus


class Updater:
    """Calls tasks that fill in a status, and publishes what they say."""

    def __init__(self, node, period=1.0):
        self.node, self.tasks, self.lock, self.hwid = node, [], threading.Lock(), ''
        self.publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 1)
        self.period = node.declare_parameter('diagnostic_updater.period', period).value
        self.timer = node.create_timer(self.period, self.update)
        fully = node.declare_parameter('diagnostic_updater.use_fqn', False).value
        self.node_name = f'{node.get_namespace()}/{node.get_name()}' if fully else node.get_name()

    def setHardwareID(self, hwid):
        self.hwid = hwid

    def add(self, name, fill):
        with self.lock:
            self.tasks.append((name, fill))
            self.addedTaskCallback(name)

    def addedTaskCallback(self, name):
        self.publish([DiagnosticStatus(name=name, message='Node starting up')])

    def update(self):
        with self.lock:
            said = [fill(DiagnosticStatus(level=DiagnosticStatus.ERROR, name=name, message='No message was set', hardware_id=self.hwid))
                    for name, fill in self.tasks]
        if not self.hwid:
            self.node.get_logger().warning('diagnostic_updater: No HW_ID was set.')
        self.publish(said)

    def force_update(self):
        self.update()

    def publish(self, statuses):
        for status in statuses:
            status.name = f'{self.node_name}: {status.name}'
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self.node.get_clock().now().to_msg()
        self.publisher.publish(array)
