"""Two logs of one sensor and two motions: one cause has one name, and what poses cannot know is no difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest
from support import planted

from imutool.diagnosis.compare_findings import shared
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.trial.effect_forms import in_forms
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.held_out import noise_floor
from imutool.diagnosis.reference.another_motion import compared
from imutool.diagnosis.result import Finding
from imutool.diagnosis.summarize import finding_of
from imutool.sensor import catalogue

SECONDS, FILTER_HZ = 15.0, 30.0
FILTER, OTHER_FILTER = {"low_pass": [FILTER_HZ]}, {"low_pass": [2.0 * FILTER_HZ]}
SCALE, SMALL_SCALE = {"gyro_scale": [0.02, 0.0, -0.015]}, {"gyro_scale": [1e-3, -1e-3, 1e-3]}


def searched(effects: Mapping[str, Sequence[float]], seed: int, words: Sequence[str], *, still: bool = False) -> Selection:
    """What a search among some words of the catalogue selects for a log with some effects."""
    motion = planted.planar(SECONDS) if still else planted.rich(seed, SECONDS)
    candidates = in_forms(catalogue.diagnosed(words), exact=False)
    return select_effects([planted.weighed(planted.pair(motion, effects, seed))], candidates)


def differing(real: Selection, sim: Selection) -> list[str]:
    """Names of what differs, as `diagnose` tells it."""

    def findings(of: Selection) -> tuple[Finding, ...]:
        return tuple(finding_of(of.whole.logs, of, one, noise_floor(of.whole.logs)) for one in of.selected)

    selection, known, _ = compared(real, sim, findings(sim))
    return [finding.effect for finding in findings(selection) if not shared(finding, known)]


@pytest.mark.parametrize(
    ("in_real", "in_sim", "effects", "named"),
    [
        ("low_pass", "clock_offset", FILTER, []),
        ("clock_offset", "low_pass", FILTER, []),
        ("low_pass", "low_pass", FILTER, []),
        ("low_pass", "low_pass", OTHER_FILTER, ["low_pass"]),
        ("low_pass", "low_pass", {}, ["low_pass"]),
    ],
)
def test_a_filter_that_goes_by_two_names_is_one(
    in_real: str, in_sim: str, effects: Mapping[str, Sequence[float]], named: list[str]
) -> None:
    assert differing(searched(FILTER, 3, [in_real]), searched(effects, 7, [in_sim])) == named


def test_what_the_simulation_moves_too_little_to_show_is_no_difference() -> None:
    real, words = searched({"gyro_scale": [0.02, 0.0, 0.0]}, 3, ["gyro_scale"]), ["gyro_scale"]
    assert [one.effect.name for one in real.selected] == words
    assert differing(real, searched({}, 7, words, still=True)) == []  # turns about z alone
    assert differing(real, searched({}, 7, words)) == words


def test_less_than_poses_know_is_no_difference() -> None:
    words = ["gyro_scale"]
    real, sim = searched(SMALL_SCALE, 3, words), searched({}, 7, words)
    assert [one.effect.name for one in real.selected] == words
    selection, _, remark = compared(real, sim, ())
    assert selection.selected == ()
    assert selection.whole.chosen == ()
    assert remark == "gyro scale: less than poses know of a motion, so not among the findings"
    assert differing(searched(SCALE, 3, words), sim) == words
