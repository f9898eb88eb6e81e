"""Maps that are kept up through rounds of changes. Long: `make study` runs it."""

import pytest

from l2m_gtsam.studies.changes.loads import ChangesStudyOptions
from tests.worlds.changing_hall import rounds_end

pytestmark = pytest.mark.study

WITHIN = 1.1  # of a fresh survey


@pytest.mark.parametrize("seed", [1200, 1203])
def test_twenty_rounds_of_changes_are_as_good_as_a_fresh_survey(seed: int) -> None:
    end = rounds_end(ChangesStudyOptions(sensors=3), seed, 20)
    assert end.kept.rms < WITHIN * end.fresh.rms
    assert end.kept.z < WITHIN * max(end.fresh.z, 1.0)
    assert end.first.z > 3  # the place has changed
