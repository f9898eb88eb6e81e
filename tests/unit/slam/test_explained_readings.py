"""How many of the last readings a map explains: reported once, and again when it changes."""

from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.explained_readings import (
    LAST_KEY_POSES,
    LEAST_READINGS,
    ExplainedReadings,
)


def test_few_explained_readings_are_reported_once_and_their_end_too() -> None:
    explained = ExplainedReadings()
    refused = [explained.add(4, 0) for _ in range(2 * LAST_KEY_POSES)]
    kinds = [each[0] for each in refused if each is not None]
    assert kinds == [EventKind.READINGS_REFUSED]
    assert refused.index(next(filter(None, refused))) == LEAST_READINGS // 4 - 1
    assert explained.are_few
    fitting = [explained.add(4, 4) for _ in range(LAST_KEY_POSES)]
    assert [each[0] for each in fitting if each is not None] == [EventKind.READINGS_FIT]
    assert not explained.are_few


def test_key_poses_without_readings_tell_in_the_end() -> None:
    explained = ExplainedReadings()
    telling = []
    for _ in range(LAST_KEY_POSES):
        assert explained.add(0, 0) is None
        telling.append(explained.is_telling)
    assert telling == [False] * (LAST_KEY_POSES - 1) + [True]
    assert not explained.are_few  # nothing was to be explained
    explained.forget()
    assert not explained.is_telling


def test_a_share_between_both_limits_is_not_reported() -> None:
    explained = ExplainedReadings()
    assert [explained.add(10, 5) for _ in range(LAST_KEY_POSES)] == [None] * LAST_KEY_POSES
