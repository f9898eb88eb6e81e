"""How far off a guess may be: calibrations from starts around the truth, ring by ring.

The protocol is the paper's (Success rate): random distortions, each with random starts; a
calibration succeeds if the sensor's position ends within 2 cm (small) or 5 cm (medium) of the
truth. Two methods get the same readings, map and starts. *One-key* looks for a start in a ball
around the given one and solves from there: the given start is all that it is told. *LM* is
Levenberg-Marquardt over t, C and H from the given start itself.

A cell of the study, one distortion and one ring, is a function of the options alone: cells may be
computed in any order and anywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import BoolArray, FloatArray, Readings
from l2m_gtsam.graph.alternation import OneKeyOptions
from l2m_gtsam.graph.global_start import StartOptions, find_starts
from l2m_gtsam.graph.one_key import solve_one_key
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.options import Options
from l2m_gtsam.results import FoundStart, Uncertainty
from l2m_gtsam.studies.levenberg_marquardt import levenberg_marquardt
from l2m_gtsam.studies.share import Share
from l2m_gtsam.studies.site import SiteOptions, mapped_site, random_drive

DRIVE, STARTS = 1, 2  # streams of randomness


class BasinOptions(Options):
    """Size and conditions of the study; lengths in metres."""

    seed: int = Field(default=1, ge=0)
    """Of drives, sensors and starts; the site has its own."""
    distortions: int = Field(default=20, ge=1)
    """Sensors of random place and distortion, each on its own drive."""
    starts: int = Field(default=100, ge=1)
    """Of each sensor in each ring."""
    rings: int = Field(default=12, ge=1)
    """Rings of initial offsets, from the truth outwards."""
    width: float = Field(default=0.25, gt=0)
    """Of a ring."""
    small: float = Field(default=0.02, gt=0)
    """An error up to this is small."""
    medium: float = Field(default=0.05, gt=0)
    """An error up to this is medium at most."""
    site: SiteOptions = SiteOptions()
    """World, map and drives."""
    search: StartOptions = StartOptions()
    """How one-key looks for its start, around the given one."""
    solve: OneKeyOptions = OneKeyOptions(uncertainty=Uncertainty.INDEPENDENT)
    """How one-key solves. The study looks at places, not at sigmas, which are ten times as much
    work with the map's full uncertainty."""


@dataclass(frozen=True)
class Cell:
    """What came of one distortion and one ring; positions in the lidar frame in metres.

    Attributes
    ----------
    distortion, ring
        Which cell this is.
    t_true
        Shape (3,).
    t_start
        Given starts, shape (N, 3).
    t_found
        Where one-key started from, NaN where it found no start, shape (N, 3).
    margin
        How clearly, see ``FoundStart``; infinite where nothing was found, shape (N,).
    ambiguous
        Which calibrations one-key would call ambiguous, shape (N,).
    t_one_key
        Where one-key ended, NaN where it ended without a result, shape (N, 3).
    t_lm
        Where Levenberg-Marquardt ended, shape (N, 3).
    """

    distortion: int
    ring: int
    t_true: FloatArray
    t_start: FloatArray
    t_found: FloatArray
    margin: FloatArray
    ambiguous: BoolArray
    t_one_key: FloatArray
    t_lm: FloatArray

    def error(self, t: FloatArray) -> FloatArray:
        """Return how far ends (N, 3) are from the truth in metres, shape (N,), NaN for none."""
        return np.asarray(np.linalg.norm(t - self.t_true, axis=1))


@dataclass(frozen=True)
class RingRow:
    """The counts of one ring over all distortions.

    Attributes
    ----------
    inner, outer
        Initial offsets in metres.
    one_key_small, one_key_medium, lm_small, lm_medium
        Calibrations that ended within a small or medium error.
    ambiguous
        Calibrations that one-key called ambiguous.
    unwarned
        Calibrations that one-key neither brought within a small error nor called ambiguous.
    """

    inner: float
    outer: float
    one_key_small: Share
    one_key_medium: Share
    lm_small: Share
    lm_medium: Share
    ambiguous: int
    unwarned: int


@dataclass(frozen=True)
class BasinTable:
    """The study's outcome, one row per ring from the truth outwards."""

    options: BasinOptions
    rows: tuple[RingRow, ...]


