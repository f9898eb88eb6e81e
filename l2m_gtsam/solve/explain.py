"""What a drive leaves open, in words: which parameters, and the figure of the drive that shows why.

Every sentence is about directions that the rank test found, and every figure is measured on the
poses and the map that it was made of.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.solve.rank import Determinacy, RankOptions, members

AXES = ("x", "y", "z")
COLUMNS = ("first", "second", "third")
ALONG = 0.95  # cosine from which a direction is called after the lidar's axis
# A vehicle within these did not drive: what its poses still show is their own noise.
REST_M, REST_DEG = 0.1, 3.0
A_MOMENT_S = 0.01  # a usual time offset
RESOLVED_MM, RESOLVED_DEG = 0.05, 0.005  # what is not spelt out
# Below any sensor's resolution, in uT: what is less is not spelt out.
RESOLVED_UT = 1e-3


@dataclass(frozen=True)
class Movement:
    """How a vehicle moved.

    Attributes
    ----------
    extent
        Diagonal of the box around the lidar's positions in metres.
    turn
        Largest rotation away from the first pose in degrees.
    heights
        Range of the lidar's height in metres.
    tilt
        Largest angle between the lidar's z axis and its mean in degrees.
    """

    extent: float
    turn: float
    heights: float
    tilt: float

    @property
    def at_rest(self) -> bool:
        """Whether the vehicle did not drive."""
        return self.extent < REST_M and self.turn < REST_DEG

    @property
    def rest(self) -> str:
        """Sentence on a vehicle that did not move."""
        return f"the vehicle did not move ({self.extent:.2f} m, {self.turn:.1f} deg)"

    @property
    def upright(self) -> str:
        """Sentence on the small changes of height and tilt."""
        return (
            f"the vehicle changes height by {self.heights:.2f} m and tilts by {self.tilt:.1f} deg "
            "at most"
        )


@dataclass(frozen=True)
class DriveFacts:
    """What a sensor met along a drive.

    Attributes
    ----------
    movement
        Extent of the vehicle's motion in metres and degrees.
    b_lidar
        Field in the lidar frame in uT, shape (N, 3).
    slope
        ``R^T G R``: how the field in the lidar frame changes with t in uT/m, shape (N, 3, 3).
    seen
        What of it no choice of C and H imitates, shape (N, 3, 3).
    """

    movement: Movement
    b_lidar: FloatArray
    slope: FloatArray
    seen: FloatArray


def movement(R_map_lidar: FloatArray, p_map_lidar: FloatArray) -> Movement:
    """Measure how the lidar's poses, shapes (N, 3, 3) and (N, 3) in metres, move."""
    turned = Rotation.from_matrix(R_map_lidar[0].T @ R_map_lidar).magnitude()
    up = R_map_lidar[:, :, 2]
    upright = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
    return Movement(
        extent=float(np.linalg.norm(np.ptp(p_map_lidar, axis=0))),
        turn=float(np.degrees(turned.max())),
        heights=float(np.ptp(p_map_lidar[:, 2])),
        tilt=float(np.degrees(np.arccos(np.clip(up @ upright, -1, 1)).max())),
    )


def drive_facts(
    R_map_lidar: FloatArray, p_map_lidar: FloatArray, field: FloatArray, gradient: FloatArray
) -> DriveFacts:
    """Measure a drive.

    Parameters
    ----------
    R_map_lidar, p_map_lidar
        Poses of the lidar, shapes (N, 3, 3) and (N, 3), metres.
    field, gradient
        The map's at the sensor in the map frame, shapes (N, 3) in uT and (N, 3, 3) in uT/m.
    """
    R_lidar_map = R_map_lidar.transpose(0, 2, 1)
    b_lidar = np.einsum("nij,nj->ni", R_lidar_map, field)
    slope = R_lidar_map @ gradient @ R_map_lidar
    moved = movement(R_map_lidar, p_map_lidar)
    return DriveFacts(moved, b_lidar, slope, _not_imitated(slope, b_lidar))


def held_offset(test: Determinacy) -> str:
    """Return why a time offset is held at zero; empty if it is observable."""
    if test.offset:
        return ""
    C = A_MOMENT_S * test.imitation[3:].reshape(3, 3)
    shift = 1e3 * A_MOMENT_S * test.imitation[:3]
    turn = np.degrees(np.linalg.norm(C - C.T) / np.sqrt(8))
    if np.linalg.norm(shift) < RESOLVED_MM and turn < RESOLVED_DEG:
        return "held at 0: nothing in this drive shows it"
    # Added zero turns -0.0 into 0.0.
    place = ", ".join(f"{value + 0.0:.1f}" for value in np.round(shift, 1).tolist())
    return (
        f"held at 0: {1e3 * A_MOMENT_S:g} ms look like t moved by ({place}) mm and the sensor "
        f"turned by {turn:.2f} deg; drive at another speed or the other way round, too"
    )


