"""How far off a guess may be: calibrations from starts around the truth, ring by ring.

The protocol is the paper's (Success rate): random distortions, each with random starts; a
calibration succeeds if the sensor's position ends within 2 cm (small) or 5 cm (medium) of the
truth. All methods get the same readings, map and starts. *One-key* searches for a start in a ball
around the given one and solves from there: the given start is its only information. *Published* is
the paper's algorithm, *LM* Levenberg-Marquardt over t, C and H, from the given start itself.

The starts of one distortion share a drive, and the lattice of one-key's search: what differs
between them is which of its nodes lie in the ball. Starts whose balls hold the same best nodes
find the same place and end in the same result, which is then computed once. Starts are therefore
no independent trials of one-key; distortions, each with a drive and noise of its own, are, given
the site and its map, which all of them share.

All cells of one distortion are a function of the options and the site alone: distortions may be
computed in any order and anywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.json_arrays import JsonBools, JsonFloats
from l2m_gtsam.studies.methods import as_published, levenberg_marquardt, one_key
from l2m_gtsam.studies.site import Site, SiteDrive, SiteOptions, random_drive
from l2m_gtsam.studies.statistics import Share

DRIVE, STARTS = 1, 2  # streams of randomness


class BasinOptions(Options):
    """Size and conditions of the study; lengths in metres."""

    seed: int = Field(default=1, ge=0)
    """Of drives, sensors and starts; the site has its own."""
    distortions: int = Field(default=20, ge=1)
    """Sensors of random place and distortion, each on its own drive."""
    starts: int = Field(default=100, ge=1)
    """Of each sensor in each ring."""
    few_starts: int = Field(default=20, ge=1)
    """The published method and LM run from so many of them, the first: their rates need fewer
    trials, and far out they take seconds per start."""
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
    """One-key's search for its start, around the given one."""
    solve: OneKeyOptions = OneKeyOptions(uncertainty=Uncertainty.INDEPENDENT)
    """How one-key solves. The study is of places, not of sigmas, which are ten times as much
    work with the map's full uncertainty."""


@dataclass(frozen=True)
class RingCell:
    """What came of one distortion and one ring; positions in the lidar frame in metres.

    Attributes
    ----------
    t_true
        Shape (3,).
    t_start
        Given starts, shape (N, 3).
    t_found
        Where one-key started from, NaN where it found no start, shape (N, 3).
    ambiguous
        Which calibrations one-key would call ambiguous, shape (N,).
    t_one_key
        Where one-key ended, NaN where it ended without a result, shape (N, 3).
    t_published, t_lm
        Where the published method and Levenberg-Marquardt ended from the first L of the starts,
        NaN where off the map, shape (L, 3).
    """

    distortion: int
    ring: int
    t_true: JsonFloats
    t_start: JsonFloats
    t_found: JsonFloats
    ambiguous: JsonBools
    t_one_key: JsonFloats
    t_published: JsonFloats
    t_lm: JsonFloats

    def error(self, t: FloatArray) -> FloatArray:
        """Return how far ends (N, 3) are from the truth in metres, shape (N,), NaN for none."""
        return np.asarray(np.linalg.norm(t - self.t_true, axis=1))


@dataclass(frozen=True)
class DistortionCells:
    """All rings of one distortion, from the truth outwards."""

    rings: tuple[RingCell, ...]


@dataclass(frozen=True)
class Rates:
    """Calibrations of one method that ended within a small and within a medium error."""

    small: Share
    medium: Share


@dataclass(frozen=True)
class RingRow:
    """The counts of one ring over all distortions.

    Attributes
    ----------
    inner, outer
        Initial offsets in metres.
    one_key, published, lm
        How often each method succeeded.
    ambiguous
        Calibrations that one-key called ambiguous.
    unwarned
        Calibrations that one-key neither brought within a small error nor called ambiguous.
    """

    inner: float
    outer: float
    one_key: Rates
    published: Rates
    lm: Rates
    ambiguous: int
    unwarned: int


@dataclass(frozen=True)
class BasinTable:
    """The study's outcome.

    Attributes
    ----------
    rows
        One per ring from the truth outwards.
    all_small, all_medium
        Distortions of which one-key brought every start within a small or medium error.
    """

    options: BasinOptions
    rows: tuple[RingRow, ...]
    all_small: Share
    all_medium: Share


