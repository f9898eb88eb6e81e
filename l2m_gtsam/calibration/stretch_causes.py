"""What stretches of rejected readings are of: the place, the moment, the vehicle or one sensor.

Judged place by place: in each cell of the floor that holds rejected readings all readings of all
passes there are asked, rejected or not. The causes are uniform fields, as far as one cell goes:

- place: one field in the map frame, in all passes and at all sensors alike;
- moment: the same in one pass only;
- vehicle: offsets in the frames of the sensors, those that explain rejected readings everywhere;
- sensor: an offset of one sensor only, where its readings were rejected.

A stretch has what the cells that it goes through have together, so that causes may be mixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.calibration.changed_places import CELL_M, ChangesOptions, averaged_drive, is_place_of
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.drive_sources import (
    REJECTED,
    amplitudes,
    passages_of,
    sensor_offsets,
)
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.sources.found_sources import price
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.records.calibration import Disagreement
from l2m_gtsam.records.places import Cause, CauseGain

AXES = 3


def with_causes(
    stretches: tuple[Disagreement, ...],
    solution: OneKeySolution,
    field_map: QueryableMap,
    options: ChangesOptions,
) -> tuple[Disagreement, ...]:
    """Return stretches with how well each cause explains the readings at their places.

    Parameters
    ----------
    stretches
        Of rejected readings of a solve, stamps as its readings have them.
    solution
        The solve.
    field_map
        The map that it was solved on; one that does not know its errors, or is contradicted,
        explains nothing.
    options
        How readings are averaged.
    """
    if not stretches or not isinstance(field_map, UncertainMap) or not is_place_of(field_map):
        return stretches
    if solution.contradicted or not solution.comparable:
        return stretches
    drive = averaged_drive(solution, field_map, options)
    rows = drive.marginal(field_map, field_map, solution.budget, options.averaging)
    places = DisagreeingPlaces.of(rows, drive)
    return tuple(replace(each, explanations=places.explanations(each)) for each in stretches)


@dataclass(frozen=True)
class DisagreeingPlaces:
    """Cells of the floor with rejected readings, and what explains these.

    Attributes
    ----------
    drive
        N averaged readings.
    cell
        Which cell each is in, shape (N,).
    causes
        Of each cell with rejected readings: gain and size of every cause.
    """

    drive: AveragedDrive
    cell: IntArray
    causes: dict[int, dict[Cause, CauseGain]]

    @classmethod
    def of(cls, rows: MarginalRows, drive: AveragedDrive) -> "DisagreeingPlaces":
        """Return the cells of averaged readings."""
        floor = np.floor(rows.points[:, :2] / CELL_M)
        _, cell = np.unique(floor, axis=0, return_inverse=True)
        wrong = drive.averages.counted < REJECTED
        causes = CellCauses.of(rows, drive, wrong)
        found = {int(k): causes.explained(cell == k) for k in np.unique(cell[wrong])}
        return cls(drive, cell, found)

    def explanations(self, stretch: Disagreement) -> tuple[CauseGain, ...]:
        """Return what the cells of a stretch have together, the best cause first."""
        readings = self.drive.view.readings
        stamps, names = readings.stamp_ns, np.array(readings.sensors)
        own = (stamps >= stretch.start_ns) & (stamps <= stretch.end_ns)
        own &= np.isin(names[readings.sensor], stretch.sensors)
        cells = [self.causes[k] for k in np.unique(self.cell[own]).tolist() if k in self.causes]
        return together(cells)


def together(cells: Sequence[dict[Cause, CauseGain]]) -> tuple[CauseGain, ...]:
    """Return what each cause explains of several cells, the best first, and its largest size."""
    if not cells:
        return ()
    found = [
        CauseGain(
            cause,
            sum(each[cause].gain for each in cells),
            max(each[cause].size for each in cells),
        )
        for cause in cells[0]
    ]
    return tuple(sorted(found, key=lambda each: -each.gain))


@dataclass(frozen=True)
class CellCauses:
    """What explains the readings of a cell.

    Attributes
    ----------
    rows, drive
        N averaged readings.
    pulled
        Precision times residuals of all of them, shape (N, 3).
    wrong
        Which of them were rejected, shape (N,).
    offsets
        What offsets of the S sensors do where readings were rejected, shape (N, 3, 3 S).
    switched
        Offsets that explain the rejected readings of the whole drive, uT, shape (3 S,).
    one
        What a parameter has to explain.
    """

    rows: MarginalRows
    drive: AveragedDrive
    pulled: FloatArray
    wrong: BoolArray
    offsets: FloatArray
    switched: FloatArray
    one: float

    @classmethod
    def of(cls, rows: MarginalRows, drive: AveragedDrive, wrong: BoolArray) -> "CellCauses":
        """Return the causes of a drive."""
        pulled, _ = rows.pull(rows.residual)
        offsets = sensor_offsets(drive) * wrong[:, None, None]
        _, switched = amplitudes(rows, offsets, pulled)
        return cls(rows, drive, pulled, wrong, offsets, switched, price(rows, 1))

    def explained(self, here: BoolArray) -> dict[Cause, CauseGain]:
        """Return gain and size of every cause in a cell whose readings are given, shape (N,)."""
        passage = passages_of(self.drive.averages.slot, here)
        passes = [passage == p for p in range(int(passage.max()) + 1)]
        sensor, uniform = self.drive.view.readings.sensor, np.eye(AXES)
        sensors = [here & (sensor == s) for s in np.unique(sensor)]
        place = self._free(here[:, None, None] * uniform)
        moment = max(self._free(own[:, None, None] * uniform) for own in passes)
        alone = max(
            self._free(own[:, None, None] * self.offsets[:, :, 3 * k : 3 * k + 3])
            for k, own in enumerate(sensors)
        )
        found = {
            Cause.PLACE: place,
            Cause.MOMENT: (moment[0] - 2 * np.log(len(passes)), moment[1]),
            Cause.VEHICLE: self._vehicle(here),
        }
        if len(sensors) > 1:
            found[Cause.SENSOR] = alone[0] - 2 * np.log(len(sensors)), alone[1]
        return {cause: CauseGain(cause, float(gain), size) for cause, (gain, size) in found.items()}

    def _free(self, features: FloatArray) -> tuple[float, float]:
        """Return the gain (a BIC) and the size in uT of fields of three free amplitudes."""
        gain, x = amplitudes(self.rows, features, self.pulled)
        return gain - len(x) * self.one, _size(features @ x)

    def _vehicle(self, here: BoolArray) -> tuple[float, float]:
        """Return the same of the offsets that all rejected readings have; each cell pays a part."""
        field = self.offsets @ self.switched * here[:, None]
        own = float(self.rows.information(field[:, :, None])[0, 0])
        gain = 2 * float(np.sum(field * self.pulled)) - own
        share = np.count_nonzero(self.wrong & here) / np.count_nonzero(self.wrong)
        return gain - share * len(self.switched) * self.one, _size(field)


def _size(field: FloatArray) -> float:
    """Return the root mean square of the length of a field where there is any, uT."""
    squares = np.sum(field**2, axis=1)
    present = squares > 0
    return float(np.sqrt(squares[present].mean())) if present.any() else 0.0
