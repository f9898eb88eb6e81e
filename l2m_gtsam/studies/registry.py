"""All studies by name."""

from typing import Any

from l2m_gtsam.studies.ablation.study import ABLATION
from l2m_gtsam.studies.basin.study import BASIN
from l2m_gtsam.studies.changes.study import CHANGES
from l2m_gtsam.studies.honesty.study import HONESTY
from l2m_gtsam.studies.scaling.study import SCALING
from l2m_gtsam.studies.slam.study import SLAM
from l2m_gtsam.studies.slam_array.study import SLAM_ARRAY
from l2m_gtsam.studies.study import Study
from l2m_gtsam.studies.table1.study import TABLE1
from l2m_gtsam.studies.troubles.study import TROUBLES
from l2m_gtsam.studies.validation.study import VALIDATION

STUDIES: dict[str, Study[Any, Any, Any]] = {
    study.name: study
    for study in (
        TABLE1,
        BASIN,
        ABLATION,
        HONESTY,
        SCALING,
        SLAM,
        SLAM_ARRAY,
        TROUBLES,
        VALIDATION,
        CHANGES,
    )
}
"""A new study is its own file and its name here."""
