"""All studies by name."""

from typing import Any

from l2m_gtsam.studies.ablation.study import ABLATION
from l2m_gtsam.studies.basin_study import BASIN
from l2m_gtsam.studies.honesty.study import HONESTY
from l2m_gtsam.studies.scaling.study import SCALING
from l2m_gtsam.studies.study import Study

STUDIES: dict[str, Study[Any, Any, Any]] = {
    study.name: study for study in (BASIN, HONESTY, ABLATION, SCALING)
}
"""A new study is its own file and its name here."""
