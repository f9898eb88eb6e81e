"""Sentences about what is open, from rank tests and drives made for them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.solve.explain import DriveFacts, drive_facts, explain, held_offset, movement
from l2m_gtsam.solve.rank import RankOptions, determinacy

RANK = RankOptions()
EYE = np.broadcast_to(np.eye(3), (50, 3, 3))


def rich(seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(200, 15)) * 100


def facts(field: FloatArray, gradient: FloatArray) -> DriveFacts:
    """Return what is met along ten metres with one heading."""
    p = np.column_stack([np.linspace(0, 10, 50), np.zeros((50, 2))])
    return drive_facts(EYE, p, field, gradient)


def varied() -> DriveFacts:
    rng = np.random.default_rng(1)
    return facts(rng.normal(size=(50, 3)) * 10, rng.normal(size=(50, 3, 3)))


def test_nothing_is_said_of_what_is_determined() -> None:
    assert explain(determinacy(rich(), RANK), varied(), RANK) == ()


@pytest.mark.parametrize(("axis", "subject"), [(2, "height (t_z)"), (0, "position in part (t_x)")])
def test_a_position_gets_the_maps_gradient(axis: int, subject: str) -> None:
    J, gradient = rich(), np.zeros((50, 3, 3))
    J[:, axis] = 1e-9
    gradient[7, 1, axis] = 0.25
    drive = facts(np.random.default_rng(1).normal(size=(50, 3)), gradient)
    (sentence,) = explain(determinacy(J, RANK), drive, RANK)
    assert sentence.startswith(subject)
    assert sentence.endswith("gradient there is at most 0.25 uT/m")


def test_a_gradient_that_c_and_h_imitate_is_said_to_be() -> None:
    """The same 2 uT per metre everywhere: another H does that, too."""
    J, gradient = rich(), np.zeros((50, 3, 3))
    J[:, 2] = 1e-9
    gradient[:, 1, 2] = 2.0
    drive = facts(np.random.default_rng(1).normal(size=(50, 3)), gradient)
    (sentence,) = explain(determinacy(J, RANK), drive, RANK)
    assert "a metre changes the readings by 2 uT (rms), and all but 0.001 uT of it" in sentence


@pytest.mark.parametrize(("axis", "name"), [(0, "first"), (1, "second"), (2, "third")])
def test_a_column_of_c_gets_the_fields_spread(axis: int, name: str) -> None:
    J, field = rich(), np.random.default_rng(1).normal(size=(50, 3)) * 10
    for row in range(3):
        J[:, 3 + 3 * row + axis] = -40 * J[:, 12 + row]
    field[:, axis] = 20 + 0.3 * np.resize([1.0, -1.0], 50)
    (sentence,) = explain(determinacy(J, RANK), facts(field, np.zeros((50, 3, 3))), RANK)
    assert sentence.startswith(f"{name} column of C against H (")
    assert f"along the lidar's {'xyz'[axis]} axis varies by no more than 0.3 uT" in sentence
    assert f"C_x{'xyz'[axis]} with H_x" in sentence


def test_a_slanting_direction_is_given_by_its_components() -> None:
    J, field = rich(), np.random.default_rng(1).normal(size=(50, 3)) * 10
    for row in range(3):
        at = 3 + 3 * row
        J[:, at + 2] = -J[:, at + 1] - 40 * J[:, 12 + row]
    field[:, 2] = -field[:, 1]
    (sentence,) = explain(determinacy(J, RANK), facts(field, np.zeros((50, 3, 3))), RANK)
    assert sentence.startswith("C against H (")
    assert "along (0.00, 0.7" in sentence


def test_a_position_that_only_h_imitates() -> None:
    """No column of C takes part: none is named."""
    J, gradient = rich(), np.zeros((50, 3, 3))
    J[:, 0] = 30 * J[:, 12]
    gradient[:, 0, 0] = 30.0
    field = np.random.default_rng(1).normal(size=(50, 3)) * 10
    (sentence,) = explain(determinacy(J, RANK), facts(field, gradient), RANK)
    assert sentence.startswith("position against H (t_x with H_x): changed together, t by ")
    assert sentence.endswith("they alter the readings by 0.001 uT (rms)")


def test_position_and_a_column_of_c() -> None:
    """A field that grows along the drive: moving the sensor and its gain do the same."""
    rng = np.random.default_rng(1)
    J, field, gradient = rich(), rng.normal(size=(50, 3)) * 10, np.zeros((50, 3, 3))
    J[:, 0] = J[:, 5]
    gradient[:, 0, 0] = -field[:, 2]
    (sentence,) = explain(determinacy(J, RANK), facts(field, gradient), RANK)
    assert sentence.startswith("position and third column of C against H (t_x with C_xz)")


def test_a_vehicle_at_rest_is_the_reason_for_everything() -> None:
    still = drive_facts(EYE, np.zeros((50, 3)), np.ones((50, 3)), np.zeros((50, 3, 3)))
    (sentence,) = explain(determinacy(np.zeros((60, 15)), RANK), still, RANK)
    assert sentence.startswith("everything (")
    assert sentence.endswith("the vehicle did not move (0.00 m, 0.0 deg)")


def test_movement_is_measured() -> None:
    angles = [[0, 0, 0], [90, 0, 0], [0, 4, 0], [0, -4, 0]]
    R = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    moved = movement(R, np.array([[0, 0, 0.5], [3, 0, 0.5], [3, 4, 0.5], [0, 0, 0.7]]))
    assert moved.extent == pytest.approx(np.hypot(5, 0.2))
    assert moved.turn == pytest.approx(90)
    assert moved.heights == pytest.approx(0.2)
    assert moved.tilt == pytest.approx(4)
    assert not moved.at_rest


def test_a_held_offset_says_what_imitates_it() -> None:
    """Half a metre per second and a tenth of a radian about z, for ten milliseconds."""
    imitation = np.zeros(12)
    imitation[0], imitation[4], imitation[6] = 0.5, 0.1, -0.1
    test = replace(determinacy(rich(), RANK), imitation=imitation)
    assert held_offset(test) == (
        "held at 0: 10 ms look like t moved by (5.0, 0.0, 0.0) mm and the sensor turned by 0.06 "
        "deg; drive at another speed or the other way round, too"
    )
    assert held_offset(replace(test, imitation=np.zeros(12))).endswith(
        "nothing in this drive shows it"
    )
    assert held_offset(replace(test, offset=True)) == ""