def cell(options: BasinOptions, distortion: int, ring: int) -> Cell:
    """Calibrate one sensor from all starts of one ring."""
    site = mapped_site(options.site)
    rng = np.random.default_rng([options.seed, distortion, 0, DRIVE])
    drive = random_drive(site, options.site, rng)
    readings, t_true = drive.readings, drive.sensor.t_lidar_mag
    t_start = random_starts(options, t_true, distortion, ring)
    found = [find_starts(readings, site.field_map, t, options.search)[0] for t in t_start]
    t_found = np.array([np.full(3, np.nan) if each is None else each.t_lidar_mag for each in found])
    return Cell(
        distortion=distortion,
        ring=ring,
        t_true=t_true,
        t_start=t_start,
        t_found=t_found,
        margin=np.array([np.inf if each is None else each.margin for each in found]),
        ambiguous=np.array([is_ambiguous(each, options.search) for each in found]),
        t_one_key=one_key(readings, site.field_map, t_found, options.solve),
        t_lm=plain_lm(readings, site.field_map, t_start, options),
    )


def is_ambiguous(found: FoundStart | None, options: StartOptions) -> bool:
    """Return whether a start was found that another place rivals."""
    return found is not None and found.ambiguous(options.clear)


def random_starts(
    options: BasinOptions, t_true: FloatArray, distortion: int, ring: int
) -> FloatArray:
    """Return starts in a ring about the truth, shape (N, 3): any direction, any offset alike."""
    rng = np.random.default_rng([options.seed, distortion, ring, STARTS])
    direction = rng.standard_normal((options.starts, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    offset = options.width * (ring + rng.uniform(size=(options.starts, 1)))
    return np.asarray(t_true + offset * direction)


def one_key(
    readings: Readings, field_map: QueryableMap, t_found: FloatArray, options: OneKeyOptions
) -> FloatArray:
    """Return where the one-key solve ends from each start that was found, shape (N, 3).

    As many sensors with the same readings are solved in one graph, as those of a vehicle are; the
    map is then asked once for all of them. None shares a variable with another.
    """
    ends = np.full_like(t_found, np.nan)
    rows = np.flatnonzero(np.isfinite(t_found).all(axis=1))
    if len(rows):
        solution = solve_one_key(repeated(readings, len(rows)), field_map, t_found[rows], options)
        solved = [each.sensor for each in solution.solved]
        ends[rows[solved]] = solution.estimate.t[solved]
    return ends


def repeated(readings: Readings, count: int) -> Readings:
    """Return the readings of one sensor as those of so many."""
    rows = np.tile(np.arange(len(readings)), count)
    return Readings(
        sensors=tuple(f"{readings.sensors[0]}_{index}" for index in range(count)),
        sensor=np.repeat(np.arange(count), len(readings)),
        stamp_ns=readings.stamp_ns[rows],
        R_map_lidar=readings.R_map_lidar[rows],
        p_map_lidar=readings.p_map_lidar[rows],
        field=readings.field[rows],
    )


def plain_lm(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, options: BasinOptions
) -> FloatArray:
    """Return where Levenberg-Marquardt ends from each start, shape (N, 3): each by itself."""
    noise = options.site.scenario.noise.field
    return np.array(
        [levenberg_marquardt(readings, field_map, t, noise, options.solve) for t in t_start]
    )


def basin_table(options: BasinOptions, cells: Sequence[Cell]) -> BasinTable:
    """Return the counts of all cells; rings without any are left out."""
    rings = sorted({each.ring for each in cells})
    rows = [ring_row(options, [each for each in cells if each.ring == ring]) for ring in rings]
    return BasinTable(options, tuple(rows))


def ring_row(options: BasinOptions, cells: Sequence[Cell]) -> RingRow:
    """Return the counts of the cells of one ring."""
    ours = np.concatenate([each.error(each.t_one_key) for each in cells])
    plain = np.concatenate([each.error(each.t_lm) for each in cells])
    ambiguous = np.concatenate([each.ambiguous for each in cells])
    return RingRow(
        inner=options.width * cells[0].ring,
        outer=options.width * (cells[0].ring + 1),
        one_key_small=within(ours, options.small),
        one_key_medium=within(ours, options.medium),
        lm_small=within(plain, options.small),
        lm_medium=within(plain, options.medium),
        ambiguous=int(np.count_nonzero(ambiguous)),
        unwarned=int(np.count_nonzero(~ambiguous & ~(ours <= options.small))),
    )


def within(error: FloatArray, most: float) -> Share:
    """Return how many errors, shape (N,), are at most so large; NaN is not."""
    return Share(int(np.count_nonzero(error <= most)), len(error))
