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

NOTE = Reason(Level.PASS, "Taken as exact: the survey's poses.")
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


APART = Reason(Level.FAIL, "It does not repeat.")
LOOSE = Reason(Level.WARN, "Its position is only known to ± 12 mm (1 sigma).")


def test_reasons_that_other_thresholds_remove_are_named() -> None:
    """With the thresholds; what is as grave as before, or graver, is not gone."""
    first = Verdict.of([], [SensorVerdict.of("mag", [APART, LOOSE])])
    laxer = Verdict.of([], [SensorVerdict.of("mag", [LOOSE])])
    judged = Judgement(first, {"halves": True, "limit": 1 / 3})
    again = judged.again(laxer, {"halves": False, "limit": 0.9})
    changed = "halves: True -> False, limit: 0.333333 -> 0.9"
    told = (
        f"the verdict was FAIL before, by other thresholds ({changed})",
        "no longer a reason: FAIL mag: It does not repeat.",
    )
    assert tuple(again.before()) == told
    assert [line for line in judged_lines(again) if line.strip() in told]
    # the same thresholds as at first: the reason is back
    back = again.again(first, judged.thresholds)
    assert not any("no longer" in line for line in back.before())
    graver = Verdict.of([], [SensorVerdict.of("mag", [APART, Reason(Level.FAIL, LOOSE.text)])])
    assert not any("no longer" in line for line in judged.again(graver, {}).before())
