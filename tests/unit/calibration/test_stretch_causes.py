"""What rejected readings are of, judged by all readings at their places."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.stretch_causes import DisagreeingPlaces
from l2m_gtsam.data import BoolArray, FloatArray, Readings
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.records.places import Cause, clear_cause
from l2m_gtsam.solve.linear_algebra import RowBlocks

NOISE_UT, SIZE_UT = 0.2, 3.0
LAPS, SLOTS, SENSORS = 2, 240, 3
NAMES = ("a", "b", "c")
LAP = SLOTS // LAPS


def turns() -> FloatArray:
    """Return the heading of each slot of two laps, radians."""
    return np.arange(SLOTS) * 2 * np.pi / LAP


def points() -> FloatArray:
    """Return where three sensors are on laps of 1.9 m radius, 0.1 m a slot, shape (N, 3)."""
    places = [
        np.column_stack([r * np.cos(turns()), r * np.sin(turns()), np.full(SLOTS, 0.5)])
        for r in (1.85, 1.9, 1.95)
    ]
    return np.concatenate(places)


SENSOR = np.repeat(np.arange(SENSORS), SLOTS)
SLOT = np.tile(np.arange(SLOTS), SENSORS)
R = Rotation.from_euler("z", np.tile(turns(), SENSORS)[:, None]).as_matrix()
RNG = np.random.default_rng(2)
FIELD = SIZE_UT * np.array([0.6, -0.5, 0.62])  # map frame
OFFSETS = SIZE_UT * np.linalg.qr(RNG.normal(size=(3, 3)))[0]  # of each sensor, its own frame
HERE = (np.floor(points()[:, :2]) == (1, 0)).all(axis=1)
THERE = (np.floor(points()[:, :2]) == (-2, -1)).all(axis=1)
SECOND = SLOT >= LAP
VEHICLE = np.einsum("nij,nj->ni", R, OFFSETS[SENSOR])


def causes_of(field: FloatArray, wrong: BoolArray, where: BoolArray, at: FloatArray) -> Any:
    """Return what explains a stretch of readings that differ from the map by a field."""
    noise = NOISE_UT * np.random.default_rng(3).normal(size=field.shape)
    white = csr_array(eye_array(3 * len(field)) / NOISE_UT)
    rows = MarginalRows(
        points=at,
        residual=field + noise,
        whitening=white,
        nuisance=RowBlocks.of(np.tile(np.eye(3) / NOISE_UT, (len(field), 1))),
        prior=np.eye(3),
        slot=SLOT,
    )
    readings = Readings(NAMES, SENSOR, SLOT.astype(np.int64), R, at, field)
    drive: Any = SimpleNamespace(
        averages=SimpleNamespace(slot=SLOT, counted=np.where(wrong, 0.0, 1.0)),
        view=SimpleNamespace(readings=readings),
        estimate=SimpleNamespace(C=lambda: np.tile(np.eye(3), (SENSORS, 1, 1))),
    )
    stretch: Any = SimpleNamespace(
        start_ns=SLOT[where].min(), end_ns=SLOT[where].max(), sensors=NAMES
    )
    return DisagreeingPlaces.of(rows, drive).explanations(stretch)


@pytest.mark.parametrize(
    ("field", "wrong", "where", "cause"),
    [
        # Of every pass and sensor, though half of the first pass was taken in.
        (FIELD * HERE[:, None], HERE & (SECOND | (SLOT % 2 == 0)), HERE, Cause.PLACE),
        (FIELD * (HERE & SECOND)[:, None], HERE & SECOND, HERE & SECOND, Cause.MOMENT),
        # The same offsets at two places.
        (
            VEHICLE * ((HERE & SECOND) | (THERE & ~SECOND))[:, None],
            (HERE & SECOND) | (THERE & ~SECOND),
            HERE & SECOND,
            Cause.VEHICLE,
        ),
        (
            VEHICLE * (HERE & (SENSOR == 1))[:, None],
            HERE & (SENSOR == 1),
            HERE & (SENSOR == 1),
            Cause.SENSOR,
        ),
    ],
    ids=["place", "moment", "vehicle", "sensor"],
)
def test_each_cause_is_named_with_its_size(
    field: FloatArray, wrong: BoolArray, where: BoolArray, cause: Cause
) -> None:
    found = causes_of(field, wrong, where, points())
    assert clear_cause(found) is cause
    # Of some ten readings of 0.2 uT, beside a common offset that is known to 1 uT beforehand.
    assert found[0].size == pytest.approx(SIZE_UT, abs=0.3)


def test_a_place_passed_once_leaves_it_open_whether_it_changed_for_good() -> None:
    """The second lap is elsewhere: on the first, place and moment are the same field."""
    once = HERE & ~SECOND
    away = points() + np.array([50.0, 0.0, 0.0]) * SECOND[:, None]
    found = causes_of(FIELD * once[:, None], once, once, away)
    assert clear_cause(found) is None
    assert {each.cause for each in found[:2]} == {Cause.PLACE, Cause.MOMENT}
