"""The steel of a warehouse: places and magnetisation of its parts."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, joined_rows
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.floor_plan import FloorPlan
from l2m_gtsam.simulate.world import SteelWorld

TESLA_PER_MICROTESLA = 1e-6
TESLA_PER_MILLITESLA = 1e-3


class SectionOptions(Options):
    """The cross section of one kind of steel part, as a homogeneous box."""

    breadth: Annotated[float, Field(gt=0)]
    """Outer side of the section in metres."""
    height: Annotated[float, Field(gt=0)]
    """The other outer side in metres."""
    fill: Annotated[float, Field(gt=0, le=1)]
    """Share of the outer section that is steel: rolled and folded sections are mostly air."""


@dataclass(frozen=True)
class Parts:
    """Parts of one kind: boxes along x, y and z, turned about z.

    Attributes
    ----------
    fill
        Shares of their outer sections that are steel, shape (N,).
    dimensions, centres
        In metres, shape (N, 3).
    yaw
        In radians, shape (N,).
    """

    kind: str
    fill: FloatArray
    dimensions: FloatArray
    centres: FloatArray
    yaw: FloatArray


def alike(
    kind: str, section: SectionOptions, size: tuple[float, float, float], centres: FloatArray
) -> Parts:
    """Return parts of one size along the hall's axes."""
    count = len(centres)
    sizes = np.tile(size, (count, 1))
    return Parts(kind, np.full(count, section.fill), sizes, centres, np.zeros(count))


def spread(low: float, high: float, pitch: float) -> FloatArray:
    """Return evenly spaced places from ``low`` to ``high``, at most ``pitch`` apart."""
    # Rounding of the edges must not add a part where the pitch divides the length.
    return np.linspace(low, high, int(np.ceil((high - low) / pitch - 1e-9)) + 1)


def cells(extent: float, pitch: float) -> FloatArray:
    """Return the centres of equal cells of about ``pitch`` that fill ``extent``."""
    count = max(1, round(extent / pitch))
    return (np.arange(count) + 0.5) * extent / count


