"""Tables fit the terminal: the most important columns first, all of them when asked for."""

import pytest
from rich.table import Table
from rich.text import Text

from l2m_gtsam.cli.tables import add_text, new_table
from l2m_gtsam.cli.tables.calibration import HEADINGS, calibration_table
from l2m_gtsam.cli.terminal import print_table, print_verdict, shown_progress
from l2m_gtsam.records.verdict import Level, Reason, SensorVerdict, Verdict
from tests.drives.calibrations import calibration, sensor

WIDTHS = (80, 100, 120, 160)


def lines_of(
    table: Table, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    monkeypatch.setenv("COLUMNS", str(width))
    print_table(table)
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("width", WIDTHS)
def test_a_row_is_one_line_and_what_is_missing_is_named(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = calibration(*(sensor(f"mag_{k:02d}") for k in range(12)))
    lines = lines_of(calibration_table(result), width, monkeypatch, capsys)
    assert max(map(len, lines)) <= width
    rows = [line for line in lines if line.startswith("mag_")]
    assert len(rows) == 12
    text = " ".join(lines)
    # The names of what is left out are wrapped, too.
    assert all(heading in " ".join(text.split()) for heading in HEADINGS)
    assert "t_lidar_mag (m)" in text.split("--wide shows also")[0]


def test_all_columns_are_there_when_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    print_table(calibration_table(calibration(sensor("mag"))), wide=True)
    out = capsys.readouterr().out
    assert "--wide" not in out
    (head,) = [line for line in out.splitlines() if line.startswith("sensor")]
    assert all(heading in head for heading in HEADINGS)


@pytest.mark.parametrize("width", WIDTHS)
def test_long_text_is_broken_in_its_column(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = new_table("t", ("topic",), ["count"])
    add_text(table, "use")
    table.add_row("/a", "12", 30 * "word ")
    lines = lines_of(table, width, monkeypatch, capsys)
    assert max(map(len, lines)) <= width
    assert sum(line.count("word") for line in lines) == 30


def test_levels_are_coloured_and_names_are_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where a terminal wants colours; markup in a name is printed as it is."""
    name = "[red]FAIL[/]"
    one = SensorVerdict.of(name, [Reason(Level.WARN, "It is PASS.")])
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    print_verdict(Verdict.of([], [one]))
    out = capsys.readouterr().out
    assert out.count("\x1b[1;33mWARN\x1b[0m") == 2
    assert Text.from_ansi(out).plain.splitlines()[1] == f"  WARN {name}: It is PASS."


def test_control_characters_of_names_are_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "/mag\x1b]0;title\x07\u202e\n"
    table = new_table(name, ("topic",), ["count"], name)
    add_text(table, "use")
    table.add_row(name, "12", name)
    out = "\n".join(lines_of(table, 200, monkeypatch, capsys))
    assert out.count("/mag\\x1b]0;title\\x07\\u202e\\n") == 4
    assert not {"\x1b", "\x07", "\u202e"} & set(out)


def test_where_there_is_no_terminal_a_stage_is_a_line_when_it_begins(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with shown_progress() as progress:
        progress("reading", 0.0)
        assert capsys.readouterr().err == "reading\n"
        progress("reading", 0.5)
        progress("sol\x1bving", 0.0)
        assert capsys.readouterr().err == "sol\\x1bving\n"
    assert capsys.readouterr().err == ""
