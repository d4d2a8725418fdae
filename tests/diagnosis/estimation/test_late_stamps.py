"""Stamps that jitter are told from samples that do, without any poses."""

from __future__ import annotations

import numpy as np
import pytest
from support import planted

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.timestamps import late_stamps

FELT = planted.rich()
INNER = slice(5, -5)


def stamped(late_s: np.ndarray, taken_late: bool) -> Pair:
    """Samples of a flight whose stamps are late, taken then or at even times."""
    stamp_s = FELT.t_s[INNER] + late_s[INNER]
    pair: Pair = planted.pair(FELT, stamp_s=stamp_s)
    if taken_late:
        return pair
    even = planted.ideal(FELT)[INNER] + planted.noise(len(stamp_s), 3) + planted.BIAS
    return Pair(pair.name, stamp_s, even, pair.fitted, pair.held_out, ideal=FELT)


def jittering(std_s: float, seed: int) -> np.ndarray:
    return std_s * np.random.default_rng(seed).uniform(-1.7, 1.7, len(FELT.t_s))


@pytest.mark.parametrize("seed", range(3))
def test_stamps_that_jitter_while_samples_do_not_are_told_by_how_much(seed: int) -> None:
    late = jittering(1e-3, seed)
    (found,) = late_stamps([stamped(late, taken_late=False)])
    assert found.effect == "timestamp_jitter"
    assert found.p_value < 1e-6
    assert found.parameters["std"].value == pytest.approx(late[INNER].std(), rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_samples_that_were_taken_when_their_stamps_say_are_no_finding(seed: int) -> None:
    assert late_stamps([stamped(jittering(1e-3, seed), taken_late=True)]) == []


def test_even_stamps_are_no_finding() -> None:
    assert late_stamps([stamped(np.zeros(len(FELT.t_s)), taken_late=False)]) == []


def test_a_body_at_rest_cannot_tell() -> None:
    still = stamped(jittering(1e-3, 0), taken_late=False)
    at_rest = Pair("rest", still.stamp_s, planted.noise(len(still.stamp_s), 4), still.fitted, still.held_out, ideal=FELT)
    assert late_stamps([at_rest]) == []
