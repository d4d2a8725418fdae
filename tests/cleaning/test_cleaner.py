"""What is left is fit for a model, whatever was planted and however the messages were cut into batches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.imu_defects import batch_of, cut, late, pick, repeated, with_values

from imutool.cleaning import Cleaner
from imutool.cleaning.first_pass import Survey, examine
from imutool.cleaning.rule import CleaningSettings, every
from imutool.cleaning.samples import BLOCK, blocks, padded
from imutool.errors import LogError
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.report import json_values
from imutool.sensor.made_up_flight import flight

MADE = batch_of(flight(3, duration_s=30.0).imu)
COUNT = len(MADE.stamp_ns)


def spoiled() -> ImuBatch:
    """Some of everything, also across the borders of the blocks that rules see."""
    rows = [BLOCK - 2, BLOCK - 1, BLOCK, 5000]
    batch = MADE
    for row in (300, BLOCK - 20, BLOCK + 20):
        batch = with_values(batch, row, 1, 9.0, add=True)
    batch = with_values(batch, [40, 41, BLOCK + 60], 5, np.nan)
    batch = with_values(batch, slice(BLOCK - 100, BLOCK - 60), slice(None), np.concatenate([MADE.gyro[0], MADE.accel[0]]))
    stamp_ns = batch.stamp_ns.copy()
    stamp_ns[[100, BLOCK + 100]] += 10**12
    stamp_ns[2000:] -= 30_000_000
    batch = batch._replace(stamp_ns=stamp_ns, accel=batch.accel / 9.80665)
    return repeated(late(batch, rows, 5), [BLOCK + 7, 4500], 40)


SPOILED = spoiled()


def look(batches: list[ImuBatch], rules: CleaningSettings | None = None) -> Survey:
    return examine(lambda: batches, None, rules)


WHOLE = look([SPOILED])


def columns(batches: list[ImuBatch]) -> list[np.ndarray]:
    return [np.concatenate(parts) for parts in zip(*(batch[:6] for batch in batches), strict=True)]


edges = st.lists(st.integers(0, len(SPOILED.stamp_ns)), max_size=12).map(sorted)


@settings(max_examples=25, deadline=None)
@given(edges, edges)
def test_how_messages_are_cut_into_batches_changes_nothing(first_cut, second_cut):
    survey = look(list(cut(SPOILED, first_cut)))
    assert (survey.dropped == WHOLE.dropped).all()
    assert survey.findings == WHOLE.findings
    assert (survey.scale == WHOLE.scale).all()
    clean, at_once = Cleaner(survey), Cleaner(WHOLE)
    parts = columns([clean(part) for part in cut(SPOILED, second_cut)])
    for part, whole in zip(parts, columns([at_once(SPOILED)]), strict=True):
        assert part.tobytes() == whole.tobytes()


def is_sound(batch: ImuBatch) -> bool:
    values = np.concatenate([batch.gyro, batch.accel])
    return bool(np.isfinite(values).all() and (np.diff(batch.stamp_ns) > 0).all())


def test_what_is_left_is_finite_and_in_order_and_as_it_was_but_for_its_unit():
    clean = Cleaner(WHOLE)(SPOILED)
    assert is_sound(clean)
    assert len(clean.stamp_ns) == WHOLE.valid < COUNT
    kept = ~WHOLE.dropped
    for name in ("log_time", "publish_time", "sequence", "stamp_ns", "gyro"):
        assert (getattr(clean, name) == getattr(SPOILED, name)[kept]).all()
    assert clean.accel == pytest.approx(SPOILED.accel[kept] * 9.80665, rel=1e-15)


def test_a_clean_log_passes_bit_for_bit():
    clean = Cleaner(look([MADE]))(MADE)
    for before, after in zip(MADE[:6], clean[:6], strict=True):
        assert before.tobytes() == after.tobytes()


def test_looking_again_at_what_was_cleaned_finds_nothing_to_drop_or_convert():
    again = look([Cleaner(WHOLE)(SPOILED)])
    assert again.valid == again.messages
    assert (again.scale == 1.0).all()
    assert all(one.action == "flagged" for one in again.findings)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_whatever_the_stamps_and_values_what_is_left_is_fit_for_a_model(data):
    """Anything at all in the columns: no warning, no error but for one that says the log cannot be used."""
    n = data.draw(st.integers(0, 300))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    steps = rng.choice([5_000_000, 5_000_000, 0, -3_000_000, 10**15, -(10**15), 10**10], n)
    stamp_ns = 10**18 + np.cumsum(steps)
    odd = np.array([0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324])
    share = data.draw(st.sampled_from([0.0, 0.01, 0.5, 1.0]))
    values = np.where(rng.random((n, 6)) < share, rng.choice(odd, (n, 6)), rng.normal(size=(n, 6)))
    log_ns = np.where(rng.random(n) < share, rng.integers(-(2**63), 2**63 - 1, n), stamp_ns)
    made = ImuBatch(log_ns, log_ns, np.arange(n, dtype=np.uint32), stamp_ns, values[:, :3].copy(), values[:, 3:].copy(), "imu")
    survey = look([made])
    json_values(survey.report())
    assert is_sound(Cleaner(survey)(made))
    assert 0.0 <= survey.score <= 1.0


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 90), min_size=1, max_size=40, unique=True), st.randoms(use_true_random=False))
def test_exactly_what_was_planted_is_dropped_wherever_it_is(places, random):
    """Some sixty samples apart, so that no defect is another's neighbour; the borders of the blocks are among the places."""
    batch, again, dropped = MADE, [], []
    for row in (65 * place for place in sorted(places)):
        kind = random.choice(["nan", "spike", "ahead", "again"])
        if kind == "nan":
            batch = with_values(batch, row, random.randrange(6), np.nan)
        elif kind == "spike":
            batch = with_values(batch, row, 3 + random.randrange(3), random.choice([-90.0, 90.0]), add=True)
        elif kind == "ahead":
            stamp_ns = batch.stamp_ns.copy()
            stamp_ns[row] += 3_600_000_000_000
            batch = batch._replace(stamp_ns=stamp_ns)
        dropped.append(row + len(again) + (kind == "again"))
        again += [row] * (kind == "again")
    survey = look([repeated(batch, again)])
    assert np.flatnonzero(survey.dropped).tolist() == dropped
    assert sum(one.count for one in survey.findings) == len(dropped)


