"""Scans on the cloud of a map, as they come: fixes of the key poses of their times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.geometry import compose
from l2m_gtsam.lidar.odometry import LEAST_POINTS
from l2m_gtsam.lidar.registration import PoseEstimate, by_scan, register
from l2m_gtsam.lidar.scan_localisation import ScanLocalisationOptions
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.slam.links import MAP, Links, carried_on
from l2m_gtsam.slam.online.key_pose import ScanAtKeyPose
from l2m_gtsam.slam.options import DriftOptions

# Along what a scan does not show a fix says nothing; more than this would drown in rounding.
UNSEEN = {"unseen_m": 100.0, "unseen_deg": 100.0}


@dataclass(frozen=True)
class ScanLinks:
    """What scans say of a key pose, and why some say nothing."""

    links: Links
    refused: tuple[str, ...]


class ScanMatcher:
    """Registers scans on a cloud.

    Parameters
    ----------
    cloud
        In the map frame.
    options
        How, and when a scan is refused.
    edge
        Cell size in metres; scans are thinned to one point per cell.
    drift
        Of odometry, from the scan to its key pose.
    """

    def __init__(
        self, cloud: Surface, options: ScanLocalisationOptions, edge: float, drift: DriftOptions
    ) -> None:
        registration = options.registration.model_copy(update=UNSEEN)
        self._cloud, self._edge, self._drift = cloud, edge, drift
        self._options = options.model_copy(update={"registration": registration})
        self._path_m = np.inf  # since the last fix

    def fixes(
        self, scans: Sequence[ScanAtKeyPose], number: int, expected: PoseEstimate, step_m: float
    ) -> ScanLinks:
        """Return what scans say of a key pose.

        Parameters
        ----------
        scans
            At the key pose.
        number
            Of the key pose.
        expected
            Where it is expected in the map.
        step_m
            Path in metres since the key pose before.
        """
        self._path_m += step_m
        found, refused = [Links.none()], list[str]()
        for each in scans:
            if len(each.points) < LEAST_POINTS:
                refused.append("a scan has too few points")
                continue
            guess = compose(expected.T, each.T_key_scan)
            surface = Surface(each.points, self._edge)
            registration = self._options.registration
            seen = register(surface, self._cloud, guess, registration)
            if (refusal := seen.refusal(registration)) is not None:
                refused.append(f"a scan is left out: {refusal.value}")
                continue
            found.append(self._link(by_scan(seen, guess, registration), each, number))
            self._path_m = 0.0
        return ScanLinks(Links.joined(found), tuple(refused))

    def _link(self, fix: PoseEstimate, at: ScanAtKeyPose, number: int) -> Links:
        """Return a fix of a scan as one of its key pose, less what neighbouring ones share."""
        # n fixes that share an error of the cloud get n times its covariance.
        over = self._options.cloud_over_m
        shared = over / np.clip(self._path_m, 0.02 * over, over)
        own = PoseEstimate(fix.T, fix.covariance + shared * self._options.of_cloud())
        return Links.single(MAP, number, carried_on(own, at.T_key_scan.inverse(), self._drift))
