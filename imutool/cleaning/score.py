"""How good a log's IMU is, as one number, and whether it is to be trusted.

    score = share * prod(1 - penalty)

`share` is that of valid samples among those received and missing (a message sent twice counts once). Each kind of finding (a
rule, and what it cost) costs once: a note nothing, a warning that was mended (dropped, converted) 0.02, one that could only be
said 0.05, an error 0.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from imutool.cleaning.finding import Finding

Verdict = Literal["good", "usable", "quarantine"]
MENDED, SAID, ERROR = 0.02, 0.05, 0.3


def score(messages: int, valid: int, missing: int, findings: Sequence[Finding]) -> float:
    """0 (nothing to be had) to 1 (nothing found)."""
    whole = messages + missing
    value = valid / whole if whole else 0.0
    for _, cost in {(one.rule, _cost(one)) for one in findings}:
        value *= 1.0 - cost
    return value


def _cost(finding: Finding) -> float:
    if finding.severity == "error":
        return ERROR
    if finding.severity == "note":
        return 0.0
    return SAID if finding.action == "flagged" else MENDED


def verdict(findings: Sequence[Finding], reasons: Sequence[str]) -> Verdict:
    """`quarantine` where there is a reason not to trust the log, `good` where there is nothing but notes."""
    if reasons:
        return "quarantine"
    return "usable" if any(one.severity != "note" for one in findings) else "good"
