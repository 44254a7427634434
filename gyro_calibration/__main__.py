"""``python -m gyro_calibration``."""

import sys

from gyro_calibration.command_line import main

sys.exit(main())
