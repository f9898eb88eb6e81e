"""Parameters of the autopilots PX4 and ArduPilot: offsets, scales and soft iron.

In the sensor's own axes ``B_meas = M @ B + H`` with ``M = C @ R_lidar_mag`` symmetric. Both
programs hold a symmetric matrix S beside an offset, so that nothing of M is lost: PX4 has
``R (S (B_meas - offset))``, ArduPilot ``S (B_meas + offset)``; S is the inverse of M.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.storage.exports.export import Export, not_correctable, not_oriented

GAUSS_PER_MICROTESLA = 0.01
MILLIGAUSS_PER_MICROTESLA = 10.0
# PX4 takes factors of 0.1 to 3, the calibration of ArduPilot of 0.2 to 5.
PX4_SCALES, ARDUPILOT_SCALES = (0.1, 3.0), (0.2, 5.0)
PX4_SENSORS, ARDUPILOT_SENSORS = 4, 3
REAL = 9  # MAVLink's number of a 32-bit floating-point parameter
FLU_FRD = np.diag([1.0, -1.0, -1.0])
# What a symmetric matrix leaves of M; the polar factor makes it zero but for rounding.
SYMMETRIC = 1e-6
RAW = "In the axes of the readings as they were recorded, which must be raw ones."
PX4_SAYS = (
    "PX4: field = ROT (S (reading - OFF)), gauss; S: SCALE on the diagonal, ODIAG beside.",
    "CAL_MAGn_ID must be that of the sensor already.",
    "Vehicle-Id Component-Id Name Value Type",
)
ARDUPILOT_SAYS = (
    "ArduPilot: field = S (reading + OFS), milligauss; S: DIA on the diagonal, ODI beside.",
)


def correction(sensor: SensorCalibration) -> FloatArray:
    """Return S, which makes the field of readings without their offset, shape (3, 3)."""
    M = sensor.distortion.C @ sensor.R_lidar_mag
    S = np.linalg.solve(M, np.eye(3))
    return np.asarray((S + S.T) / 2)


def _unusable(sensor: SensorCalibration, scales: tuple[float, float]) -> str | None:
    # Where it sits does not matter.
    if (reason := not_correctable(sensor) or not_oriented(sensor)) is not None:
        return reason
    M = sensor.distortion.C @ sensor.R_lidar_mag
    if np.abs(M - M.T).max() > SYMMETRIC * np.abs(M).max():
        return "its rotation is not the polar factor of C, so that soft iron is not symmetric"
    diagonal, (low, high) = np.diag(correction(sensor)), scales
    if (diagonal < low).any() or (diagonal > high).any():
        shown = ", ".join(f"{each:.3g}" for each in diagonal)
        return f"scales of {shown} are outside of the {low:g} to {high:g} that are accepted there"
    return None


def px4_fault(sensor: SensorCalibration) -> str | None:
    """Return why a sensor cannot be one of PX4's."""
    return _unusable(sensor, PX4_SCALES)


def ardupilot_fault(sensor: SensorCalibration) -> str | None:
    """Return why a sensor cannot be one of ArduPilot's."""
    return _unusable(sensor, ARDUPILOT_SCALES)


def px4_parameters(sensor: SensorCalibration, number: int) -> dict[str, float]:
    """Return the parameters of PX4's magnetometer with a number, 0 the first; gauss."""
    S, offset = correction(sensor), GAUSS_PER_MICROTESLA * sensor.distortion.H
    name = f"CAL_MAG{number}_"
    return {
        **_axes(name + "{}OFF", offset),
        **_axes(name + "{}SCALE", np.diag(S)),
        **_axes(name + "{}ODIAG", (S[0, 1], S[0, 2], S[1, 2])),
    }


def ardupilot_parameters(sensor: SensorCalibration, number: int) -> dict[str, float]:
    """Return the parameters of ArduPilot's compass with a number, 0 the first; milligauss."""
    S, offset = correction(sensor), -MILLIGAUSS_PER_MICROTESLA * sensor.distortion.H
    index = "" if number == 0 else str(number + 1)
    return {
        **_axes(f"COMPASS_OFS{index}_" + "{}", offset),
        **_axes(f"COMPASS_DIA{index}_" + "{}", np.diag(S)),
        **_axes(f"COMPASS_ODI{index}_" + "{}", (S[0, 1], S[0, 2], S[1, 2])),
        f"COMPASS_SCALE{index}": 0.0,  # a factor of its own, which S has in it
    }


def _axes(name: str, values: Sequence[float] | FloatArray) -> Mapping[str, float]:
    return {name.format(axis): float(value) for axis, value in zip("XYZ", values, strict=True)}


def px4_text(export: Export) -> str:
    """Return a parameter file of QGroundControl for PX4.

    Raises
    ------
    CalibrationError
        There are more sensors than PX4 has.
    """
    _refuse_many(export, PX4_SENSORS, "PX4")
    lines = _comments(export, PX4_SAYS, [f"CAL_MAG{k}" for k in range(len(export.sensors))])
    for number, each in enumerate(export.sensors):
        for name, value in px4_parameters(each.calibration, number).items():
            lines.append("\t".join(("1", "1", name, _single(value), str(REAL))))
    return "\n".join(lines) + "\n"


def ardupilot_text(export: Export) -> str:
    """Return a parameter file for ArduPilot's ground stations.

    Raises
    ------
    CalibrationError
        There are more sensors than ArduPilot has.
    """
    _refuse_many(export, ARDUPILOT_SENSORS, "ArduPilot")
    names = [f"compass {k + 1}" for k in range(len(export.sensors))]
    lines = _comments(export, ARDUPILOT_SAYS, names)
    for number, each in enumerate(export.sensors):
        for name, value in ardupilot_parameters(each.calibration, number).items():
            lines.append(f"{name},{_single(value)}")
    return "\n".join(lines) + "\n"


def autopilot_notes(export: Export) -> tuple[str, ...]:
    """Return what is worth a warning of the sensors that are written, a sentence each."""
    notes = []
    for each in export.sensors:
        name = each.calibration.sensor
        if "vehicle_magnetometer" in name:
            notes.append(
                f"{name}: PX4 had corrected these readings with its own parameters; write these to "
                "a PX4 only if those were defaults, or calibrate sensor_mag"
            )
        if each.calibration.moving:
            numbers = ", ".join(moving.name for moving in each.calibration.moving)
            notes.append(f"{name}: the offset is that without what follows {numbers}")
    return tuple(notes)


def _refuse_many(export: Export, most: int, program: str) -> None:
    if len(export.sensors) > most:
        raise CalibrationError(
            f"{program} has {most} magnetometers, the calibration {len(export.sensors)}; calibrate "
            "those of the autopilot alone, with `bag.fields`"
        )


def _comments(export: Export, said: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return what stands before parameters: their origin, what they are, how sensors are turned."""
    lines = [*export.origin, RAW, *said]
    for name, each in zip(names, export.sensors, strict=True):
        roll, pitch, yaw = _turn_deg(each.calibration)
        lines.append(
            f"{name} is {each.frame}: to the LiDAR's axes as forward, right, down it is turned by "
            f"roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} deg"
        )
    return [f"# {line}" for line in lines]


def _turn_deg(sensor: SensorCalibration) -> FloatArray:
    """Return roll, pitch and yaw of the sensor against the LiDAR's axes in degrees, shape (3,)."""
    R = FLU_FRD @ sensor.R_lidar_mag
    yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX", degrees=True)
    return np.array([roll, pitch, yaw])


def _single(value: float) -> str:
    """Return a number with the digits of single precision."""
    return f"{value:.9g}"
