"""Readings between key poses: what odometry's errors do to them, and what is made of it."""

from dataclasses import dataclass

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_factors import KeyPoseReadings, KeyPoseResiduals, Whitening, key_pose_residuals
from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.odometry import odometry_steps
from l2m_gtsam.slam.options import DriftOptions, SlamOptions
from l2m_gtsam.slam.pose_graph import pose_values
from l2m_gtsam.slam.relative_motion import bridge_whitening, shifted_readings
from l2m_gtsam.slam.smoother import SmoothingProblem, localise_drive
from l2m_gtsam.solve.robust import RobustOptions
from tests.drives.drawn import DrawnDrive, drawn_drive, moved, perturbations
from tests.drives.following import followed_beliefs
from tests.drives.slam import rounds
from tests.worlds.exact import dipole_world, random_sensors

WORLD, NOISE = dipole_world(3), 0.2
PARTS = 16
EXACT = np.full(15, 1e-6)
# 6 cm and 0.3 degrees of walk per root metre, and next to nothing beside.
WALKING = DriftOptions(
    steady=0.0,
    position_share=0.06 / np.sqrt(10),
    rotation_deg_per_m=0.3 / np.sqrt(10),
    rotation_share=0.0,
    least_m=1e-6,
    least_deg=1e-5,
)


def drive(every: int, seconds: float = 4.0) -> DrawnDrive:
    """Return the same drive with key poses this far apart: same errors, same readings."""
    truth = rounds(seconds)[np.arange(0, 20 * int(seconds) - 7, 2)]
    rng = np.random.default_rng(5)
    return drawn_drive(WORLD, random_sensors(3, 4), truth, rng, EXACT, NOISE, every, WALKING)


def hung(R: FloatArray, p: FloatArray, fraction: FloatArray) -> KeyPoseReadings:
    n = len(p)
    return KeyPoseReadings(np.zeros(n, np.int64), np.zeros(n, np.int64), R, p, fraction, p)


@given(st.integers(0, 10_000))
def test_the_end_of_a_step_goes_with_it_and_its_beginning_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, R_to, R_at = (Rotation.random(3, rng=rng).as_matrix() for _ in range(3))
    p, p_to, p_at = (rng.normal(size=(3, 3)) for _ in range(3))
    turn, shift = Rotation.from_matrix(R.transpose(0, 2, 1) @ R_to).as_rotvec(), p_to - p
    at_start = hung(R_at, p_at, np.zeros(3))
    found = shifted_readings(at_start, R, p, turn, shift)
    np.testing.assert_allclose(found.R_key_lidar, R_at, atol=1e-12)
    np.testing.assert_allclose(found.p_key_lidar, p_at, atol=1e-12)
    # Fixed to the end, a lidar is turned and shifted with it.
    at_end = hung(R @ R_at, moved(R, p_at) + p, np.ones(3))
    found = shifted_readings(at_end, R, p, turn, shift)
    np.testing.assert_allclose(found.R_key_lidar, R_to @ R_at, atol=1e-9)
    np.testing.assert_allclose(found.p_key_lidar, moved(R_to, p_at) + p_to, atol=1e-9)


@dataclass(frozen=True)
class Walks:
    """Ways from a key pose, R of shape (n, 17, 3, 3) and p (n, 17, 3): n in number, 16 parts."""

    R: FloatArray
    p: FloatArray

    def readings(self, instant: IntArray, sensor: IntArray) -> KeyPoseReadings:
        """Return readings at instants, of one walk after the other."""
        R, p, n = (
            self.R[:, instant].reshape(-1, 3, 3),
            self.p[:, instant].reshape(-1, 3),
            len(self.p),
        )
        s = np.tile(instant / PARTS, n)
        return KeyPoseReadings(0 * np.tile(sensor, n), np.tile(sensor, n), R, p, s, 0 * p)


