"""Entry of `python -m lab.calibration`."""

import tyro

from lab.calibration.calibrate import Args, main

if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m lab.calibration"))
