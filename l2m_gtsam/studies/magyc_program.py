"""Program for the environment of `magyc`: calibrates drives from one file into another.

It is run by the Python of that environment, which has numpy and magyc but nothing of this
project: ``python -I magyc_program.py drives.npz results.npz``. Fields are in gauss, the unit that
magyc is made for, turn rates in rad/s, times in seconds.
"""

import sys
import time

import magyc
import numpy as np


def main(source: str, target: str) -> None:
    """Calibrate every drive: NaN where magyc ends without a result."""
    hard_iron, soft_iron, seconds = [], [], []
    with np.load(source) as drives:
        for index in range(int(drives["count"])):
            begin = time.perf_counter()
            names = (f"{name}_{index}" for name in ("field", "rate", "time"))
            try:
                offset, matrix, _ = magyc.magyc_ls(*(drives[name] for name in names))
            except (np.linalg.LinAlgError, ValueError):
                offset, matrix = np.full(3, np.nan), np.full((3, 3), np.nan)
            seconds.append(time.perf_counter() - begin)
            hard_iron.append(offset)
            soft_iron.append(matrix)
    np.savez(target, hard_iron=hard_iron, soft_iron=soft_iron, seconds=seconds)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
