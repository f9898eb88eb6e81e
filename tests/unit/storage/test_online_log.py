"""Logs of localisations on line that cannot be read."""

import os
from pathlib import Path

import pytest

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.storage.online_log import LogLine, OnlineLog, read_log
from tests.support.alarms import ends_within


def test_what_was_written_is_read(tmp_path: Path) -> None:
    lines = (LogLine(1, event=("lost", "no fit")), LogLine(2, event=("found", "again")))
    with OnlineLog(tmp_path / "log.jsonl", lines):
        assert read_log(tmp_path / "log.jsonl") == lines


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.jsonl")
    said = "not a log that can be read; begin without --resume"
    with ends_within(10), pytest.raises(ConfigError, match=said):
        read_log(tmp_path / "log.jsonl")
