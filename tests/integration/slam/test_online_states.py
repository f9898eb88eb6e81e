"""Saved states of a localisation on line, and what becomes of them."""

from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import give, messages
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.storage import online_log
from l2m_gtsam.storage.online_log import SavedState, read_state, write_state
from tests.drives.online import (
    OPTIONS,
    WORLD,
    Hall,
    OnlineRun,
    driven,
    in_map,
)
from tests.drives.slam import calibrated
from tests.worlds.exact import dipole_world


def test_killed_and_resumed_it_goes_on(hall: Hall, plain: OnlineRun, tmp_path: Path) -> None:
    """Killed at 12 s, resumed from its file: the poses after it are those of a run unbroken.

    The open section is closed for the state, and stays linearised: by a tenth of a sigma.
    """
    sensors, drive = hall
    given = list(messages(drive.recording))
    slam, half = in_map(hall), len(given) // 2
    before = [pose for message in given[:half] for pose in give(slam, message)]
    path = tmp_path / "state.npz"
    write_state(path, saved_state(slam))
    again = resumed_slam(read_state(path), calibrated(sensors), OPTIONS, WORLD)
    run = driven(again, given[half:])
    assert run.kinds == [EventKind.RESUMED]
    whole = OnlineRun((*before, *run.poses), run.events).trajectory()
    expected = plain.trajectory()
    np.testing.assert_array_equal(whole.stamp_ns, expected.stamp_ns)
    assert expected.covariance is not None
    sigma = np.sqrt(np.einsum("kii->ki", expected.covariance[:, 3:, 3:]))
    assert (np.abs(whole.p - expected.p) / sigma).max() < 0.1


def test_a_state_of_something_else_is_refused(hall: Hall, tmp_path: Path) -> None:
    sensors, drive = hall
    slam = in_map(hall)
    for message in list(messages(drive.recording))[:300]:
        give(slam, message)
    state = saved_state(slam)
    with pytest.raises(ConfigError, match="another calibration"):
        resumed_slam(state, calibrated(sensors[:1]), OPTIONS, WORLD)
    other = OPTIONS.model_copy(update={"max_pose_gap_s": 0.4})
    with pytest.raises(ConfigError, match="another calibration"):
        resumed_slam(state, calibrated(sensors), other, WORLD)
    for name in (
        "state.following.branches[].last.belief.pose",
        "state.intake.poses[].stamp_ns",
        "state.base",
        "state.intake.sensors#",
    ):
        whole = state.arrays[name]
        for wrong in ({}, {name: whole[:-1]}, {name: np.append(whole, whole[-1:])}):
            arrays = {k: v for k, v in state.arrays.items() if k != name} | wrong
            with pytest.raises(ConfigError, match="damaged"):
                resumed_slam(SavedState(arrays, state.facts), calibrated(sensors), OPTIONS, WORLD)
    path = tmp_path / "state.npz"
    write_state(path, state)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="damaged"):
        read_state(path)
    with pytest.raises(ConfigError, match="no such file"):
        read_state(tmp_path / "none.npz")


def test_a_state_of_another_version_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state.npz"
    with monkeypatch.context() as earlier:
        earlier.setattr(online_log, "VERSION", online_log.VERSION - 1)
        write_state(path, SavedState({"one": np.ones(3)}, {}))
    with pytest.raises(ConfigError, match=r"not a state that this version .* begin without"):
        read_state(path)


def test_another_map_or_calibration_than_before_is_refused(
    hall: Hall,
) -> None:
    """With the same names."""
    sensors, drive = hall
    slam = in_map(hall)
    for message in list(messages(drive.recording))[:300]:
        give(slam, message)
    state, known = saved_state(slam), calibrated(sensors)
    for other in (
        calibrated(sensors, sigma=np.full(15, 1e-3), rng=np.random.default_rng(1)),
        calibrated(sensors, sigma=np.full(15, 1e-4)),
    ):
        with pytest.raises(ConfigError, match="another calibration: give that one, or begin"):
            resumed_slam(state, other, OPTIONS, WORLD)
    for elsewhere in (dipole_world(7), None):
        with pytest.raises(ConfigError, match="another map: give that one, or begin"):
            resumed_slam(state, known, OPTIONS, elsewhere)


def test_events_that_nobody_has_read_are_saved(hall: Hall, tmp_path: Path) -> None:
    slam = in_map(hall)
    for message in list(messages(hall[1].recording))[:300]:
        give(slam, message)
    slam.add_reading(slam.stamp_ns, "unheard_of", np.ones(3))
    write_state(tmp_path / "state.npz", saved_state(slam))
    unread = slam.events()
    assert [each.kind for each in unread] == [EventKind.UNUSABLE]
    saved = read_state(tmp_path / "state.npz")
    again = resumed_slam(saved, calibrated(hall[0]), OPTIONS, WORLD).events()
    assert again[:-1] == unread
    assert again[-1].kind is EventKind.RESUMED
