"""The verdict in the terminal."""

from l2m_gtsam.qa.judge import Verdict
from l2m_gtsam.qa.reasons.reason import Level


def verdict_lines(verdict: Verdict) -> list[str]:
    """Return the verdict on the whole, then on every sensor that does not simply pass."""
    lines = [f"verdict: {verdict.level.upper()}"]
    lines += [f"  {reason.level.upper()}: {reason.text}" for reason in verdict.reasons]
    for sensor in verdict.sensors:
        if sensor.level is not Level.PASS:
            told = [each.text for each in sensor.reasons if each.level is not Level.PASS]
            lines.append(f"  {sensor.level.upper()} {sensor.sensor}: {' '.join(told)}")
    return lines
