"""Where the ablation study comes out as the paper says, and where not: sentences from numbers."""

from collections.abc import Sequence

from l2m_gtsam.studies.ablation.cells import Solver
from l2m_gtsam.studies.ablation.table import AblationTable, Comparison, Gain
from l2m_gtsam.studies.ablation.words import kind_label, spacing_label

CLAIMED_UT = 0.2
"""By so much, the paper says, the sliding GP lowers the mean error of H where fingerprints are
dense."""


def verdicts(table: AblationTable) -> list[str]:
    """Return paragraphs on the paper's two claims, and on our method."""
    return [*map_verdicts(table), weight_verdict(table), method_verdict(table)]


def map_verdicts(table: AblationTable) -> list[str]:
    """Return a paragraph for each kind of map but the first."""
    return [
        map_verdict(table.options.kinds[0], kind, [g for g in table.map_gains if g.to == kind])
        for kind in table.options.kinds[1:]
    ]


def map_verdict(base: str, kind: str, comparisons: Sequence[Comparison]) -> str:
    """Return what a kind of map gains over the first one at each density, densest first."""
    gains = [(each.spacing, each.H) for each in comparisons if each.H is not None]
    lowered = ", ".join(f"{amount(g)} ({spacing_label(s)})" for s, g in gains)
    text = (
        f"*{kind_label(kind)} against {kind_label(base)}*, with the paper's method: the mean error "
        f"of H shrinks by {lowered}."
    )
    if kind != "sliding_gp" or not gains:
        return text
    dense, sparse = gains[0][1], gains[-1][1]
    grown = sparse.mean - dense.mean > max(dense.margin, sparse.margin)
    more = "clearly larger" if grown else "not clearly larger"
    held = "is" if dense.mean > CLAIMED_UT else "is not"
    return (
        f"{text} The paper says over {CLAIMED_UT:g} uT where fingerprints are dense and much more "
        f"where they are sparse. Here the gain {held} over {CLAIMED_UT:g} uT at the densest, and "
        f"{more} at the sparsest."
    )


def amount(gain: Gain) -> str:
    """Return a gain in microtesla with its interval."""
    return f"{gain.mean:.3f} ± {gain.margin:.3f} uT"


def weight_verdict(table: AblationTable) -> str:
    """Return on how many maps each kind of weights helps, for t and for H."""
    sentences = [
        weights_sentence(solver, [g for g in table.weight_gains if g.to == solver.value])
        for solver in (Solver.PAPER, Solver.LIKELIHOOD)
    ]
    return (
        "*Weights.* The paper says that they improve the result at all densities. "
        f"{' '.join(sentences)} Where a map has one variance for all places, as the bilinear one, "
        "weights change nothing."
    )


def weights_sentence(solver: Solver, comparisons: Sequence[Comparison]) -> str:
    """Return what one kind of weights does on all maps."""
    t = [each.t for each in comparisons if each.t is not None]
    H = [each.H for each in comparisons if each.H is not None]
    return (
        f"Against RRTLS, {solver.value} has a smaller mean error of t on {tally(t)}, and of H on "
        f"{tally(H)}."
    )


def tally(gains: Sequence[Gain]) -> str:
    """Return on how many maps a mean shrinks, grows, or cannot be told from unchanged."""
    shrunk = sum(gain.sure and gain.mean > 0 for gain in gains)
    grown = sum(gain.sure and gain.mean < 0 for gain in gains)
    open_ = len(gains) - shrunk - grown
    return f"{shrunk} of {len(gains)} maps (larger on {grown}, no clear difference on {open_})"


def method_verdict(table: AblationTable) -> str:
    """Return on how many maps our method is better than the paper's."""
    t = [each.t for each in table.method_gains if each.t is not None]
    H = [each.H for each in table.method_gains if each.H is not None]
    return (
        f"*Our method.* Against {Solver.PAPER.value} its mean error of t is smaller on {tally(t)}, "
        f"and of H on {tally(H)}."
    )
