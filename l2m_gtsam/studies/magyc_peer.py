"""The calibrator from the package index: `magyc`, which wants a gyroscope and a uniform field.

It uses no map. From readings and turn rates it estimates H and the soft iron, which is not used
here: where the field is the same everywhere it changes, seen from the sensor, only as the sensor
turns, dB/dt = -w x B. Position, rotation and scale remain open. What it needs contradicts what we
need (numpy below 2), so that it has an environment of its own, made by ``make magyc``.

It is made for chips that hold both a magnetometer and a gyroscope, along the same axes, and wants
them so: six degrees between the two cost it 1.5 uT. A study that knows the truth gives it the rates
that a gyroscope on the sensor's own chip would measure, up to the noise of the poses.
"""

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.errors import PeerError

PYTHON_VARIABLE = "L2M_MAGYC_PYTHON"
PYTHON = Path(".venv-magyc/bin/python")
PROGRAM = Path(__file__).with_name("magyc_program.py")
GAUSS = 100.0  # microtesla


@dataclass(frozen=True)
class FoundOffset:
    """What magyc makes of a drive: H in uT, shape (3,), NaN without a result, and its seconds."""

    H: FloatArray
    seconds: float


def magyc_python() -> Path:
    """Return the Python of the environment of magyc.

    Raises
    ------
    PeerError
        There is none, neither at ``L2M_MAGYC_PYTHON`` nor in this folder.
    """
    python = Path(os.environ.get(PYTHON_VARIABLE, PYTHON))
    if not python.is_file():
        raise PeerError(
            f"magyc has no environment at {python}: run `make magyc`, or name its Python in "
            f"{PYTHON_VARIABLE}"
        )
    # The link in bin/ is what makes it that environment: never resolved.
    return python.absolute()


def magyc_peer(readings: Readings, R_mag_lidar: FloatArray, python: Path) -> FoundOffset:
    """Return what magyc finds on a drive; all readings enter, for it differences them.

    Parameters
    ----------
    readings
        Of one magnetometer, with ``motion``.
    R_mag_lidar
        Rotation from the lidar to the chip, shape (3, 3): turns the lidar's rates into the chip's.
    python
        Of the environment of magyc.

    Raises
    ------
    PeerError
        Readings without motion, or a program that cannot be run.
    """
    if readings.motion is None:
        raise PeerError("magyc needs turn rates: the readings have no motion")
    with TemporaryDirectory() as folder:
        source, target = Path(folder, "drive.npz"), Path(folder, "result.npz")
        np.savez(
            source,
            allow_pickle=False,
            field=readings.field / GAUSS,
            rate=readings.motion.twist_lidar[:, :3] @ R_mag_lidar.T,
            time=(readings.stamp_ns - readings.stamp_ns[:1]) * 1e-9,
        )
        _run(python, source, target)
        with np.load(target) as result:
            return FoundOffset(result["hard_iron"] * GAUSS, float(result["seconds"]))


def _run(python: Path, source: Path, target: Path) -> None:
    """Run the program isolated: neither our packages nor our folders are to be found by it."""
    command = [str(python), "-I", str(PROGRAM), str(source), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode or not target.exists():
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise PeerError(f"magyc does not run in {python}: {last}; make its environment anew")
