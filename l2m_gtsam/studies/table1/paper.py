"""Table I of L2M-Calib, as it is printed: the figures that ours stand beside."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Printed:
    """One entry of the table: of e_t and e_H squared norms, of e_C the Frobenius norm.

    Attributes
    ----------
    mean, std
        Over 2,500 calibrations; of e_t in m^2, of e_H in uT^2.
    """

    mean: float
    std: float


NOISES = (0.1, 0.2, 0.5)
"""Its columns in microtesla."""

# One line per path: three means, then three standard deviations.
_E_T = (
    (0.0018, 0.0037, 0.0058, 0.0009, 0.0014, 0.0030),
    (0.0031, 0.0029, 0.0076, 0.0007, 0.0016, 0.0053),
    (0.0039, 0.0021, 0.0034, 0.0005, 0.0012, 0.0018),
    (0.0025, 0.0017, 0.0048, 0.0012, 0.0014, 0.0039),
    (0.0049, 0.0045, 0.0062, 0.0008, 0.0010, 0.0020),
)
_E_C = (
    (0.0018, 0.0055, 0.0289, 0.0010, 0.0089, 0.0885),
    (0.0029, 0.0080, 0.0427, 0.0069, 0.0235, 0.1331),
    (0.0016, 0.0047, 0.0276, 0.0023, 0.0136, 0.0886),
    (0.0028, 0.0070, 0.0378, 0.0066, 0.0215, 0.1154),
    (0.0028, 0.0070, 0.0368, 0.0047, 0.0205, 0.1218),
)
_E_H = (
    (0.0751, 0.1400, 0.2623, 0.0156, 0.0468, 0.5669),
    (0.0508, 0.0979, 0.5559, 0.0485, 0.1658, 0.9575),
    (0.0300, 0.0622, 0.2541, 0.0164, 0.0812, 0.5643),
    (0.0398, 0.0748, 0.4048, 0.0378, 0.1296, 0.7131),
    (0.0673, 0.0923, 0.3307, 0.0163, 0.1111, 0.7460),
)
PATHS = len(_E_T)


def printed(metric: str, path: int, noise: float) -> Printed | None:
    """Return an entry of the table; None where it has none.

    Parameters
    ----------
    metric
        ``t``, ``C`` or ``H``.
    path
        Counted from 0.
    noise
        In microtesla.
    """
    lines = {"t": _E_T, "C": _E_C, "H": _E_H}[metric]
    if noise not in NOISES or path >= PATHS:
        return None
    column = NOISES.index(noise)
    return Printed(lines[path][column], lines[path][column + len(NOISES)])
