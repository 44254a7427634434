"""
The nodes: samples, wheels and services on topics, joined to the computing modules.

Reading order: `runner`, `diagnostics`, `health_monitor`, `state_store`, `wheels`, `driver_report`, `driver_node`, `recorder_node`,
`compensation_settings`, `calibration_run`, `compensation_report`, `calibration_services`, `compensation_node`.

"""
