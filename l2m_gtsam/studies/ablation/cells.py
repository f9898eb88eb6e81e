"""What map, density of its survey and weights do to a calibration: the paper's ablation.

Maps of each kind are made of fingerprints of one survey at several densities. Random sensors,
each on its own drive, are calibrated on each of them by each method. All maps and methods get the
same drives and the same guesses, so that differences are paired.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.options import Options
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import NoiseOptions, SamplingOptions, SensorArrayOptions
from l2m_gtsam.solve.closed_form import ClosedFormOptions, Method, Weighting
from l2m_gtsam.studies.ablation.map_image import MapImage, WindowOptions
from l2m_gtsam.studies.json_arrays import JsonFloats
from l2m_gtsam.studies.methods import errors_of, one_key, two_step
from l2m_gtsam.studies.site import (
    SiteDrive,
    SiteOptions,
    SurveyedSite,
    around,
    random_drive,
    surveyed,
    surveyed_floor,
    thinned,
)

DRIVE, START = 1, 2  # streams of randomness


class Solver(StrEnum):
    """A method of the study; its value is what page and figures call it."""

    OLS = "OLS"
    RRTLS = "RRTLS"
    PAPER = "w-RRTLS (paper's weights)"
    LIKELIHOOD = "w-RRTLS"
    ONE_KEY = "ours"


CLOSED_FORMS = {
    Solver.OLS: ClosedFormOptions(method=Method.OLS),
    Solver.RRTLS: ClosedFormOptions(method=Method.RRTLS),
    Solver.PAPER: ClosedFormOptions(method=Method.W_RRTLS, weighting=Weighting.PAPER),
    Solver.LIKELIHOOD: ClosedFormOptions(method=Method.W_RRTLS),
}
"""The closed form in the two-step loop of each method; ours is no such loop."""


class AblationOptions(Options):
    """Size and conditions of the study; lengths in metres."""

    seed: int = Field(default=1, ge=0)
    """Of drives, sensors and guesses; the site has its own."""
    batches: int = Field(default=10, ge=1)
    """Cells of each map."""
    batch: int = Field(default=5, ge=1)
    """Sensors of random place and distortion in each, each on its own drive."""
    kinds: tuple[str, ...] = ("bilinear", "sliding_gp", "harmonic")
    """Kinds of maps."""
    spacings: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Densities of fingerprints: of each cell of the floor of this size one is kept at each
    height; 0 keeps the whole survey."""
    around: float = Field(default=3.0, gt=0)
    """Fingerprints within so many metres of the calibration drive take part: the rest of the hall
    does not count."""
    guess: float = Field(default=0.3, gt=0)
    """Guesses are off the truth by up to this."""
    window: WindowOptions = WindowOptions()
    """The part of the maps that is drawn."""
    site: SiteOptions = SiteOptions(
        scenario=ScenarioOptions(
            array=SensorArrayOptions(count=1),
            noise=NoiseOptions(field=0.5),
            calibration_sampling=SamplingOptions(field_rate=10.0),
        )
    )
    """World, survey and drives, with the noise of the paper's study in both drives."""
    search: StartOptions = StartOptions()
    """Our method's search for its start, around the guess."""
    solve: OneKeyOptions = OneKeyOptions(uncertainty=Uncertainty.INDEPENDENT)
    """How our method solves: the study is of values, not of sigmas."""


@dataclass(frozen=True)
class BatchErrors:
    """Errors of R calibrations by each of M methods, NaN for those without a result.

    Attributes
    ----------
    t
        Distance of the sensor's estimated position from the true one in metres, shape (R, M).
    C
        Frobenius norm of the error of C, shape (R, M).
    H
        Length of the error of H in microtesla, shape (R, M).
    """

    t: JsonFloats
    C: JsonFloats
    H: JsonFloats


@dataclass(frozen=True)
class AblationCell:
    """A batch of calibrations on one map, or the map itself."""

    batch: BatchErrors | None = None
    picture: MapImage | None = None


@dataclass(frozen=True)
class DrivenHall:
    """What all maps share.

    Attributes
    ----------
    part
        The survey around the drives.
    floor
        That it covers, in square metres.
    """

    part: SurveyedSite
    floor: float
    drives: tuple[SiteDrive, ...]


@dataclass(frozen=True)
class MappedDrives:
    """A map of one kind at one density.

    Attributes
    ----------
    hall
        Drives, and the fingerprints of which the map is made.
    """

    hall: DrivenHall
    field_map: QueryableMap


def mapped_drives(options: AblationOptions, kind: str, spacing: float) -> MappedDrives:
    """Return a map and the drives through it."""
    hall = ablation_hall(options)
    part = thinned(hall.part, spacing)
    chosen = map_options(options.site.mapping.model, kind, spacing)
    return MappedDrives(replace(hall, part=part), part.map(chosen))


@lru_cache(maxsize=1)
def ablation_hall(options: AblationOptions) -> DrivenHall:
    """Return survey and drives; made once in each process."""
    whole = surveyed(options.site)
    drives = tuple(
        random_drive(whole, options.site, np.random.default_rng([options.seed, which, DRIVE]))
        for which in range(options.batches * options.batch)
    )
    # All drives take one route.
    part = around(whole, drives[0].readings.p_map_lidar, options.around)
    return DrivenHall(part, surveyed_floor(part.survey.points), drives)


def map_options(base: MapOptions, kind: str, spacing: float) -> MapOptions:
    """Return the options of a kind of map for a density; a bilinear grid is no finer than that."""
    bilinear = base.bilinear.model_copy(
        update={
            "spacing": max(base.bilinear.spacing, spacing),
            "reach": max(base.bilinear.reach, spacing),
        }
    )
    return base.model_copy(update={"kind": kind, "bilinear": bilinear})


def ablation_batch(options: AblationOptions, place: MappedDrives, number: int) -> BatchErrors:
    """Calibrate the sensors of one batch by all methods."""
    first = number * options.batch
    errors = np.array(
        [
            [calibration_errors(options, place, which, solver) for solver in Solver]
            for which in range(first, first + options.batch)
        ]
    )
    return BatchErrors(errors[..., 0], errors[..., 1], errors[..., 2])


def calibration_errors(
    options: AblationOptions, place: MappedDrives, which: int, solver: Solver
) -> FloatArray:
    """Return the errors of t, C and H of one calibration, shape (3,)."""
    drive = place.hall.drives[which]
    guess = drive.sensor.t_lidar_mag + random_offset(options, which)
    given = drive.readings, place.field_map
    if solver is Solver.ONE_KEY:
        end = one_key(*given, guess[None], options.search, options.solve).vector
    else:
        end = two_step(*given, guess, CLOSED_FORMS[solver])[None]
    return np.asarray(errors_of(end, drive.sensor)[0])


def random_offset(options: AblationOptions, which: int) -> FloatArray:
    """Return how far off the guess of one sensor is, metres, shape (3,): any direction."""
    rng = np.random.default_rng([options.seed, which, START])
    direction = rng.standard_normal(3)
    return np.asarray(options.guess * rng.uniform() * direction / np.linalg.norm(direction))
