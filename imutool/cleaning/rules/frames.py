"""Frames: messages of one topic that name several, as two sensors on it do."""

from __future__ import annotations

from collections.abc import Iterator

from imutool.cleaning.finding import Finding, Severity
from imutool.cleaning.rule import Rule, TopicSummary


class Frames(Rule):
    """Rule for several frames; it reports them."""

    place = 140

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Finding about the frames."""
        distrust = whole.frames.mixed()
        severity: Severity = "error" if distrust else "warning"
        yield from (Finding("frames", severity, what, len(whole.frames), distrust=distrust) for what in whole.frames.words())
