"""The simulated world obeys Maxwell's equations and agrees with independent sums."""

import datetime as dt
from typing import Any

import magpylib
import numpy as np
import ppigrf
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate import world as world_module
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.scenario import EarthOptions, earth_field
from l2m_gtsam.simulate.warehouse import WarehouseOptions, build_warehouse
from l2m_gtsam.simulate.world import SteelWorld

EARTH = np.array([0.0, 41.0, 9.4])
HALL = FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1)


@pytest.fixture(scope="module")
def hall() -> SteelWorld:
    """A small warehouse of all kinds of parts."""
    return build_warehouse(WarehouseOptions(), plan_floor(HALL), EARTH, np.random.default_rng(5))


@pytest.fixture(scope="module")
def points() -> FloatArray:
    """Places in the aisles, 0.4 m or more from all steel, where sensors pass."""
    rng, plan = np.random.default_rng(6), plan_floor(HALL)
    places = rng.uniform([0.5, -0.6, 0.35], [15.5, 0.6, 1.0], (200, 3))
    places[:, 1] += rng.choice(plan.aisle_y, 200)
    return places


def one_body(size: FloatArray, polarisation: FloatArray, centre: FloatArray) -> SteelWorld:
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 1.9]).as_matrix()[None]
    return SteelWorld(("body",), size[None], centre[None], turn, polarisation[None], np.zeros(3))


def gradient(world: SteelWorld, points: FloatArray, step: float) -> FloatArray:
    """Central differences: [n, i, j] = dB_i/dx_j in uT/m."""
    shifts = step * np.eye(3)
    columns = [(world.field(points + s) - world.field(points - s)) / (2 * step) for s in shifts]
    return np.stack(columns, axis=2)


def test_divergence_and_curl_vanish_outside_steel(hall: SteelWorld, points: FloatArray) -> None:
    assert not hall.inside(points).any()
    G = gradient(hall, points, 1e-3)
    # Truncation is step^2/6 B'''; a pole of 5 uT m^2 at 0.4 m has B''' = 24 * 5 / 0.4^5 = 1.2e4
    # uT/m^3, so 2e-3 uT/m. Rounding (1e-13 uT / step) is far less.
    tolerance = 4e-3
    assert np.abs(np.trace(G, axis1=1, axis2=2)).max() < tolerance
    assert np.abs(G - np.swapaxes(G, 1, 2)).max() < tolerance
    # ... while the gradient itself is a thousand times that.
    assert np.median(np.linalg.norm(G, axis=(1, 2))) > 1.0


