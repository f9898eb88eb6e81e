"""What came of the scaling study: curves, how steep they are, and ratios between them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.studies.scaling.measurements import Measurement, Part, ScalingOptions, Way

STEEP = 3  # the largest sizes, of which the exponent is taken: small ones cost what is fixed


@dataclass(frozen=True)
class Curve:
    """How time grows with one quantity.

    Attributes
    ----------
    part
        The quantity.
    way
        What is timed.
    points
        From the smallest size to the largest.
    exponent
        Slope of log time over log size through the largest sizes; absent for a single size.
    """

    part: Part
    way: Way
    points: tuple[Measurement, ...]
    exponent: float | None


@dataclass(frozen=True)
class Ratio:
    """How many times as long the peer takes as what it is compared with.

    Attributes
    ----------
    part, way
        What it is compared with.
    peer
        The peer.
    size
        The largest that both were measured at.
    times
        The ratio of the times.
    """

    part: Part
    way: Way
    peer: Way
    size: int
    times: float


@dataclass(frozen=True)
class Speed:
    """What several workers gain.

    Attributes
    ----------
    workers
        How many.
    times
        The time of one worker over theirs, for computing alone.
    started
        The same with the start of the workers and what they prepare.
    """

    workers: int
    times: float
    started: float


@dataclass(frozen=True)
class ScalingTable:
    """The study's outcome."""

    options: ScalingOptions
    curves: tuple[Curve, ...]
    ratios: tuple[Ratio, ...]
    speeds: tuple[Speed, ...]


PEERS = {Part.READINGS: Way.NUMERIC, Part.SENSORS: Way.NUMERIC, Part.SURVEY: Way.DENSE}


def scaling_table(options: ScalingOptions, measured: Iterable[Measurement]) -> ScalingTable:
    """Return curves, ratios and speeds of all measurements."""
    points = sorted(measured, key=lambda each: each.size)
    curves = []
    for part in Part:
        for way in Way:
            own = tuple(each for each in points if (each.part, each.way) == (part, way))
            if own:
                curves.append(Curve(part, way, own, exponent(own)))
    found = [ratio(curve, peer_of(curves, curve.part)) for curve in curves]
    return ScalingTable(
        options, tuple(curves), tuple(each for each in found if each is not None), speeds(curves)
    )


def exponent(points: tuple[Measurement, ...]) -> float | None:
    """Return how steep the largest of some points, in order of size, lie in logarithms."""
    last = points[-STEEP:]
    if len({each.size for each in last}) < 2:
        return None
    size, seconds = np.log([[each.size, each.seconds] for each in last]).T
    return float(np.polyfit(size, seconds, 1)[0])


def peer_of(curves: Iterable[Curve], part: Part) -> Curve | None:
    """Return the peer's curve for a quantity, if there is one."""
    wanted = (part, PEERS.get(part))
    return next((each for each in curves if (each.part, each.way) == wanted), None)


def ratio(curve: Curve, peer: Curve | None) -> Ratio | None:
    """Return how much longer the peer takes; nothing for the peer itself and without a peer."""
    if peer is None or curve.way is peer.way:
        return None
    ours = {each.size: each.seconds for each in curve.points}
    both = [each for each in peer.points if each.size in ours]
    if not both:
        return None
    last = both[-1]
    return Ratio(curve.part, curve.way, peer.way, last.size, last.seconds / ours[last.size])


def speeds(curves: Iterable[Curve]) -> tuple[Speed, ...]:
    """Return what each number of workers gains over the fewest."""
    of = {each.way: each.points for each in curves if each.part is Part.WORKERS}
    alone, started = of.get(Way.BATCH, ()), of.get(Way.STARTED, ())
    return tuple(
        Speed(a.size, alone[0].seconds / a.seconds, started[0].seconds / s.seconds)
        for a, s in zip(alone, started, strict=True)
    )
