"""A drive laid out on tiles: how much noise the tiles are thought to take up."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.options import DriftOptions
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.slam import rounds
from tests.drives.uniform import EXACT, PRIOR, UNIFORM
from tests.worlds.exact import random_sensors

NOISE = 0.2
# No odometry error to speak of, and no source: residuals are noise and nothing else.
STILL = DriftOptions(
    steady=0.0,
    position_share=1e-6,
    rotation_deg_per_m=1e-6,
    rotation_share=0,
    least_m=1e-6,
    least_deg=1e-6,
)


@pytest.fixture(scope="module")
def drawn() -> DrawnDrive:
    rng = np.random.default_rng(2)
    return drawn_drive(
        UNIFORM, random_sensors(2, 6), rounds(20), rng, EXACT, NOISE, every=4, drift=STILL
    )


def counted(drawn: DrawnDrive, stated: float, spoilt: FloatArray, weights: FloatArray) -> float:
    """Return the parameters that are counted, as a share of those with noise as stated.

    ``spoilt`` is added to the squared lengths of residuals, shape (N,).
    """
    drive = drawn.drive
    poses = drawn.poses
    tiled = TiledDrive.lasting(RelativeMotions.along(drive, poses), poses, drive.sensors, PRIOR)
    noise = np.full(len(drive.sensors.names), stated)
    prediction = tiled.prediction(tiled.weights(drive.sensors, noise), drive.sensors)
    squared = spoilt + prediction.squared(prediction.whitening(noise))
    of_noise = sum(each.parameters for each in tiled.penalties(noise, weights, squared))
    chosen = np.flatnonzero(weights)
    as_stated = (
        tile.penalty(np.intersect1d(tile.rows, chosen), noise).parameters for tile in tiled.tiles
    )
    return of_noise / sum(as_stated)


@pytest.mark.parametrize(("stated", "share"), [(0.2, 1.0), (0.4, 0.25), (3.2, 1 / 256), (0.1, 1.0)])
def test_tiles_take_up_the_noise_that_there_is(
    drawn: DrawnDrive, stated: float, share: float
) -> None:
    """By the residuals, however large noise is said to be; more than is said never counts.

    The squares of 3 N normal numbers scatter by sqrt(2 / 3 N) of their mean: four times that.
    """
    count = len(drawn.drive.readings)
    found = counted(drawn, stated, np.zeros(count), np.ones(count))
    assert found == pytest.approx(share, rel=4 * np.sqrt(2 / (3 * count)))
    assert found <= 1.0


def test_readings_that_do_not_count_say_nothing_of_the_noise(drawn: DrawnDrive) -> None:
    count = len(drawn.drive.readings)
    wrong = np.arange(count) % 7 == 0
    found = counted(drawn, 0.4, 1e6 * wrong, 1.0 - wrong)
    assert found == pytest.approx(0.25, rel=4 * np.sqrt(2 / (3 * (~wrong).sum())))


def test_a_tile_without_readings_is_not_laid(drawn: DrawnDrive) -> None:
    """Its readings gone, the others keep their numbers and all of theirs."""
    drive = drawn.drive
    poses = drawn.poses
    motions = RelativeMotions.along(drive, poses)
    whole = TiledDrive.lasting(motions, poses, drive.sensors, PRIOR)
    assert len(whole.tiles) > 1
    gone = whole.tiles[0]
    kept = np.setdiff1d(np.arange(len(drive.readings)), gone.rows)
    left = replace(motions, readings=motions.readings[kept])
    fewer = TiledDrive.lasting(left, poses, drive.sensors, PRIOR)
    assert [each.number for each in fewer.tiles] == [each.number for each in whole.tiles[1:]]
    for after, before in zip(fewer.tiles, whole.tiles[1:], strict=True):
        np.testing.assert_array_equal(kept[after.rows], before.rows)