def test_far_field_of_a_body_is_its_dipole() -> None:
    size, polarisation = np.array([0.4, 0.1, 0.2]), np.array([0.02, -0.01, 0.03])
    body = one_body(size, polarisation, np.array([1.0, -2.0, 0.5]))
    directions = np.random.default_rng(7).standard_normal((50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def misfit(distance: float) -> float:
        moment = body.R_map_body[0] @ polarisation * size.prod() * 1e6  # mu0 m in uT m^3
        along = directions @ moment
        dipole = (3 * along[:, None] * directions - moment) / (4 * np.pi * distance**3)
        field = body.field(body.centres + distance * directions)
        return float(np.abs(field - dipole).max() / np.abs(dipole).max())

    # The next term of a body symmetric about its centre is (size / distance)^2 smaller.
    assert misfit(20.0) < (0.4 / 20.0) ** 2
    assert misfit(10.0) / misfit(20.0) == pytest.approx(4.0, rel=0.02)


def test_field_is_the_sum_of_magpylib_objects(hall: SteelWorld, points: FloatArray) -> None:
    library: Any = magpylib  # its classes carry no types
    bodies = library.Collection(
        *(
            library.magnet.Cuboid(
                position=hall.centres[k],
                orientation=Rotation.from_matrix(hall.R_map_body[k]),
                dimension=hall.dimensions[k],
                polarization=hall.polarisations[k],
            )
            for k in range(len(hall))
        )
    )
    reference = np.asarray(bodies.getB(points)) * 1e6 + EARTH
    # Same formula, other order of rotations and sums: rounding of 45 uT.
    np.testing.assert_allclose(hall.field(points), reference, rtol=0, atol=1e-11)


def test_batches_do_not_change_the_field(
    hall: SteelWorld, points: FloatArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = hall.field(points)
    monkeypatch.setattr(world_module, "PAIRS_PER_BATCH", 3 * len(hall))
    # Every point is computed on its own, up to the order in which a sum is vectorised.
    np.testing.assert_allclose(hall.field(points), whole, rtol=0, atol=1e-12)
    assert hall.field(points[:0]).shape == (0, 3)


def test_without_steel_only_the_earth_is_left(points: FloatArray) -> None:
    none = np.zeros((0, 3))
    empty = SteelWorld((), none, none, np.zeros((0, 3, 3)), none, EARTH)
    np.testing.assert_array_equal(empty.field(points), np.tile(EARTH, (len(points), 1)))
    assert not empty.inside(points).any()


def test_inside_is_within_the_turned_box() -> None:
    body = one_body(np.array([2.0, 0.2, 0.2]), np.zeros(3), np.array([5.0, 0.0, 1.0]))
    along, across = body.R_map_body[0][:, 0], body.R_map_body[0][:, 1]
    probes = body.centres + np.array([0.99 * along, 1.01 * along, 0.09 * across, 0.11 * across])
    np.testing.assert_array_equal(body.inside(probes), [True, False, True, False])


def test_steel_disturbs_the_earth_field_like_a_warehouse(
    hall: SteelWorld, points: FloatArray
) -> None:
    deviation = hall.field(points) - EARTH
    # Surveys of such halls find a few uT in the aisles and tens of uT beside posts.
    assert 0.5 < deviation.std() < 8.0
    assert np.abs(deviation).max() < 80.0


def test_induced_polarisation_follows_the_field_along_long_parts() -> None:
    soft = WarehouseOptions(remanence=0.0)
    earth = np.array([0.0, 0.0, 40.0])
    world = build_warehouse(soft, plan_floor(HALL), earth, np.random.default_rng(8))
    posts = np.array(world.kinds) == "post"
    # A post of 0.3 x 0.3 x 8 m: N_z = (1/8) / (2/0.3 + 1/8) = 0.0184, susceptibility 100 * 0.08.
    expected = 8.0 / (1 + 8.0 * 0.0184) * 40e-6
    assert world.polarisations[posts, 2] == pytest.approx(expected, rel=1e-3)
    assert not world.polarisations[posts, :2].any()
    flat = np.array(world.kinds) == "rebar"
    assert np.abs(world.polarisations[flat, :2]).max() == 0.0


@pytest.mark.parametrize(
    ("latitude", "longitude", "strength", "up"),
    # Rounded values of the world magnetic maps of NOAA for 2025.
    [(1.35, 103.7, 42.0, 9.0), (52.5, 13.4, 50.0, -46.0)],
    ids=["Singapore", "Berlin"],
)
def test_earth_field_of_known_places(
    latitude: float, longitude: float, strength: float, up: float
) -> None:
    field = earth_field(EarthOptions(latitude=latitude, longitude=longitude))
    # The maps' values above are rounded to whole microtesla.
    assert np.linalg.norm(field) == pytest.approx(strength, abs=1.0)
    assert field[2] == pytest.approx(up, abs=1.0)


def test_earth_field_is_ppigrf_east_north_up_in_microtesla() -> None:
    day = dt.date(2020, 3, 1)
    options = EarthOptions(latitude=52.5, longitude=13.4, altitude=40.0, date=day)
    east, north, up = (
        float(np.squeeze(component))
        for component in ppigrf.igrf(13.4, 52.5, 0.04, dt.datetime.combine(day, dt.time()))
    )
    # Equal up to one rounding of the conversion and the sine of 90 degrees.
    np.testing.assert_allclose(
        earth_field(options), np.array([east, north, up]) / 1000, rtol=1e-12, atol=1e-12
    )


def test_map_axes_turn_against_the_earth_field() -> None:
    east_north_up = earth_field(EarthOptions())
    x_north = earth_field(EarthOptions(x_axis_azimuth=0.0))
    e, n, u = east_north_up
    np.testing.assert_allclose(x_north, [n, -e, u], rtol=0, atol=1e-12)  # rounding
