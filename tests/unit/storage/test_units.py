"""A strength tells its unit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.units import MICROTESLA_PER, Unit, field_fault, strength


def turning_field(strength_ut: float, noise: float, count: int = 200) -> FloatArray:
    """Return readings of a turning sensor in uT; ``noise`` is relative."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return strength_ut * directions * (1 + noise * rng.normal(size=(count, 1)))


def judged(field: FloatArray, unit: Unit = Unit.AUTO) -> str | None:
    """Return what is wrong with readings that were written in tesla."""
    return field_fault(field * 1e-6, unit, Unit.TESLA)


@given(st.floats(11, 199))
def test_every_strength_on_earth_is_accepted(strength_ut: float) -> None:
    # The median of 200 readings with 0.1 % noise is far nearer than 1 uT to the strength.
    assert judged(turning_field(strength_ut, 1e-3)) is None


@pytest.mark.parametrize("unit", ["gauss", "microtesla", "nanotesla", "milligauss"])
@pytest.mark.parametrize("strength_ut", [25.0, 45.0, 65.0])
def test_the_true_unit_is_named(unit: str, strength_ut: float) -> None:
    """The Earth's field written in a unit and read as tesla."""
    read_as_tesla = turning_field(strength_ut, 1e-2) / MICROTESLA_PER[Unit(unit)] * 1e6
    sentence = judged(read_as_tesla)
    assert sentence is not None
    assert f"`bag.units: {unit}`" in sentence


@pytest.mark.parametrize("strength_ut", [1.0, 50.0, 100.0, 1e6])
@pytest.mark.parametrize("unit", [Unit.AUTO, Unit.TESLA, Unit.GAUSS])
def test_a_constant_length_is_no_strength(strength_ut: float, unit: Unit) -> None:
    field = turning_field(strength_ut, 0.0).astype(np.float32).astype(float)
    sentence = judged(field, unit)
    assert sentence is not None
    assert "no unit at all" in sentence


def test_a_sensor_that_stands_still_is_not_a_direction() -> None:
    """Rounding in the last digit must not look like turning."""
    still = np.array([20.0, 5.0, -40.0]) * (1 + 1e-9 * np.arange(100)[:, None])
    assert judged(still) is None


def test_noise_of_a_real_sensor_is_not_a_constant_length() -> None:
    # 1e-4 is a tenth of what the quietest magnetometers show, a hundred times the limit.
    assert judged(turning_field(50.0, 1e-4)) is None


def test_an_explicit_unit_is_believed() -> None:
    far_off = turning_field(5000.0, 1e-2)
    assert judged(far_off) is not None
    assert judged(far_off, Unit.GAUSS) is None


def test_dead_sensors_are_not_in_a_wrong_unit() -> None:
    assert judged(np.zeros((50, 3))) is None
    assert judged(np.full((50, 3), np.nan)) is None


def test_half_missing_readings_do_not_count() -> None:
    field = turning_field(50.0, 1e-2)
    holes = field.copy()
    holes[::2, 1] = np.nan
    assert strength(holes) == strength(field[1::2])


@pytest.mark.parametrize(
    ("written", "told"),
    [
        (178.0, "may be milligauss (17.8 uT) or microtesla (178 uT)"),
        (1.05, "may be gauss (105 uT) or a direction without a strength"),
        (0.45, "likely gauss: set `bag.units: gauss`"),
    ],
)
def test_what_may_be_several_units_is_not_called_one(written: float, told: str) -> None:
    sentence = field_fault(turning_field(written, 1e-2), Unit.AUTO, None)
    assert sentence is not None
    assert told in sentence