def cells_of(options: BasinOptions, site: Site, distortion: int) -> DistortionCells:
    """Calibrate one sensor from all starts of all rings."""
    rings = range(options.rings)
    rng = np.random.default_rng([options.seed, distortion, 0, DRIVE])
    drive = random_drive(site, options.site, rng)
    t_true = drive.sensor.t_lidar_mag
    t_start = np.concatenate([random_starts(options, t_true, distortion, ring) for ring in rings])
    found = one_key(drive.readings, site.field_map, t_start, options.search, options.solve)
    cells = []
    for index, ring in enumerate(rings):
        rows = slice(index * options.starts, (index + 1) * options.starts)
        few = t_start[rows][: options.few_starts]
        cell = RingCell(
            distortion=distortion,
            ring=ring,
            t_true=t_true,
            t_start=t_start[rows],
            t_found=found.t_found[rows],
            ambiguous=found.ambiguous[rows],
            t_one_key=found.vector[rows, :3],
            t_published=np.array(
                [as_published(drive.readings, site.field_map, t)[:3] for t in few]
            ),
            t_lm=plain_lm(site, drive, few, options),
        )
        cells.append(cell)
    return DistortionCells(tuple(cells))


def random_starts(
    options: BasinOptions, t_true: FloatArray, distortion: int, ring: int
) -> FloatArray:
    """Return starts in a ring about the truth, shape (N, 3): any direction, any offset alike."""
    rng = np.random.default_rng([options.seed, distortion, ring, STARTS])
    direction = rng.standard_normal((options.starts, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    offset = options.width * (ring + rng.uniform(size=(options.starts, 1)))
    return np.asarray(t_true + offset * direction)


def plain_lm(
    site: Site, drive: SiteDrive, t_start: FloatArray, options: BasinOptions
) -> FloatArray:
    """Return where Levenberg-Marquardt ends from each start, shape (N, 3): each by itself."""
    noise = options.site.scenario.noise.field
    ends = [
        levenberg_marquardt(drive.readings, site.field_map, t, noise, options.solve)
        for t in t_start
    ]
    return np.array(ends)


def basin_table(options: BasinOptions, cells: Sequence[RingCell]) -> BasinTable:
    """Return the counts of all cells; rings without any are left out."""
    rings = sorted({each.ring for each in cells})
    rows = [ring_row(options, [each for each in cells if each.ring == ring]) for ring in rings]
    worst: dict[int, float] = {}
    for each in cells:
        # NaN, no result, is as bad as can be.
        error = float(np.nan_to_num(each.error(each.t_one_key), nan=np.inf).max())
        worst[each.distortion] = max(error, worst.get(each.distortion, 0.0))
    errors = np.array(list(worst.values()))
    return BasinTable(
        options, tuple(rows), within(errors, options.small), within(errors, options.medium)
    )


def ring_row(options: BasinOptions, cells: Sequence[RingCell]) -> RingRow:
    """Return the counts of the cells of one ring."""
    ours = np.concatenate([each.error(each.t_one_key) for each in cells])
    theirs = np.concatenate([each.error(each.t_published) for each in cells])
    plain = np.concatenate([each.error(each.t_lm) for each in cells])
    ambiguous = np.concatenate([each.ambiguous for each in cells])
    return RingRow(
        inner=options.width * cells[0].ring,
        outer=options.width * (cells[0].ring + 1),
        one_key=rates(options, ours),
        published=rates(options, theirs),
        lm=rates(options, plain),
        ambiguous=int(np.count_nonzero(ambiguous)),
        unwarned=int(np.count_nonzero(~ambiguous & ~(ours <= options.small))),
    )


def rates(options: BasinOptions, errors: FloatArray) -> Rates:
    """Return how often errors in metres, shape (N,), NaN for no result, are small and medium."""
    return Rates(within(errors, options.small), within(errors, options.medium))


def within(error: FloatArray, most: float) -> Share:
    """Return how many errors, shape (N,), are at most so large; NaN is not."""
    return Share(int(np.count_nonzero(error <= most)), len(error))