def walks(truth: Trajectory, Q: FloatArray, draws: int, rng: np.random.Generator) -> Walks:
    """Return what odometry makes of a way from its first pose, with errors of Q over the whole."""
    steps = odometry_steps(truth, np.arange(len(truth)), DriftOptions())
    R, p = [np.tile(np.eye(3), (draws, 1, 1))], [np.zeros((draws, 3))]
    for turn, way in zip(steps.R, steps.p, strict=True):
        off = perturbations(np.tile(Q / len(steps), (draws, 1, 1)), rng)
        p.append(p[-1] + moved(R[-1], way + off.p @ turn.T))
        R.append(R[-1] @ turn @ off.R)
    return Walks(np.stack(R, axis=1), np.stack(p, axis=1))


def test_whitened_residuals_of_walks_between_known_key_poses_are_white() -> None:
    """6,000 walks of odometry over half a metre, two sensors at three instants.

    Residuals are those of readings that were hung anew by the true step. A covariance of n draws
    has errors of sqrt(2 / n) on and sqrt(1 / n) off its diagonal: five of them, and one in fifty
    for the field, which is not quite linear over a centimetre.
    """
    draws, rng, truth = 6_000, np.random.default_rng(1), rounds(1.0)[np.arange(PARTS + 1)]
    Q = np.diag(np.repeat([np.deg2rad(0.5), 0.02], 3) ** 2)
    true, odo = walks(truth, 1e-20 * Q, 1, rng), walks(truth, Q, draws, rng)
    instant, sensor = np.repeat([4, 8, 13], 2), np.tile([0, 1], 3)
    n, known = len(instant), drive(1).drive.sensors.fixed()

    def residuals(readings: KeyPoseReadings) -> KeyPoseResiduals:
        R, p = (np.repeat(each, len(readings), 0) for each in (truth.R[:1], truth.p[:1]))
        return key_pose_residuals(readings, WORLD, R, p, known)

    ideal = residuals(true.readings(instant, sensor))
    step = gtsam.Pose3(gtsam.Rot3(true.R[0, -1]), true.p[0, -1])
    own = np.tile(np.eye(3) / NOISE, (n, 1, 1))
    white = bridge_whitening(own, ideal.de_dX @ step.AdjointMap(), instant / PARTS, Q)
    R_odo, p_odo = (np.repeat(each[:, -1], n, axis=0) for each in (odo.R, odo.p))
    turn = Rotation.from_matrix(R_odo.transpose(0, 2, 1) @ true.R[0, -1]).as_rotvec()
    shift = true.p[0, -1] - p_odo
    there = shifted_readings(odo.readings(instant, sensor), R_odo, p_odo, turn, shift)
    e = residuals(there).reading.residual.reshape(draws, n, 3) - ideal.reading.residual
    e = e.transpose(1, 2, 0)
    found = white(e + NOISE * rng.normal(size=e.shape))
    off, diagonal = found @ found.T / draws - np.eye(3 * n), np.eye(3 * n, dtype=np.bool_)
    assert np.abs(off[diagonal]).max() < 5 * np.sqrt(2 / draws) + 0.02
    assert np.abs(off[~diagonal]).max() < 5 * np.sqrt(1 / draws) + 0.02
    # What whitening has to take away: twice the variance of the noise, in common to readings.
    alone = Whitening.independent(own)(e)
    shares = alone @ alone.T / draws
    assert np.abs(shares[:3, 3:6]).max() > 0.5
    assert shares[diagonal].max() > 1.0


def test_key_poses_far_apart_know_what_key_poses_at_every_reading_do() -> None:
    """The slow reference: a key pose at each pose, whose readings have no way to go.

    Odometry walks by 6 cm per root metre. What is left out with four poses to a key pose is of
    second order: poses differ by less than a third of a sigma, sigmas by a tenth.
    """
    far, near = drive(4), drive(1)
    options = SlamOptions(robust=RobustOptions(confidence=1 - 1e-9))
    rough = localise_drive(far.drive, WORLD, options, silent)
    exact = localise_drive(near.drive, WORLD, options, silent)
    np.testing.assert_array_equal(far.p, near.p[::4])
    sigmas = np.sqrt(np.einsum("kii->ki", exact.pose_covariance[::4]))
    apart = [
        gtsam.Pose3.Logmap(one.between(other))
        for one, other in zip(exact.poses[::4], rough.poses, strict=True)
    ]
    assert np.abs(np.array(apart) / sigmas).max() < 0.33
    found = np.sqrt(np.einsum("kii->ki", rough.pose_covariance))
    np.testing.assert_allclose(found, sigmas, rtol=0.1)


