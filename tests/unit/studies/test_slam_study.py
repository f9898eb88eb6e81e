"""The summary and the page of the study of SLAM, from cells that are made up."""

from l2m_gtsam.studies.slam.methods import MethodRow, SlamCell, SlamStudyOptions
from l2m_gtsam.studies.slam.study import SLAM


def test_what_is_lost_is_on_the_page() -> None:
    options = SlamStudyOptions(recordings=("ship-1",), seeds=2)
    keys = SLAM.keys(options)
    assert len(keys) == len(set(keys)) == 8
    alone = MethodRow(2.0, None, 0.0)
    good, bad = (
        MethodRow(0.5, 6.0, 50.0),
        MethodRow(2.5, 40.0, 50.0, unchanged=True),
    )
    peer, lost = MethodRow(1.0, 9.0, 0.5), MethodRow(3.0, 40.0, 20.0)
    cells = {
        key: SlamCell(
            path_m=100.0,
            key_poses=300,
            odometry=alone,
            ekf=peer,
            particles=peer,
            fixed_lag=lost,
            online=lost if "vehicle" in key else peer,
            ours=bad if "walk-world" in key else good,
        )
        for key in keys
    }
    summary = SLAM.summarise(options, cells)
    assert [row.ours.removed for row in summary.rows] == [0.75, 0.75, -0.25, 0.75]
    assert all(
        row.ours.never_worse for row in summary.rows
    )  # what was returned unchanged is odometry
    page = SLAM.page(summary)
    won = "smaller: ship 1, walk, world (reduced-rank filter, particle filter)."
    assert won in page
    assert "worse than odometry: ship 1, published, vehicle; ship 1, walk, vehicle." in page
    assert "not within 3 to 12: ship 1, walk, world." in page
    assert "nothing was gained: ship 1, walk, world (2)." in page
    assert page.count("| 75 % |") == 3
    assert set(SLAM.figures(summary)) == {"slam"}
