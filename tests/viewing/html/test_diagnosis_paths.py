"""Unseen stretches integrated without and with what was found: closed forms, and nothing drawn where nothing is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import diagnoses

from imutool.diagnosis.result import Traces
from imutool.recording import Poses
from imutool.viewing.html.diagnosis_paths import MAX_S, held_out_stretches, paths, rms_drift

RATE_HZ, SECONDS = 100.0, 40.0
TURN_RAD_S, PUSH_M_S2 = 0.01, 0.2  # what is left out of a sensor at rest
STEP = 2.0 / RATE_HZ  # Euler's rule is half a step late; between two rows of the drift's clock lies another


def at_rest() -> Traces:
    """A sensor at rest that reads a turn about z and a push along x too much, which is found; a middle is unseen."""
    t = np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ
    ideal = np.zeros((len(t), 6))
    ideal[:, 5] = 9.81
    there = ideal.copy()
    there[:, 2] += TURN_RAD_S
    there[:, 3] += PUSH_M_S2
    zeros, upright = np.zeros((len(t), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    truth = Poses(np.round(t * 1e9).astype(np.int64), zeros, upright, zeros)
    return Traces("rest", t, there, ideal, there, (t >= 10.0) & (t < 18.0), truth, ideal)


def test_what_is_left_out_drifts_as_it_must_and_what_is_modelled_does_not() -> None:
    found = list(held_out_stretches(at_rest()))
    assert len(found) == 1
    t_s, before = rms_drift(found, 1)
    assert t_s[-1] == pytest.approx(8.0, abs=0.1)
    assert before[:, 0] == pytest.approx(np.degrees(TURN_RAD_S) * t_s, abs=1e-6)
    assert before[:, 1] == pytest.approx(0.5 * PUSH_M_S2 * t_s**2, abs=PUSH_M_S2 * 8.0 * STEP)
    assert np.abs(rms_drift(found, 2)[1]).max() < 1e-9


def test_a_long_stretch_is_cut_and_a_gap_is_never_crossed() -> None:
    trace = replace(at_rest(), held_out=np.ones(int(SECONDS * RATE_HZ), bool))
    assert [one.truth.duration_s for one in held_out_stretches(trace)] == pytest.approx([MAX_S] * 4, abs=0.02)
    ideal = trace.ideal.copy()
    ideal[500:600] = np.nan
    assert all(
        one.truth.t_ns[-1] <= 5 * 10**9 or one.truth.t_ns[0] >= 6 * 10**9
        for one in held_out_stretches(replace(trace, ideal=ideal))
    )


def test_paths_are_drawn_where_poses_are_known_and_something_was_found() -> None:
    assert paths(diagnoses.BOTH) is not None
    assert paths(replace(diagnoses.BOTH, findings=())) is None
    assert paths(replace(diagnoses.BOTH, traces=tuple(replace(trace, truth=None) for trace in diagnoses.BOTH.traces))) is None
