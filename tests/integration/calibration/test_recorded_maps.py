"""Maps of recordings that others made: one run predicts another, and calibrates an array."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, Readings
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap, HarmonicMap
from l2m_gtsam.records.calibration import Uncertainty

MAPPED = slice(0, 5)  # runs of the array that make its map
HALF = 2  # every second of the 800 readings of a run: neighbours are 5 mm apart


@dataclass(frozen=True)
class Run:
    """Places in metres and readings in uT of one run in the map frame, shape (N, 3)."""

    points: FloatArray
    field: FloatArray


def handheld(path: Path) -> tuple[Run, Run]:
    """Return both runs of the handheld recording."""
    with np.load(path) as file:
        R = Rotation.from_quat(file["quaternion_wxyz"], scalar_first=True).as_matrix()
        field = np.einsum("nij,nj->ni", R, file["mag_uT"])
        points, run = file["position"], file["run"]
    usable = np.isfinite(points).all(axis=1) & np.isfinite(field).all(axis=1)
    of_run = [usable & (run == number) for number in (0, 1)]
    first, second = (Run(points[rows], field[rows]) for rows in of_run)
    return first, second


@dataclass(frozen=True)
class Prediction:
    """How well a map predicts readings: rmse in uT and log-likelihood in nats of a reading."""

    rmse: float
    log_likelihood: float

    @classmethod
    def of(cls, sample: FieldSample, field: FloatArray, where: BoolArray) -> "Prediction":
        """Compare at some places; the sensor's noise is estimated, as a calibration does."""
        error2, variance = (field - sample.field)[where] ** 2, sample.variance[where]

        def cost(log_noise: float) -> float:
            total = variance + np.exp(2 * log_noise)
            return float(0.5 * np.mean(np.sum(error2 / total + np.log(2 * np.pi * total), axis=1)))

        best = minimize_scalar(cost, bounds=(-5, 3), method="bounded")
        return cls(float(np.sqrt(error2.mean())), -float(best.fun))


@pytest.mark.parametrize(
    "every", [*(pytest.param(each, marks=pytest.mark.study) for each in (4, 20)), 100]
)
def test_a_run_predicts_the_next_at_least_as_well_as_the_papers_map(
    shared_data: Path, every: int
) -> None:
    """From 5,192, 1,039 and 208 readings, at the places that both maps know."""
    first, second = handheld(shared_data / "optitrack_handheld_2runs.npz")
    points, field = second.points[::20], second.field[::20]

    def sample(kind: str) -> FieldSample:
        options = MapOptions(kind=kind)
        return build_map(first.points[::every], first.field[::every], options).query(points)

    harmonic, paper = sample("harmonic"), sample("sliding_gp")
    both = harmonic.inside & paper.inside
    assert both.mean() > 0.7
    ours, theirs = (Prediction.of(each, field, both) for each in (harmonic, paper))
    assert ours.rmse <= theirs.rmse
    assert ours.log_likelihood >= theirs.log_likelihood


@dataclass(frozen=True)
class Array:
    """Ten runs of an array of S sensors.

    Attributes
    ----------
    R, p
        Poses, shapes (10, N, 3, 3) and (10, N, 3).
    mag
        Readings in the frame of the array in uT, shape (10, N, S, 3).
    t
        Positions of the sensors in metres, shape (S, 3).
    """

    R: FloatArray
    p: FloatArray
    mag: FloatArray
    t: FloatArray

    @classmethod
    def load(cls, path: Path) -> "Array":
        with np.load(path) as file:
            quaternion, p = file["quaternion_wxyz"].astype(float), file["position"].astype(float)
            mag, t = file["mag_uT"].astype(float), file["sensor_positions_body"]
        R = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True).as_matrix()
        return cls(R.reshape(*p.shape[:2], 3, 3), p, mag, t)

    def field_map(self) -> CompiledMap:
        """Return the map of the runs that make it, from all sensors."""
        R, p = self.R[MAPPED, ::HALF], self.p[MAPPED, ::HALF]
        points = np.einsum("rnij,sj->rnsi", R, self.t) + p[:, :, None]
        field = np.einsum("rnij,rnsj->rnsi", R, self.mag[MAPPED, ::HALF])
        return HarmonicMap.fit(points.reshape(-1, 3), field.reshape(-1, 3)).compile()

    def readings(self, run: int) -> Readings:
        """Return the readings of a run, sensor by sensor."""
        S, R, p = len(self.t), self.R[run, ::HALF], self.p[run, ::HALF]
        return Readings(
            tuple(f"mag_{s}" for s in range(S)),
            np.repeat(np.arange(S), len(p)),
            np.tile(HALF * 10_000_000 * np.arange(len(p)), S),
            np.tile(R, (S, 1, 1)),
            np.tile(p, (S, 1)),
            self.mag[run, ::HALF].transpose(1, 0, 2).reshape(-1, 3),
        )


def calibrated(array: Array, field_map: CompiledMap, run: int) -> tuple[FloatArray, FloatArray]:
    """Return errors of t in metres, shape (S, 3), and their squared lengths in sigmas, (S,)."""
    options = OneKeyOptions(uncertainty=Uncertainty.FULL)
    solution = solve_one_key(array.readings(run), field_map, np.zeros_like(array.t), options)
    error = solution.estimate.t - array.t
    covariance = np.stack([each.covariance[:3, :3] for each in solution.solved])
    assert len(covariance) == len(array.t)
    return error, np.einsum(
        "si,si->s", error, np.linalg.solve(covariance, error[..., None])[..., 0]
    )


def test_an_array_of_thirty_is_placed_within_millimetres(shared_data: Path) -> None:
    """Map from five runs, a sixth calibrates: 2.5 mm rms, and inside the stated 95 %.

    Of 30 honest ellipsoids 27 or more hold the truth in 94 cases of 100.
    """
    array = Array.load(shared_data / "array30_simulated_10runs.npz")
    error, squared = calibrated(array, array.field_map(), run=6)
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.0025
    assert np.count_nonzero(squared < chi2.ppf(0.95, 3)) >= 27


@pytest.mark.study
def test_stated_errors_of_an_array_are_true(shared_data: Path) -> None:
    """All five other runs: of 150 honest ellipsoids 137 to 148 hold the truth, 97 times of 100."""
    array = Array.load(shared_data / "array30_simulated_10runs.npz")
    field_map, squares = array.field_map(), []
    for run in range(5, 10):
        error, squared = calibrated(array, field_map, run)
        rms = np.sqrt((error**2).sum(axis=1).mean())
        print(f"run {run}: {1e3 * rms:.2f} mm rms, NEES {squared.mean():.2f}")
        assert rms < 0.0025
        squares.append(squared)
    held = np.count_nonzero(np.concatenate(squares) < chi2.ppf(0.95, 3))
    assert 137 <= held <= 148