def test_on_line_key_poses_far_apart_know_as_much_too() -> None:
    """The same, from the filter: at each key pose all that was read until then has been taken."""
    far, near = drive(4), drive(1)
    beliefs = []
    for each in (far, near):
        robust = RobustOptions(confidence=1 - 1e-9)
        beliefs.append(followed_beliefs(each.drive, WORLD, robust, free=False))
    for one, other in zip(beliefs[0][1:], beliefs[1][4::4], strict=True):
        sigmas = np.sqrt(np.diag(other.pose_covariance))
        apart = gtsam.Pose3.Logmap(other.pose.between(one.pose)) / sigmas
        assert np.abs(apart).max() < 0.5
        np.testing.assert_allclose(np.sqrt(np.diag(one.pose_covariance)), sigmas, rtol=0.15)


def test_what_a_way_contributes_is_what_whitening_knows() -> None:
    """Of one reading the share in its covariance, of all the slow sum over pairs of them."""
    given_drive = drive(4).drive
    problem = SmoothingProblem(given_drive, WORLD, SlamOptions())
    seen = problem.predict(pose_values(given_drive.dead_reckoning()))
    motions, by_lidar = seen.motions, seen.prediction.by_lidar
    rows = np.flatnonzero(motions.readings.key_pose == 2)
    n, Q, s = len(rows), motions.covariance[2], motions.readings.fraction[rows]
    F = by_lidar[rows] @ motions.by_step[rows]
    S = NOISE**2 * np.eye(3 * n)
    for i in range(n):
        for j in range(n):
            common = min(s[i], s[j]) - s[i] * s[j]
            S[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += common * F[i] @ Q @ F[j].T
    own = np.tile(np.eye(3) / NOISE, (n, 1, 1))
    white = motions.whitening(rows, own, by_lidar[rows])
    half = white(S.reshape(n, 3, 3 * n))
    # Errors of less than a thousandth of the noise's variance are left out.
    np.testing.assert_allclose(white(half.T.reshape(n, 3, 3 * n)), np.eye(3 * n), atol=2e-3)
    share = motions.interpolation_covariance(rows, by_lidar[rows])
    for i in range(n):
        block = S[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] - NOISE**2 * np.eye(3)
        np.testing.assert_allclose(share[i], block, atol=1e-12)


def test_a_drive_with_many_clocks_costs_no_more_than_one() -> None:
    """40 sensors that all read at times of their own: errors of 15 instants, not more."""
    rng, n = np.random.default_rng(2), 40
    s, F = rng.uniform(size=n), rng.normal(0, 50, (n, 3, 6))
    Q = np.diag(np.repeat([0.001, 0.02], 3) ** 2)
    own = np.tile(np.eye(3) / NOISE, (n, 1, 1))
    white = bridge_whitening(own, F, s, Q)
    assert white.common.shape[1] <= 6 * 15
    exact = np.einsum("ij,iak,kl,jbl->iajb", np.minimum.outer(s, s) - np.outer(s, s), F, Q, F)
    S = exact.reshape(3 * n, 3 * n) + NOISE**2 * np.eye(3 * n)
    half = white(S.reshape(n, 3, 3 * n))
    whole = white(half.T.reshape(n, 3, 3 * n))
    # Instants less than a sixteenth of a step apart count as one, what is between them as noise: a
    # little too much of it on the whole, and by less than twice too little in any direction, where
    # odometry's errors on the way are five times the noise.
    assert 0.8 < np.trace(whole) / (3 * n) <= 1.0
    assert np.linalg.eigvalsh(whole).max() < 2.0
