"""The studies themselves, with maps that are exact but for an error of known size."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.field_map import MapSummary
from l2m_gtsam.simulate.hall_drives import CalibrationDrive
from l2m_gtsam.simulate.steel_hall import MILD, SteelHall, steel_hall
from l2m_gtsam.simulate.world import SteelWorld
from tests.drives import studied_calibrations
from tests.drives.studied_calibrations import (
    CalibrationCase,
    CalibrationConditions,
    Solved,
    calibration_study,
    independent,
)
from tests.worlds.exact import DipoleWorld, dipole_world
from tests.worlds.hall_clouds import CloudVariant
from tests.worlds.studied_maps import (
    NOISE_FACT,
    MapCase,
    MapConditions,
    Scene,
    StudiedMap,
    map_study,
)

Exact = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class TrueMap:
    """An exact field with white errors, whose standard deviation is told times a factor."""

    exact: Exact
    sigma: float = 0.0
    told: float = 1.0

    @property
    def summary(self) -> MapSummary:
        return MapSummary("true", 0, 0, np.zeros(3), np.zeros(3), {NOISE_FACT: 0.2})

    def query(self, points: FloatArray) -> FieldSample:
        field, gradient = self.field_and_gradient(points)
        error = self.sigma * np.random.default_rng(0).standard_normal(field.shape)
        inside = np.ones(len(points), dtype=np.bool_)
        return FieldSample(field + error, gradient, self.variance(points), inside)

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        return self.exact(points)

    def variance(self, points: FloatArray) -> FloatArray:
        return np.full(points.shape, (self.told * self.sigma) ** 2)


@dataclass(frozen=True)
class DipoleHall(SteelWorld):
    """A world whose exact gradient costs nothing, in the place of a hall's steel."""

    dipoles: DipoleWorld

    def field(self, points: FloatArray) -> FloatArray:
        return self.dipoles.field_and_gradient(points)[0]


def dipole_hall(seed: int, strength: float) -> SteelHall:
    """The floor and the structures of a hall, in the field of dipoles."""
    hall = steel_hall(seed, strength)
    steel = {f.name: getattr(hall.world, f.name) for f in fields(hall.world)}
    return replace(hall, world=DipoleHall(**steel, dipoles=dipole_world(seed)))


def dipoles_of(scene: Scene) -> TrueMap:
    assert isinstance(scene.hall.world, DipoleHall)
    return TrueMap(scene.hall.world.dipoles.field_and_gradient)


def steel_of(scene: Scene, sigma: float, told: float) -> TrueMap:
    """The hall's field without its gradient, which a study of maps does not look at."""
    return TrueMap(lambda p: (scene.hall.world.field(p), np.zeros((len(p), 3, 3))), sigma, told)


def doubtless(
    drive: CalibrationDrive, field_map: StudiedMap, t_start: FloatArray
) -> Sequence[Solved]:
    """Calibrate, and halve every sigma."""
    return [
        replace(found, covariance=found.covariance / 4)
        for found in independent(drive, field_map, t_start)
    ]


def case(sigma: float, told: float = 1.0) -> MapCase:
    clouds = (CloudVariant.NONE, CloudVariant.ACCURATE)
    return MapCase(lambda scene: steel_of(scene, sigma, told), clouds)


def test_the_map_study_measures_what_was_put_in() -> None:
    conditions = MapConditions(worlds=(0, 1), strengths=(MILD,), heights=((0.4, 1.0),))
    told: list[str] = []
    rows = map_study({"honest": case(0.3), "proud": case(0.3, told=0.5)}, conditions, told.append)
    assert [(row.kind, row.cloud) for row in rows] == [
        (kind, cloud) for kind in ("honest", "proud") for cloud in ("none", "accurate")
    ]
    assert told[1:] == [str(row) for row in rows]
    honest, proud = rows[0], rows[2]
    # 3,600 errors: their size is known to 1.2 %, a coverage of 95 % to 0.4 %.
    assert honest.rmse == pytest.approx(0.3, rel=0.05)
    assert honest.sigma == pytest.approx(0.3)
    assert honest.z_std == pytest.approx(1.0, abs=0.05)
    assert honest.coverage == pytest.approx(0.95, abs=0.015)
    assert (honest.inside, honest.noise) == (1.0, 0.2)
    assert proud.z_std == pytest.approx(2.0, abs=0.1)
    assert proud.z_worst >= proud.z_std
    assert proud.coverage == pytest.approx(0.673, abs=0.03)


def test_maps_get_the_cloud_of_their_variant() -> None:
    seen: list[Scene] = []

    def build(scene: Scene) -> TrueMap:
        seen.append(scene)
        return steel_of(scene, 0.1, 1.0)

    conditions = MapConditions(worlds=(0,), strengths=(MILD,), heights=((0.6,),), readings=200)
    variants = (CloudVariant.NONE, CloudVariant.ACCURATE, CloudVariant.FALSE)
    map_study({"any": MapCase(build, variants)}, conditions, lambda line: None)
    sizes = [len(scene.cloud) for scene in seen]
    assert sizes[0] == 0 < sizes[1] < sizes[2]
    np.testing.assert_array_equal(seen[0].survey.field, seen[2].survey.field)


def test_the_calibration_study_finds_an_exact_map_honest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exact fields and white noise: the covariances are true, and with half the sigmas not."""
    monkeypatch.setattr(studied_calibrations, "steel_hall", dipole_hall)
    conditions = CalibrationConditions(
        surveys=4, drives=2, sensors=3, readings=100, noises=(0.2,), survey_readings=50
    )
    methods = {"independent": independent, "doubtless": doubtless}
    cases = {"exact": CalibrationCase(dipoles_of, CloudVariant.NONE, methods)}
    told: list[str] = []
    honest, sure = calibration_study(cases, conditions, told.append)
    assert (honest.wanted, honest.solved, honest.determined) == (24, 24, 24)
    for name, dof in (("t", 3), ("C, H", 12), ("all", 15)):
        # 24 calibrations: the mean is known to sqrt(2 dof / 24); four of these are allowed.
        assert honest.honesty[name].nees == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / 24))
        assert sure.honesty[name].nees == pytest.approx(4 * honest.honesty[name].nees)
        assert not sure.honesty[name].consistent
    assert 0.95 in honest.honesty["t"].coverage_band
    # Squares of 24 errors per axis: their root mean is known to 14 %.
    np.testing.assert_allclose(honest.error, honest.sigma, rtol=0.5)
    assert told == [str(honest), str(sure)]
    assert "OUT of" in told[1]
