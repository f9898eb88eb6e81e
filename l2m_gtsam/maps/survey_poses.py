r"""What errors of a survey's poses do to the readings of a map.

A pose that is wrong by a rotation w and a translation v moves a reading by ``dx`` and turns what it
read, ``dy``; the map is given what is wrong by ``dy - G dx``, G the field's gradient there. Such
errors last: an Ornstein-Uhlenbeck process along each drive, by its values at knots. Counted as
noise of each reading they would average out along a pass, and the map would take what the pass has
in common for field.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky

from l2m_gtsam.data import BoolArray, FloatArray, IntArray

POSE = 6  # rotation about and translation along the axes of the map
KNOTS = 2  # for as long as an error lasts
MOST_KNOTS = 160  # of one tile: then they lie further apart
ROUNDING = 1e-10


@dataclass(frozen=True)
class SurveyPoses:
    """How N readings hang on the errors of the poses that they were taken at.

    A reading of a map may be an average over several: P pairs of a reading and a pose.

    Attributes
    ----------
    reading, drive
        Of each pair, shapes (P,). Errors of two drives have nothing in common.
    seconds
        When, since its drive began, shape (P,).
    shift
        What a unit of each of six errors does to position and field of the reading, both in the
        map frame, m and uT, shape (P, 6, 6).
    lasting_s
        Time over which the correlation of two errors falls to 1/e.
    stated
        Whether a unit is a standard deviation that was stated; else it is a radian or a metre.
    sizes
        Standard deviations that the survey showed, in rad and m, shape (6,); absent before.
    duration_stated
        Whether how long they last was stated, too. Else they may be noise of each reading.
    """

    reading: IntArray
    drive: IntArray
    seconds: FloatArray
    shift: FloatArray
    lasting_s: float
    stated: bool
    sizes: FloatArray | None = None
    duration_stated: bool = True

    def sized(self, sizes: FloatArray, lasting_s: float) -> "SurveyPoses":
        """Return errors of these standard deviations in rad and m, shape (6,)."""
        return replace(self, sizes=sizes, lasting_s=lasting_s)

    def like(self, other: "SurveyPoses | None") -> "SurveyPoses | None":
        """Return errors as large as those of another survey, where nothing is stated of these."""
        if self.stated:
            return self if self.duration_stated or other is not None else None
        if other is None or other.sizes is None:
            return None
        return self.sized(other.sizes, other.lasting_s)

    def averaged(self, owner: IntArray, weight: FloatArray) -> "SurveyPoses":
        """Return the errors of averages over readings.

        Parameters
        ----------
        owner
            Average that each reading goes into, shape (N,).
        weight
            Of each reading, shape (N,).
        """
        share = (weight / np.bincount(owner, weight)[owner])[self.reading]
        shift = rounded(self.shift * share[:, None, None])
        return replace(self, reading=owner[self.reading], shift=shift)

    def only(self, keep: BoolArray) -> "SurveyPoses":
        """Return the errors of some of N readings, (N,)."""
        number, own = np.cumsum(keep) - 1, keep[self.reading]
        return replace(
            self,
            reading=number[self.reading[own]],
            drive=self.drive[own],
            seconds=self.seconds[own],
            shift=self.shift[own],
        )

    def followed_by(self, other: "SurveyPoses", first: int) -> "SurveyPoses":
        """Return the errors of these readings and of others that are numbered from ``first`` on."""
        drives = int(self.drive.max(initial=-1)) + 1
        one, two = self.in_units(), other.in_units()
        same = self.stated == other.stated
        return SurveyPoses(
            np.concatenate([one.reading, two.reading + first]),
            np.concatenate([one.drive, two.drive + drives]),
            np.concatenate([one.seconds, two.seconds]),
            np.concatenate([one.shift, two.shift]),
            max(one.lasting_s, two.lasting_s),
            self.stated if same else True,
            self.sizes if same else None,
        )

    def in_units(self) -> "SurveyPoses":
        """Return the same where a unit is a standard deviation, if these were found."""
        if self.sizes is None:
            return self
        return replace(self, shift=rounded(self.shift * self.sizes))

    def knots(self, rows: IntArray, gradient: FloatArray) -> "KnotEffects":
        """Return what the errors at knots do to some readings.

        Parameters
        ----------
        rows
            Which readings, sorted, shape (n,).
        gradient
            G there in uT/m, shape (n, 3, 3).
        """
        at = np.searchsorted(rows, self.reading)
        mine = np.flatnonzero(rows[np.minimum(at, len(rows) - 1)] == self.reading)
        at, shift = at[mine], self.shift[mine]
        size = np.ones(POSE) if self.sizes is None else self.sizes
        parts = np.flatnonzero(size)
        change = (shift[:, 3:] - gradient[at] @ shift[:, :3])[:, :, parts] * size[parts]
        spacing = self.lasting_s / KNOTS
        knots = ErrorKnots.at(self.drive[mine], self.seconds[mine], spacing, self.lasting_s)
        while len(knots.drive) > MOST_KNOTS:
            spacing *= 2
            knots = ErrorKnots.at(self.drive[mine], self.seconds[mine], spacing, self.lasting_s)
        effect = np.zeros((len(rows), len(knots.drive), 3, len(parts)))
        for side in range(2):
            weighted = change * knots.weight[:, side, None, None]
            np.add.at(effect, (at, knots.index[:, side]), weighted)
        return KnotEffects(knots, parts, effect.transpose(0, 2, 1, 3))


def rounded(shift: FloatArray) -> FloatArray:
    """Return effects as files have them, in single precision: a map that is read is the same."""
    return np.asarray(shift.astype(np.float32).astype(np.float64))


@dataclass(frozen=True)
class ErrorKnots:
    """Q times at which errors are numbers of their own, and what P pairs take of them.

    Attributes
    ----------
    drive, seconds
        Of each knot, shapes (Q,).
    lasting_s
        Time over which the correlation falls to 1/e.
    index, weight
        The knots before and after each pair, and their shares, shapes (P, 2).
    """

    drive: IntArray
    seconds: FloatArray
    lasting_s: float
    index: IntArray
    weight: FloatArray

    @classmethod
    def at(
        cls, drive: IntArray, seconds: FloatArray, spacing: float, lasting_s: float
    ) -> "ErrorKnots":
        """Return the knots around pairs; errors have unit variance also between two."""
        before = np.floor(seconds / spacing)
        part = seconds / spacing - before
        number = np.stack([before, before + 1], axis=1).astype(np.int64)
        both = np.stack([np.repeat(drive, 2), number.ravel()], axis=1)
        some, index = np.unique(both, axis=0, return_inverse=True)
        like = np.exp(-spacing / lasting_s)
        variance = (1 - part) ** 2 + part**2 + 2 * part * (1 - part) * like
        weight = np.stack([1 - part, part], axis=1) / np.sqrt(variance)[:, None]
        when = spacing * some[:, 1].astype(np.float64)
        return cls(some[:, 0], when, lasting_s, index.reshape(-1, 2), weight)

    def correlation(self, other: "ErrorKnots") -> FloatArray:
        """Return the correlation with errors at other knots, shape (Q, Q')."""
        apart = np.abs(self.seconds[:, None] - other.seconds) / self.lasting_s
        same = self.drive[:, None] == other.drive
        return np.asarray(np.where(same, np.exp(-apart), 0.0))


@dataclass(frozen=True)
class KnotEffects:
    """What errors at Q knots do to n readings.

    Attributes
    ----------
    knots
        When.
    parts
        Which of the six errors, shape (c,).
    effect
        Of a unit of each in uT, map frame, shape (n, 3, Q, c).
    """

    knots: ErrorKnots
    parts: IntArray
    effect: FloatArray

    @property
    def white(self) -> FloatArray:
        """The same for independent numbers of unit variance, uT, shape (n, 3, Q c)."""
        correlation = self.knots.correlation(self.knots)
        correlation[np.diag_indices_from(correlation)] += ROUNDING
        root = cholesky(correlation, lower=True, check_finite=False)
        white = np.einsum("niqc,qk->nikc", self.effect, root, optimize=True)
        return np.asarray(white.reshape(len(white), 3, -1))

    @property
    def part(self) -> IntArray:
        """Which of the six errors each column of ``white`` is of, shape (Q c,)."""
        return np.tile(self.parts, len(self.knots.drive))
