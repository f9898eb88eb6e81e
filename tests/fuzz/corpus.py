"""Sound files of every kind that is read, and the commands that read them."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.cloud import write_cloud
from tests.drives.bags import Entry, ros, write
from tests.fuzz.further import further_corpus
from tests.fuzz.sound import (
    BAGS,
    BYTES,
    CASE,
    MAPS,
    OUT,
    PLAIN_JSON,
    PLAIN_YAML,
    READ,
    WORDS,
    Sound,
)
from tests.fuzz.structures import changed_archive, changed_cloud
from tests.support.command_line import l2m_process
from tests.support.ulog import write_ulog
from tests.worlds.halls import SMALL_HALL

START = 1_700_000_000_000_000_000
EXPORTS = ("json", "ros2-launch", "urdf", "kalibr", "px4", "ardupilot")
PCD = """VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 300
HEIGHT 1
POINTS 300
DATA ascii
"""


def drive(folder: Path, kind: str, frames: Sequence[str] = ("mag_00",)) -> Path:
    """Return a bag of two seconds that turns and drives, as a file."""
    dialect, entries = ros(kind), []
    random = np.random.default_rng(1)
    for k in range(40):
        stamp, angle = START + 50_000_000 * k, 0.05 * k
        pose = dialect.pose_stamped(
            stamp,
            (0.05 * k, 0.1 * np.sin(angle), 0.0),
            (0, 0, np.sin(angle / 2), np.cos(angle / 2)),
        )
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose))
        for frame in frames:
            field = 1e-6 * (np.array([20.0, 0.0, -40.0]) + random.normal(size=3))
            message = dialect.magnetic(stamp, field, frame)
            entries.append(Entry(f"/{frame}", "sensor_msgs/MagneticField", stamp, message))
    made = write(folder, kind, entries, f"{kind}_drive")
    return made if made.is_file() else next(made.glob("*.*[0-9p3]"))


def quick_corpus(folder: Path, files: Path) -> list[Sound]:
    """Return sound files whose reading takes a moment.

    Parameters
    ----------
    folder
        Where those go that are made.
    files
        Results that are kept with the tests.
    """
    calibration, metrics = files / "calibration.yaml", files / "metrics.json"
    bags = [drive(folder, kind) for kind in ("ros1", "sqlite3", "mcap")]
    sounds = [Sound(f"bag {each.suffix}", each, BAGS[each.suffix], LOOK) for each in bags]
    exports = [("export", CASE, "--format", each, "--out", OUT) for each in EXPORTS]
    validate = ("validate", "--calibration", CASE, "--compare", str(calibration))
    despite = tuple((*each, "--despite-verdict") for each in exports)
    sounds += [
        Sound("map", files / "map.npz", MAPS, (("map", "info", CASE),)),
        Sound("calibration", calibration, PLAIN_YAML, (*despite, validate)),
        Sound("calibration in a folder", calibration, PLAIN_YAML, (("report", "."),), (metrics,)),
        Sound("metrics", metrics, PLAIN_JSON, (("report", "."),), (calibration,)),
        Sound("slam.json", files / "slam.json", PLAIN_JSON, (("report", "."),)),
    ]  # fmt: skip
    sounds += [*_texts(folder, files, bags[-1]), *_clouds(folder), *_logs(folder)]
    return [*sounds, *further_corpus(folder, files, bags[-1])]


INSPECT = (("inspect", CASE),)
LOOK = (*INSPECT, ("config", "--for", CASE))


def _texts(folder: Path, files: Path, bag: Path) -> list[Sound]:
    """Return configurations, lists and trajectories."""
    config = folder / "config.yaml"
    content = {
        "bag": {"poses": "/pose", "units": "tesla", "tf": None, "stamps": "header"},
        "calibration": {
            "start": {"mag_00": [0.1, 0.2, 0.3]},
            "solve": {"robust": {"loss": "huber"}},
        },
        "qa": {"position_sigma_m": {"warn": 0.01, "fail": 0.03}},
    }
    with config.open("w") as into:
        YAML(typ="safe").dump(content, into)
    manifest = folder / "manifest.yaml"
    drives = [{"bag": "a.bag", "vehicle": "v", "date": "2026-01-02T03:04:05Z", "map": "m.npz"}] * 3
    manifest.write_text(json.dumps(drives))
    sensors = folder / "sensors.yaml"
    sensors.write_text(json.dumps({"sensors": {"mag_00": {"t_lidar_mag": [0.1, 0.0, 0.2]}}}))
    scenario = folder / "scenario.yaml"
    scenario.write_text(json.dumps(SMALL_HALL))
    rows = [f"{1.7e9 + 0.05 * k:.9f} {0.1 * k} {k % 3} 0.5 0 0 0 1" for k in range(60)]
    tum = folder / "poses.txt"
    tum.write_text("# stamp x y z qx qy qz qw\n" + "\n".join(rows) + "\n")
    table = folder / "poses.csv"
    head = "time,x,y,z,qx,qy,qz,qw"
    table.write_text("\n".join([head, *(each.replace(" ", ",") for each in rows)]) + "\n")
    urdf = folder / "robot.urdf"
    urdf.write_text('<?xml version="1.0"?>\n<robot name="r"><link name="lidar"/></robot>\n')
    return [
        Sound("configuration", config, PLAIN_YAML, (("inspect", str(bag), "--config", CASE),)),
        Sound("manifest of a fleet", manifest, PLAIN_YAML, ((READ, "manifest", CASE),)),
        Sound("list of sensors", sensors, PLAIN_YAML, ((READ, "sensors", CASE),)),
        Sound("scenario", scenario, PLAIN_YAML, ((READ, "scenario", CASE),)),
        Sound("poses in TUM", tum, WORDS, (("inspect", str(bag), "--poses", CASE),)),
        Sound("poses in CSV", table, WORDS, (("inspect", str(bag), "--poses", CASE),)),
        Sound(
            "URDF",
            urdf,
            WORDS,
            (
                (
                    "export",
                    str(files / "calibration.yaml"),
                    "--format",
                    "urdf",
                    "--into",
                    CASE,
                    "--out",
                    OUT,
                    "--despite-verdict",
                ),
            ),
        ),
    ]


def _clouds(folder: Path) -> list[Sound]:
    points = np.random.default_rng(2).uniform(-5, 5, (300, 3))
    sounds = []
    for name in ("cloud.pcd", "cloud.ply", "cloud.npz"):
        if name.endswith("pcd"):
            rows = "\n".join(" ".join(map(str, each)) for each in points.tolist())
            (folder / name).write_text(f"{PCD}{rows}\n")
        elif name.endswith("ply"):
            write_cloud(folder / name, points)
        else:
            np.savez(folder / name, points=points)
        changes = {**BYTES, "arrays": changed_cloud, "members": changed_archive}
        made = changes if name.endswith("npz") else WORDS
        sounds.append(Sound(f"cloud {name[-4:]}", folder / name, made, ((READ, "cloud", CASE),)))
    try:
        import laspy
    except ImportError:
        return sounds
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = points.T
    for suffix in (".las", ".laz"):
        las.write(str(folder / f"cloud{suffix}"))
        path = folder / f"cloud{suffix}"
        sounds.append(Sound(f"cloud {suffix}", path, BYTES, ((READ, "cloud", CASE),)))
    return [*sounds, *_e57(folder, points)]


def _e57(folder: Path, points: FloatArray) -> list[Sound]:
    try:
        import pye57
    except ImportError:
        return []
    path = folder / "cloud.e57"
    with pye57.E57(str(path), mode="w") as file:
        axes = ("cartesianX", "cartesianY", "cartesianZ")
        columns = dict(zip(axes, points.T, strict=True))
        file.write_scan_raw(columns, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3))
    return [Sound("cloud .e57", path, BYTES, ((READ, "cloud", CASE),))]


def _logs(folder: Path) -> list[Sound]:
    stamps = np.arange(0, 2_000_000, 50_000).astype(np.float64)
    field = np.column_stack([0.2 + 0 * stamps, 0.001 * np.arange(len(stamps)), -0.4 + 0 * stamps])
    still = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(stamps), 1))
    layout = {"position": 3, "q": 4}
    ulog = write_ulog(
        folder / "log.ulg",
        [
            ("sensor_mag", 0, {"x": 1, "y": 1, "z": 1}, stamps, field),
            ("vehicle_visual_odometry", 0, layout, stamps, still),
        ],
    )
    table = folder / "log.csv"
    head = "time,mag_x,mag_y,mag_z,x,y,z,qx,qy,qz,qw"
    rows = [f"{0.05 * k},20.5,{0.3 * (k % 7)},-40.25,{0.1 * k},0,0,0,0,0,1" for k in range(60)]
    table.write_text("\n".join([head, *rows]) + "\n")
    units = folder / "units.yaml"
    units.write_text("bag: {units: microtesla}\n")
    return [
        Sound("log in CSV", table, WORDS, ((*INSPECT[0], "--config", str(units)),)),
        Sound("ULog", ulog, BYTES, INSPECT),
    ]


def whole_corpus(folder: Path, files: Path, demo: Path) -> list[Sound]:
    """Return the same and, from a demonstration, files for the commands that compute.

    Parameters
    ----------
    folder, files
        As in ``quick_corpus``.
    demo
        Folder of `l2m demo` in a small hall.
    """
    bag, mapping = (
        next((demo / f"{each}_mcap").glob("*.mcap")) for each in ("calibration", "mapping")
    )
    suite, field_map, result = demo / "suite.yaml", demo / "map.npz", demo / "calibration.yaml"
    other = next((demo / "other" / "calibration_mcap").glob("*.mcap"))
    truth, config = demo / "slam" / "trajectory.tum", folder / "drive.yaml"
    options = {"slam": {"drift": {"scale": 0.0}}, "bag": {"units": "auto"}}
    config.write_text(json.dumps(options))
    fleet = folder / "fleet.yaml"
    fleet.write_text(json.dumps([{"bag": str(bag), "vehicle": "v"}]))
    known = ("--calibration", str(result))
    on_map = ("--map", str(field_map))
    use = ("--calibration", CASE, "--out", OUT, "--despite-verdict")
    every = [
        Sound("other drive", other, BAGS[".mcap"], (
            ("validate", CASE, *known, *on_map, "--out", OUT),
        )),
        Sound("drive", bag, BAGS[".mcap"], (
            ("calibrate", CASE, *on_map, "--out", OUT),
            ("plan", CASE, *on_map),
            ("slam", CASE, *on_map, *known, "--out", OUT),
            ("apply", CASE, *known, "--out", f"{OUT}.mcap", "--despite-verdict"),
        )),
        Sound("survey", mapping, BAGS[".mcap"], (
            ("map", "update", str(field_map), CASE, "--suite", str(suite), "--out", f"{OUT}.npz"),
            ("map", "suite", CASE, "--out", f"{OUT}.yaml"),
            ("map", "build", CASE, "--suite", str(suite), "--out", f"{OUT}.npz"),
        )),
        Sound("map of a drive", field_map, MAPS, (
            ("calibrate", str(bag), "--map", CASE, "--out", OUT),
            ("map", "update", CASE, str(mapping), "--suite", str(suite), "--out", f"{OUT}.npz"),
            ("map", "plot", CASE, "--out", f"{OUT}.png"),
            ("map", "info", CASE),
        )),
        Sound("calibration of a drive", result, PLAIN_YAML, (
            ("apply", str(bag), "--calibration", CASE, "--out", f"{OUT}.mcap", "--despite-verdict"),
            ("slam", str(bag), *on_map, *use[:-1]),
            ("validate", str(other), "--calibration", CASE, *on_map, "--out", OUT),
        )),
        Sound("suite", suite, PLAIN_YAML, (
            ("map", "update", str(field_map), str(mapping), "--suite", CASE, "--out", f"{OUT}.npz"),
        )),
        Sound("configuration of a drive", config, PLAIN_YAML, (
            ("calibrate", str(bag), *on_map, "--config", CASE, "--out", OUT),
            ("slam", str(bag), *on_map, *known, "--config", CASE, "--out", OUT),
        )),
        Sound("fleet", fleet, PLAIN_YAML, (
            ("batch", CASE, *on_map, "--out", OUT, "--workers", "1"),
        )),
        Sound("truth", truth, WORDS, (
            ("slam", str(bag), *on_map, *known, "--truth", CASE, "--out", OUT),
        )),
    ]  # fmt: skip
    computing = [replace(each, computes=True) for each in every]
    return [*quick_corpus(folder, files), *computing]


def make_demo(folder: Path) -> None:
    """Make what ``whole_corpus`` needs, in a minute of a core; again makes nothing."""
    if (folder / "slam" / "trajectory.tum").exists():
        return
    options = folder.with_suffix(".yaml")
    options.write_text(json.dumps(SMALL_HALL))
    l2m_process("demo", "--options", options, "--out", folder)
    made = ("--kind", "mcap", "--seed", "2", "--options", options, "--out", folder / "other")
    l2m_process("simulate", *made)
    on_map = ("--map", folder / "map.npz", "--calibration", folder / "calibration.yaml")
    l2m_process("slam", folder / "calibration_mcap", *on_map, "--out", folder / "slam")
