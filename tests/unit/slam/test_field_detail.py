"""How much of a field's detail one field for a whole drive holds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, Recording, SourceFile, Trajectory
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.drive import EXACT_START, Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions, WholeFieldOptions
from l2m_gtsam.slam.unknown_field import whole_field
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.whole_field import (
    CLEAR,
    COARSE,
    fine_prior,
    full_prior,
    learnt_prior,
    shortest_held,
    spectrum_at,
    waves_for,
)
from l2m_gtsam.studies.slam.methods import as_recorded

COUNT, EVERY_S = 300, 0.25
NOISE_UT = 0.1


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Ten laps of a metre at different heights, in a field that changes over 30 cm."""
    rng, at = np.random.default_rng(4), np.linspace(0, 20 * np.pi, COUNT)
    p = np.column_stack([0.5 * np.cos(at), 0.4 * np.sin(0.97 * at), 0.2 * np.sin(0.31 * at)])
    R = Rotation.from_euler("zx", np.column_stack([at, 0.3 * np.sin(at)])).as_matrix()
    prior = PotentialHyperparameters(sigma=3.0, length=0.3)
    basis = PotentialBasis.over(p.min(axis=0) - 0.5, p.max(axis=0) + 0.5, prior, 900)
    b = basis.features(p) @ (np.sqrt(basis.variance) * rng.normal(size=len(basis)))
    field = np.einsum("nji,nj->ni", R, b) + NOISE_UT * rng.normal(size=b.shape)
    stamps = np.round(1e9 * EVERY_S * np.arange(COUNT)).astype(np.int64)
    recording = Recording(
        Trajectory(stamps, R, p, "map", "lidar"),
        (FieldSeries("mag", "/mag", "lidar", stamps, field),),
        SourceFile("laps", ""),
    )
    found, _ = prepared(recording, as_recorded(NOISE_UT), SlamOptions())
    return replace(found, start=replace(found.start, covariance=EXACT_START))


def test_a_field_with_detail_is_likelier_as_a_fine_one(drive: Drive) -> None:
    """At true poses, by more than 50 nats: what a coarse one leaves out is no noise."""
    options, poses = WholeFieldOptions(), drive.dead_reckoning()
    coarse = learnt_prior(drive, poses, options)
    assert coarse is not None
    fine = fine_prior(drive, poses, options, coarse.spectrum)
    assert fine.waves > coarse.waves
    assert fine.spectrum.log_likelihood > coarse.spectrum.log_likelihood + 50


def test_a_fine_field_has_as_many_waves_as_are_allowed(drive: Drive) -> None:
    poses = drive.dead_reckoning()
    assert fine_prior(drive, poses, WholeFieldOptions(waves=60)).waves == 60


def with_length(spectrum: FieldSpectrum, length: float) -> FieldSpectrum:
    return replace(spectrum, prior=spectrum.prior.model_copy(update={"length": length}))


@pytest.fixture(scope="module")
def short(drive: Drive) -> FieldSpectrum:
    """What is learnt of the drive, but for a length that needs hundreds of waves."""
    learnt = spectrum_at(drive, drive.dead_reckoning(), WholeFieldOptions(), COARSE)
    return with_length(learnt, 0.15)


def test_the_shortest_length_that_is_held_is_the_shortest(
    drive: Drive, short: FieldSpectrum
) -> None:
    poses, waves = drive.dead_reckoning(), 80
    least = shortest_held(drive, poses, waves, short)

    def needed(length: float) -> int:
        return full_prior(drive, poses, with_length(short, length), COARSE).waves

    assert least is not None
    assert least > short.prior.length
    assert needed(least) <= waves < needed(0.94 * least)  # lengths are tried in steps of 5 %


def test_a_box_that_no_length_fits_has_no_prior(
    drive: Drive, short: FieldSpectrum, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As along hundreds of metres: the drive is one for tiles then."""
    monkeypatch.setattr(whole_field, "spectrum_at", lambda *_: short)
    monkeypatch.setattr(whole_field, "waves_for", lambda *_: 81)
    poses, options = drive.dead_reckoning(), WholeFieldOptions(waves=80)
    assert shortest_held(drive, poses, options.waves, short) is None
    assert learnt_prior(drive, poses, options) is None


@pytest.mark.parametrize("less", [-3.0, 0.5 * CLEAR, 2 * CLEAR])
def test_detail_that_nothing_speaks_for_is_no_detail(
    drive: Drive, short: FieldSpectrum, monkeypatch: pytest.MonkeyPatch, less: float
) -> None:
    """A search that ended at short waves is done again among longer ones."""

    def searched(*given: object) -> FieldSpectrum:
        if not isinstance(shortest_m := given[-1], float):
            return short
        longer = with_length(short, shortest_m)
        return replace(longer, log_likelihood=short.log_likelihood - less)

    monkeypatch.setattr(whole_field, "spectrum_at", searched)
    prior = learnt_prior(drive, drive.dead_reckoning(), WholeFieldOptions(waves=80))
    assert (prior is None) == (less > CLEAR)
    assert prior is None or prior.waves <= 80


def test_waves_below_a_cut_are_counted() -> None:
    """In a large box there are ``V k^3 / (6 pi^2)``, less what its faces take: a few per cent."""
    size, cut = np.array([9.0, 8.0, 7.0]), 12.0
    bulk = np.prod(size) * cut**3 / (6 * np.pi**2)
    assert waves_for(size, cut) == pytest.approx(bulk, rel=0.1)
