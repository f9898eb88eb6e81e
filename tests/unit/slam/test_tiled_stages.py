"""A drive in tiles: whether fields last, and which of two places it comes back to."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from l2m_gtsam.progress import silent
from l2m_gtsam.slam.drive import EXACT_START, Drive, KnownSensors, as_poses
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.pose_graph import drive_values
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.return_search import Bending, ReturnSearch
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiled_smoother import TiledProblem
from l2m_gtsam.slam.unknown_field.tiled_stages import (
    FOLLOWED,
    StagedDrive,
    finds_changes,
    log_density,
    map_drive,
)
from l2m_gtsam.slam.unknown_field.tiles import drive_prior
from tests.drives.moved_steel import moved_steel
from tests.drives.slam import calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

QUICK = SlamOptions.model_validate(
    {
        "key_poses": {"distance_m": 0.3, "readings": 2},
        "tiles": {"modes": 100, "learn_over_m": 9.0},
    }
)


def lapped() -> Drive:
    """Laps in a field that lasts."""
    own = random_sensors(2, 4)
    recorded = slam_drive(dipole_world(2), own, laps(20, (1.9, 1.4)), np.random.default_rng(2))
    drive, _ = prepared(recorded.recording, calibrated(own), QUICK)
    return replace(drive, start=replace(drive.start, covariance=EXACT_START))


def test_only_where_steel_was_moved_visits_find_another_field() -> None:
    """At the true poses of four laps past a pallet, moved after the second or not."""
    made = moved_steel(2)

    still, moved = (
        prepared(each.recording, calibrated(made.sensors), QUICK)[0]
        for each in (made.still, made.moved)
    )
    rows, true = np.searchsorted(made.still.truth.stamp_ns, still.stamp_ns), made.still.truth
    poses = as_poses(true.R[rows], true.p[rows])
    # Learnt over the first metres, which both have in common.
    prior = drive_prior(still, poses, QUICK.tiles)
    assert not finds_changes(still, poses, prior)
    assert finds_changes(moved, poses, prior)


def test_a_drive_whose_field_lasts_is_solved_once() -> None:
    """And its density is above that of the same tiles with readings of another field."""
    drive = lapped()
    poses, stages = drive.dead_reckoning(), list[str]()
    prior = drive_prior(drive, poses, QUICK.tiles)

    def noted(stage: str, _done: float) -> None:
        stages.append(stage)

    found = map_drive(drive, poses, prior, QUICK, noted)
    assert set(stages) == {"following the drive", "solving poses and field"}  # no moved steel
    wrong = replace(drive.readings, field=drive.readings.field[::-1])
    few = QUICK.model_copy(update={"max_iterations": 5})  # as it fits nowhere, it takes no end
    other = map_drive(replace(drive, readings=wrong), poses, prior, few, silent)
    used = found.solution.used | other.solution.used
    assert log_density(found, used) > log_density(other, used)


@dataclass(frozen=True)
class TwoPlaces:
    staged: StagedDrive
    monkeypatch: pytest.MonkeyPatch

    def beside(self, away: float) -> list[gtsam.Pose3]:
        """Return the path bent so that it ends so many metres beside where it should."""
        drive = self.staged.drive
        return Bending(drive, drive.dead_reckoning(), 0).to(np.array([away, 0.0, 0.0]))[0]

    def keeps(self, begin: list[gtsam.Pose3], searched: list[gtsam.Pose3]) -> list[gtsam.Pose3]:
        self.monkeypatch.setattr(ReturnSearch, "likeliest", lambda *_: searched)
        return self.staged.followed(begin, silent)


@pytest.fixture
def two_places(monkeypatch: pytest.MonkeyPatch) -> TwoPlaces:
    """Laps whose pieces stay as given; with much noise the less likely one looks likelier."""
    drive = lapped()
    prior = drive_prior(drive, drive.dead_reckoning(), QUICK.tiles)
    likely = ReturnSearch.density

    def as_they_are(
        _: TiledProblem, at: list[gtsam.Pose3], sensors: KnownSensors, *__: float
    ) -> SimpleNamespace:
        tiled = TiledDrive.lasting(RelativeMotions.along(drive, at), at, sensors, prior)
        return SimpleNamespace(
            poses=at, sensors=sensors, values=drive_values(drive, at), tiled=tiled
        )

    def density(search: ReturnSearch, at: list[gtsam.Pose3], values: gtsam.Values) -> float:
        much = np.array_equal(search.noise, FOLLOWED[0] * drive.sensors.noise)
        return likely(search, at, values) * (-1 if much else 1)

    monkeypatch.setattr(TiledProblem, "solved", as_they_are)
    monkeypatch.setattr(ReturnSearch, "density", density)
    staged = StagedDrive(drive, prior, prior, QUICK, TiledDrive.lasting)
    return TwoPlaces(staged, monkeypatch)


def test_of_two_places_that_is_kept_which_is_likelier_with_less_noise(
    two_places: TwoPlaces,
) -> None:
    """Whether it is where odometry ends or where the search does."""
    there, elsewhere = two_places.beside(0.0), two_places.beside(1.2)
    assert same(two_places.keeps(there, elsewhere), there)
    assert same(two_places.keeps(elsewhere, there), there)


def test_of_two_solutions_in_one_place_the_first_is_kept(two_places: TwoPlaces) -> None:
    there, near = two_places.beside(0.0), two_places.beside(0.1)
    assert same(two_places.keeps(near, there), near)


def same(found: list[gtsam.Pose3], poses: list[gtsam.Pose3]) -> bool:
    return all(one.equals(two, 1e-9) for one, two in zip(found, poses, strict=True))
