"""Frames: messages of one topic that name several, as two sensors on it do."""

from __future__ import annotations

from collections.abc import Iterator

from imutool.cleaning.finding import Finding
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import frame_words


class Frames(Rule):
    """Rule for several frames; it reports them."""

    place = 140

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Finding about the frames."""
        yield from (Finding("frames", "warning", what, len(whole.frames)) for what in frame_words(whole.frames))
