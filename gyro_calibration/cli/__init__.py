"""
What the program can do: one file a verb.

Each has a function ``add`` that describes the verb to argparse, and a function from its arguments
to an `Answer`. Units that people use are converted here.

"""

from gyro_calibration.cli import (
    allan,
    compensate,
    demo,
    diagnose,
    emulate,
    fit,
    plan,
    record,
    reproduce,
    self_calibrate,
    simulate,
    turn,
)

VERBS = (fit, compensate, self_calibrate, plan, allan, turn, diagnose, simulate, emulate, record,
         reproduce, demo)