def grid(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return all pairs of x and y, shape (len(x) * len(y), 2)."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


class WarehouseOptions(Options):
    """Steel parts of the hall and how strongly they are magnetised."""

    post: SectionOptions = SectionOptions(breadth=0.3, height=0.3, fill=0.08)
    """Columns that carry the roof, behind the walls and within the racks."""
    upright: SectionOptions = SectionOptions(breadth=0.1, height=0.1, fill=0.2)
    """Uprights of the racks."""
    rack_beam: SectionOptions = SectionOptions(breadth=0.05, height=0.12, fill=0.3)
    """Beams along the racks' faces."""
    hall_beam: SectionOptions = SectionOptions(breadth=0.3, height=0.6, fill=0.08)
    """Beams across the hall, under the roof and under the floor."""
    rebar: SectionOptions = SectionOptions(breadth=0.05, height=0.05, fill=0.3)
    """Bundles of reinforcing bars in the floor."""
    hall_height: Annotated[float, Field(gt=0)] = 8.0
    """Height of the roof beams above the floor in metres."""
    rack_height: Annotated[float, Field(gt=0)] = 6.0
    """Height of the racks' uprights in metres."""
    rack_beam_level: Annotated[float, Field(gt=0)] = 1.4
    """Height of the racks' lowest beams above the floor in metres."""
    bay: Annotated[float, Field(gt=0)] = 5.4
    """Largest distance of neighbouring uprights along a rack in metres."""
    wall: Annotated[float, Field(ge=0)] = 0.3
    """Thickness of the walls, behind which posts stand, in metres."""
    post_pitch: Annotated[float, Field(gt=0)] = 11.0
    """Largest distance of neighbouring posts and hall beams in metres."""
    floor_beam_depth: Annotated[float, Field(gt=0)] = 1.2
    """Depth of the floor beams' centres below the floor in metres."""
    rebar_pitch: Annotated[float, Field(gt=0)] = 4.5
    """Side of the floor's squares, each with one bundle at a random place, in metres."""
    rebar_length: Annotated[float, Field(gt=0)] = 3.0
    """Length of a bundle in metres."""
    rebar_depth: Annotated[float, Field(gt=0)] = 0.1
    """Depth of the bundles below the floor in metres."""
    susceptibility: Annotated[float, Field(ge=0)] = 100.0
    """Relative susceptibility of structural steel at the Earth's field strength."""
    remanence: Annotated[float, Field(ge=0)] = 15.0
    """Standard deviation of the steel's remanent polarisation along its length in millitesla."""
    cross_remanence: Annotated[float, Field(ge=0)] = 0.25
    """Remanence across a part's length, relative to that along it."""


def build_warehouse(
    options: WarehouseOptions, plan: FloorPlan, earth: FloatArray, rng: np.random.Generator
) -> SteelWorld:
    """Return the steel of a hall in the Earth's field, with racks or without.

    Each part is magnetised by the Earth's field, weakened by the part's own shape, and carries
    a random remanence, mostly along its length: the history of rolling, welding and lifting
    magnets, which in a building outweighs the induced part. Parts do not magnetise each other.

    Parameters
    ----------
    options
        Parts and their magnetisation.
    earth
        The Earth's field in the map frame in microtesla, shape (3,).
    """
    racks = (_uprights(options, plan), _rack_beams(options, plan)) if len(plan.block_x) else ()
    families = (
        _posts(options, plan),
        *racks,
        _hall_beams(options, plan),
        _rebar(options, plan, rng),
    )
    steel = joined_rows(families)
    R_map_body = Rotation.from_rotvec(np.outer(steel.yaw, [0.0, 0.0, 1.0])).as_matrix()
    there = np.einsum("nij,i->nj", R_map_body, earth)
    induced = _induced(options, steel.dimensions, steel.fill, there)
    return SteelWorld(
        kinds=tuple(parts.kind for parts in families for _ in parts.yaw),
        dimensions=steel.dimensions,
        centres=steel.centres,
        R_map_body=R_map_body,
        polarisations=induced + _remanent(options, steel.dimensions, steel.fill, rng),
        earth=earth,
    )


def _induced(
    options: WarehouseOptions, dimensions: FloatArray, fill: FloatArray, earth: FloatArray
) -> FloatArray:
    """Return the induced polarisation in tesla, shape (N, 3), in fields ``earth`` (N, 3) in uT.

    A box is taken for a spheroid whose demagnetising factors are inverse to its sides: right
    for a cube, and within some ten per cent for long parts, which is well below the remanence.
    """
    # Demagnetising factors of any ellipsoid add up to one (Osborn, Phys. Rev. 67:351, 1945).
    demagnetising = (1 / dimensions) / np.sum(1 / dimensions, axis=1, keepdims=True)
    effective = options.susceptibility * fill[:, None]
    # J = chi (B_earth - N J): the body's own poles weaken the field inside it.
    polarisation = effective / (1 + effective * demagnetising) * earth * TESLA_PER_MICROTESLA
    return np.asarray(polarisation)


def _remanent(
    options: WarehouseOptions, dimensions: FloatArray, fill: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the remanent polarisation in tesla, shape (N, 3)."""
    along = dimensions == dimensions.max(axis=1, keepdims=True)
    spread = np.where(along, 1.0, options.cross_remanence) * fill[:, None]
    drawn = rng.standard_normal(dimensions.shape)
    return drawn * spread * options.remanence * TESLA_PER_MILLITESLA


def _posts(options: WarehouseOptions, plan: FloorPlan) -> Parts:
    """Return posts behind the long walls and along the middle of every other row of racks."""
    section = options.post
    wall_x = spread(0.0, plan.length, options.post_pitch)
    row_x = np.array([spread(low, high, options.post_pitch)[1:-1] for low, high in plan.block_x])
    rows = plan.rack_y[::2].mean(axis=1)
    outside = options.wall + section.height / 2
    walls = np.array([-outside, plan.width + outside])
    places = np.concatenate([grid(wall_x, walls), grid(row_x.ravel(), rows)])
    centres = np.column_stack([places, np.full(len(places), options.hall_height / 2)])
    size = (section.breadth, section.height, options.hall_height)
    return alike("post", section, size, centres)


def _uprights(options: WarehouseOptions, plan: FloorPlan) -> Parts:
    """Return uprights on both faces of every row of racks, just within the rack's outline."""
    section = options.upright
    inset = np.array([section.breadth / 2, -section.breadth / 2])
    x = np.concatenate([spread(low, high, options.bay) for low, high in plan.block_x + inset])
    places = grid(x, (plan.rack_y + inset).ravel())
    centres = np.column_stack([places, np.full(len(places), options.rack_height / 2)])
    size = (section.breadth, section.height, options.rack_height)
    return alike("upright", section, size, centres)


def _rack_beams(options: WarehouseOptions, plan: FloorPlan) -> Parts:
    """Return one beam per bay, on both faces of the racks in turn."""
    section = options.rack_beam
    edges = np.array([spread(low, high, options.bay) for low, high in plan.block_x])
    middles = ((edges[:, 1:] + edges[:, :-1]) / 2).ravel()
    faces = plan.rack_y + np.array([section.breadth / 2, -section.breadth / 2])
    x, row = np.meshgrid(middles, np.arange(len(faces)))
    face = np.indices(x.shape).sum(axis=0) % 2
    level = np.full(x.size, options.rack_beam_level)
    centres = np.column_stack([x.ravel(), faces[row, face].ravel(), level])
    size = (float(edges[0, 1] - edges[0, 0]), section.breadth, section.height)
    return alike("rack beam", section, size, centres)


def _hall_beams(options: WarehouseOptions, plan: FloorPlan) -> Parts:
    """Return the beams across the hall, in two halves each, under the roof and the floor."""
    section = options.hall_beam
    x = spread(0.0, plan.length, options.post_pitch)
    levels = np.array([options.hall_height + section.height / 2, -options.floor_beam_depth])
    places = grid(x, np.array([0.25, 0.75]) * plan.width)
    centres = np.column_stack([np.tile(places, (len(levels), 1)), np.repeat(levels, len(places))])
    return alike("hall beam", section, (section.breadth, plan.width / 2, section.height), centres)


def _rebar(options: WarehouseOptions, plan: FloorPlan, rng: np.random.Generator) -> Parts:
    """Return one bundle of bars per square of the floor, at a random place and angle."""
    x, y = (cells(extent, options.rebar_pitch) for extent in (plan.length, plan.width))
    places = grid(x, y)
    places = places + rng.uniform(-0.5, 0.5, places.shape) * options.rebar_pitch
    centres = np.column_stack([places, np.full(len(places), -options.rebar_depth)])
    section = options.rebar
    size = (options.rebar_length, section.breadth, section.height)
    # Bars are laid along or across the hall, a few degrees askew.
    quarter_turns = rng.integers(0, 2, len(places)) * np.pi / 2
    yaw = quarter_turns + rng.normal(0.0, np.deg2rad(3.0), len(places))
    return replace(alike("rebar", section, size, centres), yaw=yaw)
