"""The halves of a drive by the graph of the whole: as two calibrations in one graph have it."""

import numpy as np
import pytest

from l2m_gtsam.calibration.half_difference import (
    JUDGED,
    HalfDifference,
    HalvedSensor,
    WhiteGroup,
    half_differences,
)
from l2m_gtsam.calibration.joint_information import Rows
from l2m_gtsam.calibration.sensor_columns import SENSOR

WEIGHTS, READINGS, SENSORS = 5, 60, 2
COUNT = WEIGHTS + SENSOR * SENSORS
SHARED = np.arange(WEIGHTS)


def own(sensor: int) -> np.ndarray:
    return WEIGHTS + SENSOR * sensor + np.arange(SENSOR)


class Drive:
    """A linear problem of two sensors that share errors of unit variance."""

    def __init__(
        self, seed: int, moved: np.ndarray | None = None, blind: int | None = None
    ) -> None:
        rng = np.random.default_rng(seed)
        self.later = np.arange(READINGS) >= READINGS // 2
        self.sign = np.repeat(np.where(self.later, 1.0, -1.0), 3)[:, None]
        scale = np.repeat([1e3, 1e2, 1e1, 1e2], [3, 9, 3, 1])
        self.raw, self.W, self.z = [], [], []
        shared = rng.normal(size=WEIGHTS)
        for sensor in range(SENSORS):
            J = np.zeros((3 * READINGS, COUNT))
            J[:, own(sensor)] = scale * rng.normal(size=(3 * READINGS, SENSOR))
            J[:, SHARED] = 2 * rng.normal(size=(3 * READINGS, WEIGHTS))
            if blind is not None:  # what only the first half sees
                J[np.repeat(self.later, 3), own(sensor)[blind]] = 0.0
            # Noise of neighbours is correlated, across the middle, too.
            L = np.eye(3 * READINGS) + 0.5 * np.eye(3 * READINGS, k=-3)
            noise = L @ rng.normal(size=3 * READINGS)
            if moved is not None and sensor == 0:
                noise += 0.5 * self.sign[:, 0] * (J[:, own(0)[:JUDGED]] @ moved)
            self.raw.append(J)
            self.W.append(np.asarray(np.linalg.inv(L), dtype=np.float64))
            self.z.append(noise - J[:, SHARED] @ shared)

    def found(self) -> dict[int, HalfDifference]:
        """As the code has it, at the optimum of the whole."""
        X = np.concatenate([W @ J for W, J in zip(self.W, self.raw, strict=True)])
        e = np.concatenate([W @ z for W, z in zip(self.W, self.z, strict=True)])
        information = X.T @ X
        information[SHARED, SHARED] += 1.0
        covariance = np.linalg.inv(information)
        left = e - X @ (covariance @ (X.T @ e))
        groups = []
        for sensor, J in enumerate(np.split(X, SENSORS)):
            columns = np.concatenate([own(sensor), SHARED])
            residual = np.split(left, SENSORS)[sensor]
            rows = Rows(sensor, columns, J[:, columns], residual, np.arange(READINGS))
            groups.append(WhiteGroup(rows, self.W[sensor]))
        halved = {s: HalvedSensor(own(s)[:JUDGED], float(SENSOR)) for s in range(SENSORS)}
        return half_differences(groups, self.later, halved, covariance, np.empty((COUNT, 0)))

    def apart(self) -> tuple[np.ndarray, np.ndarray]:
        """By a larger problem, in which sensors of either half are variables of their own."""
        rows, values = [], []
        for sensor, (J, W, z) in enumerate(zip(self.raw, self.W, self.z, strict=True)):
            beside = np.zeros((len(J), JUDGED * SENSORS))
            beside[:, JUDGED * sensor : JUDGED * (sensor + 1)] = (
                0.5 * self.sign * J[:, own(sensor)[:JUDGED]]
            )
            rows.append(W @ np.hstack([J, beside]))
            values.append(W @ z)
        prior = np.zeros((WEIGHTS, COUNT + JUDGED * SENSORS))
        prior[SHARED, SHARED] = 1.0
        A, y = np.concatenate([*rows, prior]), np.concatenate([*values, np.zeros(WEIGHTS)])
        information = A.T @ A
        return np.linalg.solve(information, A.T @ y)[COUNT:], np.linalg.inv(information)[
            COUNT:, COUNT:
        ]


def test_it_is_what_two_sensors_of_one_drive_say() -> None:
    drive = Drive(1)
    found, (difference, covariance) = drive.found(), drive.apart()
    for sensor in range(SENSORS):
        at = slice(JUDGED * sensor, JUDGED * (sensor + 1))
        # Residuals are ``measured`` less predicted there, and predicted less measured here.
        np.testing.assert_allclose(found[sensor].vector, -difference[at], rtol=1e-6)
        ratio = found[sensor].covariance / covariance[at, at]
        # Alike but for the noise, which 180 readings less 31 tell to a tenth.
        np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-6)
        assert ratio[0, 0] == pytest.approx(1, abs=0.5)


def test_honest_halves_are_as_far_apart_as_sigmas_say() -> None:
    """Mean squares of 60 sensors of 15: their spread is 15 * sqrt(2 / 15 / 60)."""
    squares = [
        each.vector @ np.linalg.solve(each.covariance, each.vector)
        for seed in range(30)
        for each in Drive(seed).found().values()
    ]
    # A variance by 149 readings makes the mean of its inverse larger by 2 in 149.
    assert np.mean(squares) == pytest.approx(15 * 149 / 147, abs=4 * 15 * np.sqrt(2 / 15 / 60))


def test_a_sensor_that_moved_is_told_from_one_that_did_not() -> None:
    moved = np.zeros(JUDGED)
    moved[:3] = 0.01
    sensors = Drive(4, moved).found()
    squared = [
        each.vector @ np.linalg.solve(each.covariance, each.vector) for each in sensors.values()
    ]
    np.testing.assert_allclose(np.abs(sensors[0].vector[:3]), 0.01, rtol=0.2)
    assert squared[0] > 100
    assert squared[1] < 40  # 15 by chance, 38 in 0.1 %


def test_what_one_half_does_not_see_is_open() -> None:
    for each in Drive(2, blind=2).found().values():
        open_ = np.isinf(np.diag(each.covariance))
        assert open_.tolist() == [k == 2 for k in range(JUDGED)]
        kept = np.ix_(~open_, ~open_)
        assert np.isfinite(each.vector).all()
        assert np.linalg.eigvalsh(each.covariance[kept]).min() > 0
