"""A pose graph as others have it, with odometry and LiDAR, that takes magnetometers in ten lines.

Run ``PYTHONPATH=factors python factors/examples/pose_graph.py``: errors without and with
magnetometers, off line and by iSAM2. The field is that of two dipoles; any map with
``field_and_gradient`` will do.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X  # keys of the graph's owner, not those of l2m_factors

from l2m_factors import Calibrations, magnetic_pose_factor
from l2m_factors.field_map import FloatArray

POSES, STEP_M, TURN_RAD, LAST_LOOP = 80, 0.25, 2 * np.pi / 40, 60
ODOMETRY = gtsam.noiseModel.Diagonal.Sigmas(np.array([2e-3, 2e-3, 5e-3, 0.02, 0.02, 5e-3]))
LIDAR = gtsam.noiseModel.Diagonal.Sigmas(np.array([5e-3, 5e-3, 5e-3, 0.03, 0.03, 0.03]))
START = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
NOISE_UT = 0.3


class DipoleField:
    """The field of dipoles in a uniform one."""

    uniform = np.array([20.0, 0.0, -40.0])
    place = np.array([[2.8, 3.6, 0.5], [-3.0, 0.6, -0.4]])
    moment = np.array([[240.0, 0.0, 320.0], [0.0, -280.0, 240.0]])

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        r = points[:, None] - self.place
        d = np.linalg.norm(r, axis=2)[:, :, None]
        along = np.einsum("nki,ki->nk", r, self.moment)[:, :, None]
        field = self.uniform + 0.1 * np.sum(3 * along * r / d**5 - self.moment / d**3, axis=1)
        m, eye = self.moment[None, :, :, None], np.eye(3)
        mixed = m * r[:, :, None] + r[:, :, :, None] * self.moment[None, :, None]
        slope = 3 * (mixed + along[..., None] * eye) / d[..., None] ** 5
        slope -= 15 * along[..., None] * r[:, :, :, None] * r[:, :, None] / d[..., None] ** 7
        return field, 0.1 * slope.sum(axis=1)


@dataclass(frozen=True)
class MagneticDrive:
    """Two laps: true poses, odometry between them, and what two magnetometers read at each."""

    truth: list[gtsam.Pose3]
    steps: list[gtsam.Pose3]
    loops: list[tuple[int, int, gtsam.Pose3]]
    field: FloatArray
    sensors: Calibrations


def driven(field_map: DipoleField, seed: int = 1) -> MagneticDrive:
    """Return a drive with errors as its noise models have them."""
    rng = np.random.default_rng(seed)
    step = gtsam.Pose3(gtsam.Rot3.Rz(TURN_RAD), np.array([STEP_M, 0.0, 0.0]))
    truth = [gtsam.Pose3()]
    while len(truth) < POSES:
        truth.append(truth[-1].compose(step))
    steps = [step.retract(rng.normal(0, ODOMETRY.sigmas())) for _ in truth[1:]]
    loops = [
        (k - 40, k, truth[k - 40].between(truth[k]).retract(rng.normal(0, LIDAR.sigmas())))
        for k in range(40, LAST_LOOP, 10)
    ]
    t = np.array([[0.2, 0.1, 0.3], [-0.2, -0.1, 0.3]])
    distortion = np.tile(np.append(np.eye(3).ravel(), [3.0, -2.0, 1.0]), (2, 1))
    sensors = Calibrations(t, distortion, np.zeros(2))
    field = []
    for pose in truth:
        B, _ = field_map.field_and_gradient(np.stack([pose.transformFrom(each) for each in t]))
        own = B @ pose.rotation().matrix() + sensors.distortion[:, 9:]
        field.append(own + rng.normal(0, NOISE_UT, own.shape))
    return MagneticDrive(truth, steps, loops, np.stack(field), sensors)


def owners_factors(drive: MagneticDrive, k: int) -> gtsam.NonlinearFactorGraph:
    """Return the factors that the graph's owner adds with pose k."""
    graph = gtsam.NonlinearFactorGraph()
    if k == 0:
        graph.add(gtsam.PriorFactorPose3(X(0), drive.truth[0], START))
        return graph
    graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), drive.steps[k - 1], ODOMETRY))
    for first, last, relative in drive.loops:
        if last == k:
            graph.add(gtsam.BetweenFactorPose3(X(first), X(last), relative, LIDAR))
    return graph


def magnetic_factor(drive: MagneticDrive, field_map: DipoleField, k: int) -> gtsam.NonlinearFactor:
    """Return what magnetometers add to pose k: these are the ten lines."""
    return magnetic_pose_factor(
        key=X(k),
        field_map=field_map,
        sensors=drive.sensors,
        sensor=np.array([0, 1]),
        field=drive.field[k],
        noise=gtsam.noiseModel.Isotropic.Sigma(6, NOISE_UT),
    )


def start_values(drive: MagneticDrive) -> gtsam.Values:
    """Return the poses of odometry."""
    values, pose = gtsam.Values(), drive.truth[0]
    values.insert(X(0), pose)
    for k, step in enumerate(drive.steps, start=1):
        pose = pose.compose(step)
        values.insert(X(k), pose)
    return values


def without(drive: MagneticDrive) -> gtsam.Values:
    """Solve the graph as its owner has it."""
    graph = gtsam.NonlinearFactorGraph()
    for k in range(len(drive.truth)):
        graph.push_back(owners_factors(drive, k))
    return gtsam.LevenbergMarquardtOptimizer(graph, start_values(drive)).optimize()


def off_line(drive: MagneticDrive, field_map: DipoleField) -> gtsam.Values:
    """Solve all poses together with magnetometers, from where the owner's graph has them.

    From odometry that has drifted past a source, the field leads elsewhere.
    """
    graph = gtsam.NonlinearFactorGraph()
    for k in range(len(drive.truth)):
        graph.push_back(owners_factors(drive, k))
        graph.add(magnetic_factor(drive, field_map, k))
    return gtsam.LevenbergMarquardtOptimizer(graph, without(drive)).optimize()


def on_line(drive: MagneticDrive, field_map: DipoleField) -> gtsam.Values:
    """Add pose after pose to iSAM2."""
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.01)
    params.relinearizeSkip = 1
    isam = gtsam.ISAM2(params)
    pose = drive.truth[0]
    for k in range(len(drive.truth)):
        if k:
            pose = isam.calculateEstimatePose3(X(k - 1)).compose(drive.steps[k - 1])
        values = gtsam.Values()
        values.insert(X(k), pose)
        graph = owners_factors(drive, k)
        graph.add(magnetic_factor(drive, field_map, k))
        isam.update(graph, values)
        isam.update()
    return isam.calculateEstimate()


def error_m(drive: MagneticDrive, values: gtsam.Values) -> float:
    """Return the root mean square error of positions in metres."""
    off = [
        values.atPose3(X(k)).translation() - pose.translation()
        for k, pose in enumerate(drive.truth)
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(off), axis=1))))


if __name__ == "__main__":
    dipoles = DipoleField()
    made = driven(dipoles)
    print(f"odometry and LiDAR:           {1e3 * error_m(made, without(made)):.0f} mm")
    print(f"with magnetometers, off line: {1e3 * error_m(made, off_line(made, dipoles)):.0f} mm")
    print(f"with magnetometers, iSAM2:    {1e3 * error_m(made, on_line(made, dipoles)):.0f} mm")
