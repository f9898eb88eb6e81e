"""Covariances of variables that share a factor, of all of a graph at once: the selected inverse.

Elimination leaves for its variables F, given those S that it connects them to, ``R x_F + U x_S``,
white. So from the root to the leaves, with what is known of S by then (K. Takahashi, J. Fagan,
M.-S. Chen, 1973; M. Kaess, F. Dellaert, 2009, section 4):

    P_FS = -R^-1 U P_SS,    P_FF = R^-1 R^-T + R^-1 U P_SS U^T R^-T

S lies in the clique of its parent, whose covariance is known whole. Each clique costs
``|F| (|F| + |S|)^2``, about what its elimination did. GTSAM's ``marginalCovariance`` eliminates S
once more for each variable, ``|S|^3``.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from l2m_gtsam.data import FloatArray, IntArray

ROOT = -1


@dataclass(frozen=True)
class Clique:
    """Variables that are eliminated one after the other and together connected to others.

    Variables are named by their places in the order of elimination.

    Attributes
    ----------
    frontal
        The variables, ascending.
    separator
        Those that they are connected to, all later.
    parent
        Number of the clique that has all of these, earlier in the list; ``ROOT`` without any.
    """

    frontal: tuple[int, ...]
    separator: tuple[int, ...]
    parent: int

    @property
    def variables(self) -> tuple[int, ...]:
        """All of them."""
        return self.frontal + self.separator


@dataclass(frozen=True)
class Eliminated:
    """What elimination leaves for one variable.

    Attributes
    ----------
    root
        R, upper triangle, shape (d, d).
    connected
        U, its columns by the variables of ``separator``, shape (d, s).
    separator
        In the order of the columns.
    """

    root: FloatArray
    connected: FloatArray
    separator: tuple[int, ...]


def shared_covariances(
    net: gtsam.GaussianBayesNet, wanted: Sequence[Sequence[int]]
) -> list[FloatArray]:
    """Return joint covariances of variables that share a factor.

    Parameters
    ----------
    net
        Of each variable by itself, in the order of elimination.
    wanted
        Keys, in the order that their covariance is to have.

    Returns
    -------
    list of arrays
        In the order of ``wanted``.

    Raises
    ------
    numpy.linalg.LinAlgError
        No factor determines a variable.
    """
    place = {net.at(row).firstFrontalKey(): row for row in range(net.size())}
    eliminated = [eliminated_of(net.at(row), place) for row in range(net.size())]
    size = np.array([len(each.root) for each in eliminated])
    cliques = cliques_of([each.separator for each in eliminated])
    home = {row: number for number, clique in enumerate(cliques) for row in clique.frontal}
    asked = defaultdict[int, list[int]](list)
    for which, keys in enumerate(wanted):
        asked[home[min(place[key] for key in keys)]].append(which)
    children = np.bincount([each.parent + 1 for each in cliques], minlength=len(cliques) + 1)[1:]

    found: list[FloatArray] = [np.empty((0, 0))] * len(wanted)
    known: dict[int, FloatArray] = {}  # of cliques that have children left
    for number, clique in enumerate(cliques):
        P_SS = np.empty((0, 0))
        if clique.parent != ROOT:
            at = columns(cliques[clique.parent].variables, clique.separator, size)
            P_SS = known[clique.parent][np.ix_(at, at)]
            children[clique.parent] -= 1
            if not children[clique.parent]:
                del known[clique.parent]
        P = clique_covariance(clique, eliminated, size, P_SS)
        if children[number]:
            known[number] = P
        for which in asked[number]:
            own = columns(clique.variables, [place[key] for key in wanted[which]], size)
            found[which] = P[np.ix_(own, own)]
    return found


def eliminated_of(conditional: gtsam.GaussianConditional, place: dict[int, int]) -> Eliminated:
    """Return GTSAM's conditional of one variable, white; ``place``: of a key in the order."""
    _, *others = conditional.keys()
    white = conditional.jacobian()[0]
    own = len(white)
    return Eliminated(white[:, :own], white[:, own:], tuple(place[key] for key in others))


def cliques_of(separators: Sequence[Sequence[int]]) -> list[Clique]:
    """Return the cliques of an elimination, parents first.

    Parameters
    ----------
    separators
        Of each variable those, all later, that it is connected to when it is eliminated.
    """
    frontal: list[list[int]] = []
    home: dict[int, int] = {}
    for row in reversed(range(len(separators))):
        own = separators[row]
        number = home[min(own)] if own else ROOT
        # With the variables of a clique that begins at its parent, and no others, it belongs to it.
        extends = own and frontal[number][-1] == min(own)
        if extends and len(own) == len(separators[min(own)]) + 1:
            frontal[number].append(row)
            home[row] = number
        else:
            home[row] = len(frontal)
            frontal.append([row])
    cliques = []
    for rows in frontal:  # from the last to the first
        own = tuple(separators[rows[0]])
        cliques.append(Clique(tuple(rows[::-1]), own, home[min(own)] if own else ROOT))
    return cliques


def clique_covariance(
    clique: Clique, eliminated: Sequence[Eliminated], size: IntArray, P_SS: FloatArray
) -> FloatArray:
    """Return the joint covariance of a clique's variables, given that of its separator."""
    inner = int(size[list(clique.frontal)].sum())
    white = np.zeros((inner, inner + len(P_SS)))
    first = 0
    for row in clique.frontal:
        own = eliminated[row]
        rows = slice(first, first + len(own.root))
        white[rows, rows] = own.root
        white[rows, columns(clique.variables, own.separator, size)] = own.connected
        first = rows.stop
    half = inverse_of(white[:, :inner])
    gain = half @ white[:, inner:]
    P = np.empty((inner + len(P_SS),) * 2)
    P[:inner, inner:] = -gain @ P_SS
    P[inner:, :inner] = P[:inner, inner:].T
    P[inner:, inner:] = P_SS
    # Both terms are squares: nothing cancels.
    P[:inner, :inner] = half @ half.T - P[:inner, inner:] @ gain.T
    return P


def inverse_of(root: FloatArray) -> FloatArray:
    """Return the inverse of an upper triangle.

    Raises
    ------
    LinAlgError
        It is singular.
    """
    half, singular = dtrtri(root)
    if singular:
        raise np.linalg.LinAlgError("no factor determines a variable")
    return np.asarray(half)


def columns(variables: Sequence[int], chosen: Sequence[int], size: IntArray) -> IntArray:
    """Return where chosen variables are among the columns of variables with so many each."""
    starts = np.cumsum([0, *size[list(variables)]])
    start = dict(zip(variables, starts.tolist(), strict=False))
    parts = [np.arange(start[each], start[each] + size[each]) for each in chosen]
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)
