"""A map carries the name of its frame, and drives in another one are refused by all that use it."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import l2m_gtsam as l2m
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Recording
from l2m_gtsam.errors import L2MError, MapError
from l2m_gtsam.maps.build import KINDS, MapOptions, build_map, map_from_state
from l2m_gtsam.maps.field_map import FieldMap, check_frame, frame_of, framed
from l2m_gtsam.planning.motion import PlanOptions
from l2m_gtsam.planning.plan import plan
from l2m_gtsam.records.calibration import CalibrationResult, Uncertainty
from l2m_gtsam.validation.validate import validate

COUNT = 60
RNG = np.random.default_rng(5)
POINTS = np.column_stack([RNG.uniform(0, 2, (COUNT, 2)), RNG.uniform(0, 0.3, COUNT)])
FIELD = np.array([20.0, 0.0, -40.0]) + RNG.normal(size=(COUNT, 3))
OPTIONS = CalibrationOptions()


def mapped(kind: str = "bilinear") -> FieldMap:
    return framed(build_map(POINTS, FIELD, MapOptions(kind=kind)), "map")


def driven(frame: str = "odom") -> Recording:
    stamps = 1000.0 + 0.1 * np.arange(COUNT)
    q = np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))
    return l2m.drive(stamps, POINTS, q, {"mag": (stamps, FIELD)}, frame=frame)


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_keeps_the_name_of_its_frame(kind: str) -> None:
    field_map = mapped(kind)
    updated = field_map.updated(POINTS[:5] + 0.01, FIELD[:5])
    sent = pickle.loads(pickle.dumps(field_map))  # noqa: S301 - made here
    for each in (field_map, updated, sent):
        assert frame_of(each) == "map"
    state = field_map.to_state()
    assert frame_of(map_from_state(state)) is None
    for frame, found in (("hall", "hall"), (["hall"], None)):
        facts = {**state.provenance, "frame": frame}
        assert frame_of(map_from_state(replace(state, provenance=facts))) == found


def test_a_drive_is_checked_if_the_frame_is_known() -> None:
    check_frame(mapped(), driven("map"))
    check_frame(build_map(POINTS, FIELD, MapOptions(kind="bilinear")), driven())
    with pytest.raises(MapError, match=r"map\.npz is in frame 'map'"):
        check_frame(mapped(), driven(), "map.npz")
    read = replace(driven(), source=replace(driven().source, path="drive.bag"))
    with pytest.raises(MapError, match=r"poses of drive\.bag are in 'odom'.*`bag.frame: map`"):
        check_frame(mapped(), read)
    together = replace(driven("map"), drives=(driven("map"), driven()))
    with pytest.raises(MapError, match="is in frame 'map'"):
        check_frame(mapped(), together)


NOTHING = CalibrationResult((), 0, Uncertainty.INDEPENDENT, (), (), None, None, {}, {})


@pytest.mark.parametrize(
    "use",
    [
        lambda drive, field_map: l2m.calibrate(drive, field_map),
        lambda drive, field_map: l2m.localise(drive, NOTHING, field_map),
        lambda drive, field_map: l2m.keep_map_up(field_map, drive, l2m.known_sensor("mag")),
        lambda drive, field_map: plan(drive, field_map, OPTIONS, PlanOptions()),
        lambda drive, field_map: validate(drive, field_map, NOTHING, OPTIONS, 0.01),
    ],
)
def test_all_uses_refuse_another_frame(use: Callable[[Recording, Any], object]) -> None:
    told = r"^the map is in frame 'map', the poses of \(arrays\) are in 'odom'; .*`frame='map'` of"
    with pytest.raises(MapError, match=told):
        use(driven(), mapped("harmonic"))


def test_a_start_that_is_given_puts_any_odometry_into_the_map() -> None:
    start = {"position": (0, 0, 0), "quaternion_xyzw": (0, 0, 0, 1)}
    with pytest.raises(L2MError, match="sensor"):  # goes on, and misses a calibration
        l2m.localise(driven(), NOTHING, mapped(), options={"start": start})
    with pytest.raises(MapError, match="is in frame"):
        l2m.localise(driven(), NOTHING, mapped(), options={"start": {"position": (0, 0, 0)}})


def test_a_saved_map_keeps_its_frame(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    l2m.save_map(path, framed(mapped(), "hall"))
    assert frame_of(l2m.load_map(path)) == "hall"
    l2m.save_map(path, mapped(), frame="yard")
    assert frame_of(l2m.load_map(path)) == "yard"


def test_a_map_is_in_the_frame_of_its_survey() -> None:
    built = l2m.build_map(driven("hall"), options={"model": {"kind": "bilinear"}})
    assert frame_of(built) == "hall"
