"""Arrays become drives, or one line says what is wrong with them."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import l2m_gtsam as l2m
from l2m_gtsam.errors import InputError, L2MError, UnitsError
from l2m_gtsam.recording.sync import SyncOptions, synchronise

COUNT = 40
SECONDS = 1000.0 + 0.1 * np.arange(COUNT)
P = np.column_stack([0.1 * np.arange(COUNT), np.zeros(COUNT), np.ones(COUNT)])
Q = Rotation.from_rotvec(np.outer(np.arange(COUNT), [0, 0, 0.02])).as_quat()
FIELD = np.array([20.0, 5.0, -40.0]) + np.sin(np.arange(COUNT))[:, None]


def given(**changed: Any) -> dict[str, Any]:
    usual = {
        "stamps": SECONDS,
        "positions": P,
        "orientations": Q,
        "fields": {"mag": (SECONDS, FIELD)},
    }
    return {**usual, **changed}


def test_seconds_and_nanoseconds_quaternions_and_matrices_are_one() -> None:
    one = l2m.drive(**given())
    stamps = np.round(SECONDS * 1e9).astype(np.int64)
    R = Rotation.from_quat(Q).as_matrix()
    field = {"mag": (stamps, FIELD / 100)}
    other = l2m.drive(stamps, P.tolist(), R, field, units="gauss")
    np.testing.assert_array_equal(one.trajectory.stamp_ns, other.trajectory.stamp_ns)
    np.testing.assert_allclose(one.trajectory.R, other.trajectory.R, atol=1e-12)
    np.testing.assert_allclose(one.series[0].field, other.series[0].field, rtol=1e-12)
    counts = l2m.drive(**given(fields={"mag": (SECONDS, FIELD / 0.0578)}, units=0.0578))
    np.testing.assert_allclose(counts.series[0].field, FIELD, rtol=1e-12)
    stronger = l2m.drive(**given(fields={"mag": (SECONDS, 1.1 * FIELD)}))
    assert one.source.sha256 != stronger.source.sha256


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"positions": P[:, :2]}, r"positions: of shape \(40, 2\); needed is \(40, 3\)"),
        ({"positions": P[1:]}, r"positions: of shape \(39, 3\)"),
        ({"positions": np.full_like(P, np.nan)}, "positions: a number is not finite"),
        ({"positions": "here"}, "positions: not an array of numbers"),
        ({"orientations": Q * 2}, "quaternions x, y, z, w must have length 1"),
        ({"orientations": -np.tile(np.eye(3), (COUNT, 1, 1))}, "matrices must be rotations"),
        ({"stamps": SECONDS[::-1]}, "each later than the one before"),
        ({"stamps": SECONDS * 1e9}, "floating-point times must be seconds"),
        ({"stamps": [str(s) for s in SECONDS]}, "stamps: .*needed are numbers"),
        ({"fields": {}}, "fields: an empty dict was given"),
        ({"fields": {"m": (SECONDS[1:], FIELD)}}, r"fields\['m'\]: readings: of shape"),
        ({"units": "furlong"}, "'furlong' is not known; accepted: tesla, .* microtesla per count"),
        ({"units": -1.0}, "accepted: tesla"),
        ({"pose_covariance": -np.eye(6)}, "pose_covariance: must be symmetric"),
        ({"pose_covariance": np.eye(3)}, r"pose_covariance: of shape \(3, 3\)"),
    ],
)
def test_what_does_not_fit_is_one_line(changed: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told) as error:
        l2m.drive(**given(**changed))
    assert "\n" not in str(error.value)


def test_arrays_that_are_written_into_later_change_no_drive() -> None:
    """No array is shared with the caller."""
    R, t = np.tile(np.eye(3), (COUNT, 1, 1)), np.zeros(3)
    covariance = np.tile(np.eye(6), (COUNT, 1, 1))
    arguments = given(orientations=R, pose_covariance=covariance)
    made, known = l2m.drive(**arguments), l2m.known_sensor("mag", t)
    trajectory, series = made.trajectory, made.series[0]
    kept = (trajectory.stamp_ns, trajectory.R, trajectory.p, trajectory.covariance)
    theirs = [R, t, covariance, arguments["stamps"], arguments["positions"]]
    theirs += [array for pair in arguments["fields"].values() for array in pair]
    for array in (*kept, series.stamp_ns, series.field, known.t_lidar_mag):
        assert not any(np.shares_memory(array, each) for each in theirs)


def test_units_are_checked() -> None:
    with pytest.raises(UnitsError, match=r"0.4.* uT, as read in microtesla.*`units: gauss`"):
        l2m.drive(**given(fields={"mag": (SECONDS, FIELD / 100)}))


def test_constant_readings_are_checked_too() -> None:
    constant = np.tile([0.0, 2e-5, -4e-5], (COUNT, 1))
    with pytest.raises(UnitsError, match=r"^fields\['mag'\]: .* in microtesla.*`units: tesla`"):
        l2m.drive(**given(fields={"mag": (SECONDS, constant)}))
    for stuck in (np.tile([0.0, 20.0, -40.0], (COUNT, 1)), np.zeros((COUNT, 3))):
        l2m.drive(
            **given(fields={"mag": (SECONDS, stuck)})
        )  # its calibration says that it is stuck


def test_a_sensor_without_readings_is_one_of_several() -> None:
    fields: dict[str, Any] = {"mag": (SECONDS, FIELD), "none": ([], [])}
    assert [len(each) for each in l2m.drive(**given(fields=fields)).series] == [COUNT, 0]
    nothings: list[Any] = [([], []), (SECONDS, np.full_like(FIELD, np.nan))]
    for nothing in nothings:
        with pytest.raises(InputError, match="no finite reading in mag"):
            l2m.drive(**given(fields={"mag": nothing}))


def test_of_readings_with_one_stamp_the_first_counts() -> None:
    twice = np.repeat(SECONDS[::2], 2)
    recording = l2m.drive(**given(fields={"mag": (twice, FIELD)}))
    found = synchronise(recording, SyncOptions(thin_distance_m=0, thin_angle_deg=0))
    assert found.counts[0].repeated == COUNT // 2
    np.testing.assert_array_equal(found.readings.field, FIELD[::2][: len(found.readings)])
    with pytest.raises(InputError, match=r"fields\['mag'\]: stamps: all are 0"):
        l2m.drive(**given(fields={"mag": (0 * SECONDS, FIELD)}))


def test_known_sensors() -> None:
    sensor = l2m.known_sensor("mag", [0.1, 0, 0], np.diag([1.0, 1.1, 0.9]), [1, 2, 3])
    np.testing.assert_array_equal(sensor.distortion.H, [1, 2, 3])
    for wrong in (np.zeros((3, 3)), np.eye(2)):
        with pytest.raises(InputError, match=r"C: of shape|C cannot be inverted"):
            l2m.known_sensor("mag", C=wrong)


def test_names_are_there_and_no_others() -> None:
    assert l2m.__version__
    assert set(l2m.__all__) <= set(dir(l2m))
    assert all(hasattr(l2m, name) for name in l2m.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'calibrat'"):
        _ = l2m.calibrat
    assert issubclass(InputError, L2MError)


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, l2m_gtsam; l2m_gtsam.__version__; "
        "print(sorted({'numpy', 'scipy', 'gtsam', 'pydantic', 'rosbags'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