def explain(test: Determinacy, drive: DriveFacts, options: RankOptions) -> tuple[str, ...]:
    """Return what a drive does not determine, a sentence for each reason; none if it is nothing.

    Parameters
    ----------
    test
        Undetermined directions of the 15 parameters, K of them.
    drive
        Field, slope and motion along the drive, N readings.
    options
        Largest useful sigmas of t (m), C and H (uT).
    """
    if test.touched.all() and drive.movement.at_rest:
        return (f"everything ({'; '.join(test.names)}): {drive.movement.rest}",)
    kinds = np.array([_kind(row) for row in test.directions])
    reasons = {"position": _position, "distortion": _distortion, "both": _both}
    sentences = []
    for kind, reason in reasons.items():
        rows = np.flatnonzero(kinds == kind)
        if len(rows):
            what, why = reason(test.directions[rows], drive, options)
            sentences.append(f"{what} ({'; '.join(test.names[row] for row in rows)}): {why}")
    return tuple(sentences)


def _kind(row: FloatArray) -> str:
    found = members(row)
    if found[-1] < 3:
        return "position"
    return "distortion" if found[0] >= 3 else "both"


def _position(rows: FloatArray, drive: DriveFacts, _: RankOptions) -> tuple[str, str]:
    """Say what of t is open, and how little moving the sensor would show."""
    basis = _span(rows[:, :3])
    if len(basis) == 3:
        return "position unobservable", _change(basis, drive, "gradient")
    if len(basis) == 1 and abs(basis[0, 2]) > ALONG:
        why = _change(basis, drive, "vertical gradient")
        return "height", f"{drive.movement.upright}, {why}"
    return "position in part", _change(basis, drive, "gradient")


def _change(basis: FloatArray, drive: DriveFacts, whose: str) -> str:
    """Say how the field changes along directions of t, and what of it C and H imitate."""
    slope = drive.slope @ basis.T
    shown, left = _rms(slope), _rms(drive.seen @ basis.T)
    if left >= 0.5 * shown or shown < RESOLVED_UT:
        most = float(np.linalg.norm(slope, ord=2, axis=(1, 2)).max())
        return f"the map's {whose} there is at most {_figure(most)} uT/m"
    return (
        f"a metre changes the readings by {_figure(shown)} uT (rms), and all but {_figure(left)} "
        "uT of it another C and H would do as well"
    )


def _distortion(rows: FloatArray, drive: DriveFacts, _: RankOptions) -> tuple[str, str]:
    """Say which columns of C are open against H, and how little the field varies along them."""
    basis = _span(rows[:, 3:12].reshape(-1, 3))
    along = (drive.b_lidar - drive.b_lidar.mean(axis=0)) @ basis.T
    varies = f"varies by no more than {_figure(_rms(along[:, None, :]))} uT (rms)"
    if len(basis) == 3:
        return "C against H", f"the field in the lidar frame {varies}"
    axes = [axis for axis in range(3) if np.linalg.norm(basis[:, axis]) > ALONG]
    what, where = "C against H", " and ".join(_vector(direction) for direction in basis)
    if len(basis) == 1 and axes:
        what = f"{COLUMNS[axes[0]]} column of C against H"
        where = f"the lidar's {AXES[axes[0]]} axis"
    return what, f"the field along {where} {varies}; {drive.movement.upright}"


def _both(rows: FloatArray, drive: DriveFacts, options: RankOptions) -> tuple[str, str]:
    """Describe a trade between t and the distortion: what a step of both would show."""
    steps = rows / np.linalg.norm(rows, axis=1)[:, None] * options.scale()
    t, C, H = steps[:, :3], steps[:, 3:12].reshape(-1, 3, 3), steps[:, 12:]
    change = drive.slope @ t.T + (C @ drive.b_lidar.T).transpose(2, 1, 0) + H.T
    shown = np.sqrt(np.mean(np.sum(change**2, axis=1), axis=0)).max()
    together = (
        f"changed together, t by {np.linalg.norm(t, axis=1).max():.2g} m, they alter the readings "
        f"by {_figure(float(shown))} uT (rms)"
    )
    if not any(3 <= member < 12 for row in rows for member in members(row)):
        return "position against H", together
    what, why = _distortion(rows, drive, options)
    return f"position and {what}", f"{together}; {why}"


def _not_imitated(slope: FloatArray, b_lidar: FloatArray) -> FloatArray:
    """Return what a regression on (1, b) leaves of the slopes, shape (N, 3, 3)."""
    # C and H can imitate whatever is linear in the field and constant: only what is orthogonal to
    # it shows the place.
    Q, _ = np.linalg.qr(np.column_stack([np.ones(len(b_lidar)), b_lidar]))
    flat = slope.reshape(len(slope), -1)
    return np.asarray((flat - Q @ (Q.T @ flat)).reshape(slope.shape))


def _span(rows: FloatArray) -> FloatArray:
    """Return orthonormal directions that rows of three numbers point in, shape (k, 3)."""
    _, s, Vt = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(Vt[s > 0.2 * s[0]])


def _rms(change: FloatArray) -> float:
    """Return the root mean square over readings of ``change @ u``, (N, i, k), in the worst u."""
    moment = np.einsum("nik,nil->kl", change, change) / len(change)
    return float(np.sqrt(max(np.linalg.eigvalsh(moment)[-1], 0.0)))


def _figure(value: float) -> str:
    """Return two digits of a bound."""
    return f"{max(value, RESOLVED_UT):.2g}"


def _vector(direction: FloatArray) -> str:
    towards = direction * np.sign(direction[np.argmax(np.abs(direction))])
    # Added zero turns -0.00 into 0.00.
    return "(" + ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in towards.tolist()) + ")"
