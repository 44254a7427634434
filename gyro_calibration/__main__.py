"""``python -m gyro_calibration``."""

import sys

from gyro_calibration.cli.main import main

sys.exit(main())