@settings(max_examples=20, deadline=None)
@given(st.sets(st.sampled_from(every())))
def test_any_rule_can_be_left_out_without_a_warning(without_rules):
    survey = look([SPOILED], CleaningSettings(without=tuple(sorted(without_rules))))
    assert not {one.rule for one in survey.findings} & without_rules
    survey.record()


def test_a_log_that_has_grown_meanwhile_is_refused():
    clean = Cleaner(look([pick(MADE, np.arange(100))]))
    clean(pick(MADE, np.arange(60)))
    with pytest.raises(LogError, match="more than the 100 messages"):
        clean(pick(MADE, np.arange(60)))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 900), max_size=30), st.integers(1, 400))
def test_every_sample_is_judged_once_with_its_neighbours(sizes, margin):
    total = sum(sizes)
    parts = list(cut(pick(MADE, np.arange(total) % COUNT), np.cumsum(sizes[:-1]).tolist())) if sizes else []
    stream = [samples for part in parts for samples in blocks([part])]
    at = 0
    numbered = []
    for samples in stream:
        numbered.append(samples._replace(number=np.arange(at, at + len(samples.number))))
        at += len(samples.number)
    judged = []
    for around, core in padded(numbered, margin):
        first, last = around.number[core][0], around.number[core][-1]
        judged += around.number[core].tolist()
        assert (np.diff(around.number) == 1).all()
        assert first - around.number[0] == min(margin, first)
        assert around.number[-1] - last == min(margin, total - 1 - last)
    assert judged == list(range(total))
