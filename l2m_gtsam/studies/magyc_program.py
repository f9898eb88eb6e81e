"""Program for the environment of `magyc`: calibrates a drive from one file into another.

It is run by the Python of that environment, which has numpy and magyc but nothing of this
project: ``python -I magyc_program.py drive.npz result.npz``. Fields are in gauss, the unit that
magyc is made for, turn rates in rad/s, times in seconds.
"""

import sys
import time

import magyc
import numpy as np


def main(source: str, target: str) -> None:
    """Calibrate a drive: NaN where magyc ends without a result."""
    hard_iron = np.full(3, np.nan)
    with np.load(source) as drive:
        begin = time.perf_counter()
        try:
            offset, matrix, _ = magyc.magyc_ls(drive["field"], drive["rate"], drive["time"])
            if np.isfinite([*offset, *np.ravel(matrix)]).all():
                hard_iron = offset
        except (np.linalg.LinAlgError, ValueError):
            pass
        seconds = time.perf_counter() - begin
    np.savez(target, hard_iron=hard_iron, seconds=seconds)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
