"""
From bytes on a serial port to stamped samples, whatever happens to the port.

Reading order: `protocols` (wire formats), `serial_port`, `timestamps`, `host_clock`, `connection`, `mcap_writer`, `recorder`,
`serial_faults`, `emulator`.

"""
