"""Drives of a survey between which the place, or the vehicle, changed."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.data import Distortion, KnownSensor, Recording, joined_rows
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.map_diary import MapDiary
from l2m_gtsam.records.places import ChangedSource
from l2m_gtsam.upkeep.surveys import map_surveys
from tests.drives.suite_surveys import CLOCK, QUICK, suite, surveyed
from tests.worlds.exact import DipoleWorld
from tests.worlds.quick_maps import quick
from tests.worlds.surveyed import strange_hall

OPTIONS = MappingOptions(
    model=quick("harmonic"),
    suite=QUICK,
    pose_noise=PoseNoiseOptions(position_m=0.0, rotation_deg=0.0),
)
DAY_NS = 86_400 * 10**9
STEEL = np.array([0.6, -2.6, 0.7])  # beside the path, which stays within 1.5 m of the middle
MOMENT = np.array([30.0, -60.0, 90.0])
SENSORS = suite(2, 2)
KNOWN = {each.sensor: replace(each, time_offset=-CLOCK) for each in SENSORS}
EMPTY = strange_hall(2)
LOADED = EMPTY.with_dipoles(STEEL, MOMENT)


def drive(seed: int, day: int, world: DipoleWorld, sensors: tuple[KnownSensor, ...]) -> Recording:
    """Return a survey on a day."""
    found, late = surveyed(seed, sensors, world), day * DAY_NS
    poses = found.trajectory
    return replace(
        found,
        trajectory=replace(poses, stamp_ns=poses.stamp_ns + late),
        series=tuple(replace(each, stamp_ns=each.stamp_ns + late) for each in found.series),
    )


def errors(field_map: HarmonicMap, world: DipoleWorld) -> float:
    """Return the root mean square of a map's errors where drives were, in its sigmas."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-1.2, 1.2, (300, 2)), rng.uniform(0.4, 0.7, 300)])
    found = field_map.query(points)
    e = (found.field - world.field_and_gradient(points)[0]) / np.sqrt(found.variance)
    return float(np.sqrt(np.mean(e[found.inside] ** 2)))


def mapped(*drives: Recording) -> HarmonicMap:
    """Return the map of drives."""
    found = map_surveys(drives, KNOWN, OPTIONS, ChangesOptions())
    assert isinstance(found, HarmonicMap)
    return found


def strongest(diary: MapDiary) -> ChangedSource:
    """Return the largest change; a map of coarse waves may show 0.2 A m^2 that are not there."""
    sources = [each.source for each in diary.changes]
    return max(sources, key=lambda each: float(np.linalg.norm(each.moment)))


def test_steel_between_two_drives_is_named_and_the_map_is_of_the_last() -> None:
    first, second = (drive(2 + k, k, world, SENSORS) for k, world in enumerate((EMPTY, LOADED)))
    field_map = mapped(second, first)  # in the order of their stamps, however they are given
    assert field_map.diary is not None
    assert [each.day for each in field_map.diary.drives] == ["2023-11-14", "2023-11-15"]
    found = strongest(field_map.diary)
    away = float(np.linalg.norm(found.position - STEEL))
    assert away < max(0.1, 4 * float(np.linalg.norm(found.position_sigma)))  # no other place
    # Sigmas of a map hold to a third in halls of which so little is known; of both alike it is
    # several times that.
    assert errors(field_map, LOADED) < 1.4
    plain = map_recordings([first, second], KNOWN, OPTIONS)
    assert isinstance(plain, HarmonicMap)
    assert errors(plain, LOADED) > 2 * errors(field_map, LOADED)


def test_steel_that_comes_during_a_drive_is_named_as_well() -> None:
    early, late = (drive(2 + k, k, world, SENSORS) for k, world in enumerate((EMPTY, LOADED)))
    whole = replace(
        early,
        trajectory=joined_rows([early.trajectory, late.trajectory]),
        series=tuple(joined_rows([a, b]) for a, b in zip(early.series, late.series, strict=True)),
    )
    field_map = mapped(whole)
    assert field_map.diary is not None
    found = strongest(field_map.diary)
    assert np.linalg.norm(found.position - STEEL) < 0.2
    assert errors(field_map, LOADED) < 1.4


def test_drives_of_one_place_make_the_map_of_all_of_them() -> None:
    drives = [drive(2 + k, k, EMPTY, SENSORS) for k in range(2)]
    found, plain = mapped(*drives), map_recordings(drives, KNOWN, OPTIONS)
    assert found.diary is None
    assert isinstance(plain, HarmonicMap)
    points = drives[0].trajectory.p[::50]
    np.testing.assert_array_equal(found.query(points).field, plain.query(points).field)


def test_a_vehicle_that_changed_between_drives_is_a_doubt() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 0.05]).as_matrix()
    turned = tuple(
        replace(each, distortion=Distortion(each.distortion.C @ turn, each.distortion.H))
        for each in SENSORS
    )
    found = mapped(drive(2, 0, EMPTY, SENSORS), drive(3, 1, EMPTY, turned))
    assert found.diary is None
    assert any("the sensors read otherwise in" in each for each in found.summary.doubts)
