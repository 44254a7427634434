"""
From bytes on a serial port to stamped samples, whatever happens to the port.

Reading order: `protocols` (wire formats), `serial_port`, `timestamps`, `connection`, `decimation`,
`mcap_writer`, `recorder`, `serial_faults`, `emulator`.

"""
