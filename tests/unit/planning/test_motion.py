"""Extra motions: poses that do what their name says."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.planning.motion import (
    ExtraMotion,
    MotionOptions,
    extra_motions,
    loop,
    places_around,
    strongest,
)

OPTIONS = MotionOptions()


def drive() -> ExtraMotion:
    """A straight line with one heading, the lidar mounted with a tilt."""
    R = Rotation.from_euler("ZYX", [30, 2, -1], degrees=True).as_matrix()
    p = np.column_stack([np.linspace(0, 4, 300), np.linspace(0, 2, 300), np.full(300, 0.8)])
    return ExtraMotion("drive", np.broadcast_to(R, (300, 3, 3)), p, np.linspace(0, 5, 300))


def named(word: str) -> ExtraMotion:
    return next(each for each in extra_motions(drive(), OPTIONS) if word in each.name)


def turned(motion: ExtraMotion) -> FloatArray:
    """Rotation of each pose away from the drive's, in the lidar frame, degrees."""
    return turned_from(drive(), motion)


def turned_from(one: ExtraMotion, other: ExtraMotion) -> FloatArray:
    return np.degrees(Rotation.from_matrix(one.R[0].T @ other.R).as_rotvec())


def test_the_path_has_the_drives_poses_a_turn_its_own_and_all_are_rotations() -> None:
    motions = (*extra_motions(drive(), OPTIONS), loop(drive(), np.zeros(3), OPTIONS))
    assert len({each.name for each in motions}) == 7
    for each in motions:
        own = "spot" in each.name or "loop" in each.name
        assert each.p.shape == (OPTIONS.poses if own else len(drive().p), 3)
        unit = each.R @ each.R.transpose(0, 2, 1)
        np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(each.R), 1.0)


def test_heaving_moves_up_and_down_alone() -> None:
    heaved = named("heave")
    np.testing.assert_allclose(turned(heaved), 0, atol=1e-9)
    # 300 poses in seven swings come within a hundredth of the turning points.
    np.testing.assert_allclose(np.ptp(heaved.p[:, 2]), 2 * OPTIONS.heave_m, rtol=0.01)
    np.testing.assert_allclose(heaved.p[[0, -1], :2], drive().p[[0, -1], :2])


def test_rolling_and_pitching_turn_about_one_axis_of_the_lidar() -> None:
    for word, axis in (("roll", 0), ("pitch", 1)):
        angles = turned(named(word))
        np.testing.assert_allclose(np.abs(angles[:, axis]).max(), OPTIONS.tilt_deg, rtol=0.01)
        np.testing.assert_allclose(np.delete(angles, axis, axis=1), 0, atol=1e-9)


def test_turning_on_the_spot_goes_all_the_way_round() -> None:
    spun = named("spot")
    assert np.ptp(spun.p, axis=0).max() == 0
    heading = np.unwrap(np.arctan2(spun.R[:, 1, 0], spun.R[:, 0, 0]))
    np.testing.assert_allclose(heading[-1] - heading[0], 2 * np.pi)
    # About the vertical: the tilt of the mounting stays what it is.
    np.testing.assert_allclose(spun.R[:, 2, 2], drive().R[0, 2, 2])


def test_the_other_way_round_faces_back() -> None:
    back = named("other way")
    np.testing.assert_allclose(back.p[0], drive().p[-1])
    np.testing.assert_allclose(back.R[:, :2], -np.broadcast_to(drive().R[0, :2], (300, 2, 3)))


def test_a_loop_heads_along_itself() -> None:
    centre = np.array([2.0, -1.0, 0.8])
    round_ = loop(drive(), centre, OPTIONS)
    np.testing.assert_allclose(np.linalg.norm(round_.p - centre, axis=1), OPTIONS.loop_m)
    ahead = np.diff(round_.p[:, :2], axis=0)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    x = round_.R[:-1, :2, 0] / np.linalg.norm(round_.R[:-1, :2, 0], axis=1)[:, None]
    # A chord of a hundredth of the circle leads its start's tangent by 1.8 deg.
    assert np.sum(ahead * x, axis=1).min() > np.cos(np.deg2rad(2))


def test_the_strongest_place_lies_inside_the_map() -> None:
    places = places_around(drive(), OPTIONS)
    low, high = places.min(axis=0), places.max(axis=0)
    np.testing.assert_allclose(low[:2], [-2, -2])
    assert (high[:2] > [5.4, 3.4]).all()
    assert np.ptp(places[:, 2]) == 0
    gradient = np.zeros((len(places), 3, 3))
    gradient[[3, 8, 9], 0, 1] = 1.0, 5.0, np.nan
    inside = np.ones(len(places), dtype=np.bool_)
    inside[[8, 9]] = False
    sample = FieldSample(places, gradient, places, inside)
    np.testing.assert_array_equal(strongest(places, sample), places[3])
    nowhere = FieldSample(places, gradient, places, np.zeros_like(inside))
    assert strongest(places, nowhere) is None


def test_velocities_are_those_of_the_poses() -> None:
    """4.47 m in 5 s along the lidar's line; turning on the spot at the rate that is asked for."""
    straight = named("once more").twist
    np.testing.assert_allclose(straight[:, :3], 0, atol=1e-9)
    speed = np.linalg.norm(straight[:, 3:], axis=1)
    np.testing.assert_allclose(speed, np.hypot(4, 2) / 5, rtol=1e-9)
    spot = named("on the spot").twist
    np.testing.assert_allclose(spot[:, 3:], 0, atol=1e-9)
    rate = np.linalg.norm(spot[:, :3], axis=1)
    np.testing.assert_allclose(rate, OPTIONS.turn_rad_s, rtol=1e-9)


def test_going_back_is_the_opposite_velocity_in_the_map() -> None:
    """The vehicle is turned about, so that the lidar sees the same velocity."""
    ahead, back = named("once more"), named("other way round")
    for each, sign in ((ahead, 1), (back, -1)):
        way = np.einsum("nij,nj->ni", each.R, each.twist[:, 3:])
        np.testing.assert_allclose(way, sign * np.tile([0.8, 0.4, 0.0], (len(way), 1)), atol=1e-9)


def test_a_drive_of_few_poses_swings_as_well() -> None:
    few = drive()
    few = ExtraMotion("drive", few.R[::8], few.p[::8], few.seconds[::8])
    for each in extra_motions(few, OPTIONS):
        # Seven swings of 0.2 m in five seconds are 1.8 m/s, the other motions are slower.
        assert np.abs(each.twist).max() < 4.0
    rolled = next(each for each in extra_motions(few, OPTIONS) if "roll" in each.name)
    assert np.abs(turned_from(few, rolled)).max() > 0.9 * OPTIONS.tilt_deg
