"""A verdict as lines of text: what passes is called a note, in the terminal and in exports."""

import pytest

from l2m_gtsam.cli.terminal import print_verdict
from l2m_gtsam.records.verdict import (
    Judgement,
    Level,
    Reason,
    SensorVerdict,
    Verdict,
    judged_lines,
)

NOTE = Reason(Level.PASS, "Taken for exact: the survey's poses.")
GRAVE = Reason(Level.FAIL, "An axis is dead.")


@pytest.mark.parametrize("own", [(), (GRAVE,)])
def test_a_note_is_no_verdict(own: tuple[Reason, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """Under a PASS as under a FAIL; the level in files stays what it is."""
    verdict = Verdict.of([NOTE], [SensorVerdict.of("mag", own)])
    print_verdict(verdict)
    for lines in (capsys.readouterr().out.splitlines(), judged_lines(Judgement(verdict, {}))):
        assert f"  note: {NOTE.text}" in lines
        assert not [line for line in lines if line.startswith("  PASS")]
    assert verdict.reasons[0].level == "pass"


def test_reasons_keep_their_level() -> None:
    verdict = Verdict.of([NOTE, GRAVE, Reason(Level.WARN, "It is short.")], [])
    assert [line.split()[0] for line in verdict.lines()] == ["verdict:", "FAIL:", "WARN:", "note:"]
