"""What the commands compute, from records in memory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.api.arguments import (
    CALIBRATION,
    DRIVE,
    MAP,
    SENSORS,
    WHOLE_MAP,
    check,
    drives_of,
    options_of,
    refused,
    sensors_of,
)
from l2m_gtsam.api.arrays import array_of
from l2m_gtsam.api.results import JudgedCalibration, LocalisedDrive
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.errors import InputError
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.build import refuse_structure
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.qa.evaluate import measured
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judgement_of
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.localisation import localise as localise_recording
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.storage.cloud import read_cloud, thinned_cloud
from l2m_gtsam.storage.known_sensors import read_known_sensors
from l2m_gtsam.upkeep.kept_map import kept_up
from l2m_gtsam.upkeep.surveys import map_surveys

Values = Mapping[str, Any]
Structure = npt.ArrayLike | str | Path | None
Suite = KnownSensor | Mapping[str, KnownSensor] | Sequence[KnownSensor] | str | Path


def build_map(
    surveys: Recording | Sequence[Recording],
    suite: Suite | None = None,
    *,
    structure: Structure = None,
    options: MappingOptions | Values | None = None,
    changes: ChangesOptions | Values | None = None,
) -> FieldMap:
    """Build a map of the magnetic field from one or several surveys.

    Each is compared with those before it. Where steel came or went between them, the map is of the
    place as the last one found it, and has a ``diary``.

    Parameters
    ----------
    surveys
        Drives with poses in one map frame.
    suite
        Calibrations of all their sensors, or a file of them; ideal sensors at the LiDAR's origin if
        absent.
    structure
        What the LiDAR saw of steel: points in the map frame in metres, shape (M, 3), or a file.
    options
        As under `mapping` in a configuration.
    changes
        As under `calibration.changes`: how steel is looked for that came or went.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    drives, known = drives_of("surveys", surveys), _sensors(suite)
    chosen = options_of(MappingOptions, options, "mapping")
    if structure is not None:
        refuse_structure(chosen.model.kind)
    steel = options_of(ChangesOptions, changes, "calibration.changes")
    return map_surveys(drives, known, chosen, steel, _cloud(structure, chosen))


def keep_map_up(
    field_map: FieldMap,
    drives: Recording | Sequence[Recording],
    suite: Suite,
    *,
    options: MappingOptions | Values | None = None,
    changes: ChangesOptions | Values | None = None,
) -> FieldMap:
    """Return a map after drives of a calibrated vehicle through a place that may have changed.

    What came, went or was moved, and where earlier readings count less, is in its ``diary``.

    Parameters
    ----------
    field_map
        Of kind harmonic, in the frame of the drives' poses.
    drives
        Later than all that the map has been given.
    suite
        The vehicle's sensors as they are calibrated, or their file.
    options
        As under `mapping` in a configuration.
    changes
        As under `calibration.changes`.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    check(WHOLE_MAP, field_map=field_map)
    every, known = drives_of("drives", drives), _sensors(suite)
    if known is None:
        raise refused("suite", suite, SENSORS)
    return kept_up(
        field_map,
        every,
        known,
        options_of(MappingOptions, options, "mapping"),
        options_of(ChangesOptions, changes, "calibration.changes"),
    )


def _sensors(suite: Suite | None) -> Mapping[str, KnownSensor] | None:
    if suite is None:
        return None
    if isinstance(suite, str | Path):
        return read_known_sensors(Path(suite))
    return sensors_of(suite)


def _cloud(structure: Structure, options: MappingOptions) -> FloatArray | None:
    if structure is None:
        return None
    if isinstance(structure, str | Path):
        return read_cloud(Path(structure), options.structure.edge)
    points = array_of("structure", structure)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"structure: of shape {points.shape}; needed are finite points (M, 3)")
    return thinned_cloud(points, options.structure.edge)


def calibrate(
    recording: Recording,
    field_map: QueryableMap,
    *,
    options: CalibrationOptions | Values | None = None,
    qa: QaOptions | Values | None = None,
    progress: Progress = silent,
) -> JudgedCalibration:
    """Calibrate every magnetometer of a drive, and judge the result.

    Parameters
    ----------
    recording
        A drive through the mapped place.
    field_map
        The map, in the frame of the drive's poses.
    options
        As under `calibration` in a configuration.
    qa
        Thresholds of the verdict, as under `qa`.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    check(DRIVE, recording=recording)
    check(MAP, field_map=field_map)
    chosen = options_of(CalibrationOptions, options, "calibration")
    limits = options_of(QaOptions, qa, "qa")
    found = calibrated(recording, field_map, chosen, None, progress)
    measures = measured(recording, found, chosen, limits, progress)
    config = Config(calibration=chosen, qa=limits)
    unjudged = replace(found.result, options=config.model_dump(mode="json"))
    judgement = judgement_of(unjudged, measures, limits)
    return JudgedCalibration(replace(unjudged, judgement=judgement), judgement.verdict)


def localise(
    recording: Recording,
    calibration: JudgedCalibration | CalibrationResult,
    field_map: QueryableMap | None = None,
    *,
    options: SlamOptions | Values | None = None,
    progress: Progress = silent,
) -> LocalisedDrive:
    """Estimate where a drive went: in a map, or in the unknown field along its path.

    Parameters
    ----------
    recording
        A drive; its poses are odometry.
    calibration
        Of its sensors.
    field_map
        The map; without one the field is found with the poses.
    options
        As under `slam` in a configuration.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    check(DRIVE, recording=recording)
    check(CALIBRATION, calibration=calibration)
    chosen = options_of(SlamOptions, options, "slam")
    known = calibration.result if isinstance(calibration, JudgedCalibration) else calibration
    if field_map is None:
        return LocalisedDrive(explore(recording, known, chosen, progress).result)
    check(MAP, field_map=field_map)
    return LocalisedDrive(localise_recording(recording, field_map, known, chosen, progress).result)
