"""The first invariant of the project: what is written is what is read, to the last bit."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from imutool.errors import ConfigError, DataError
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Frames, Imu, Poses, Recording, Scalars

LAST_NS = 2**31 * 10**9 - 1
finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
text = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
entries = st.dictionaries(st.one_of(text, st.sampled_from(["name", "source", "writer", "shadowed"])), text, max_size=3)


@st.composite
def times(draw: st.DrawFn) -> np.ndarray:
    count = draw(st.integers(0, 12))
    stamps = draw(st.lists(st.integers(0, LAST_NS), min_size=count, max_size=count, unique=True))
    return np.array(sorted(stamps), np.int64)


def values(draw: st.DrawFn, count: int, width: int) -> np.ndarray:
    return draw(hnp.arrays(np.float64, (count, width), elements=finite))


@st.composite
def quaternions(draw: st.DrawFn, count: int) -> np.ndarray:
    q = draw(hnp.arrays(np.float64, (count, 4), elements=st.floats(-1, 1)))
    q[np.linalg.norm(q, axis=1) < 1e-3] = [1.0, -0.0, 0.0, 0.0]
    # not exactly unit: what a recording accepts must come back as it was
    return q / np.linalg.norm(q, axis=1)[:, None] * draw(st.floats(1 - 9e-7, 1 + 9e-7))


@st.composite
def parts(draw: st.DrawFn) -> dict[str, Any]:
    """What a recording is made of; it is made in the test, because beartype looks at random items when it is."""
    t_ns = draw(times())
    imu = t_ns, values(draw, len(t_ns), 3), values(draw, len(t_ns), 3)
    truths, scalars = {}, {}
    for topic in draw(st.sampled_from([[], ["/ground_truth/pose"], ["/z/pose", "/a/pose"], ["/odd"]])):
        t = draw(times())
        v_w = values(draw, len(t), 3) if draw(st.booleans()) else None
        truths[topic] = t, values(draw, len(t), 3), draw(quaternions(len(t))), v_w
    for topic in draw(st.sampled_from([[], ["/temperature"], ["/z", "/a"]])):
        t = draw(times())
        scalars[topic] = t, values(draw, len(t), draw(st.sampled_from([1, 3]))), draw(text)
    return {
        "name": draw(text),
        "imu": imu,
        "truths": truths,
        "scalars": scalars,
        "metadata": draw(st.dictionaries(st.one_of(text, st.just("imutool")), entries, max_size=3)),
        "imu_topic": draw(st.sampled_from(["/imu0", "/imu0/debiased", "/robot/imu"])),
        "source": draw(text),
    }


def built(parts: dict[str, Any]) -> Recording:
    return Recording(
        **parts
        | {
            "imu": Imu(*parts["imu"]),
            "truths": {topic: Poses(*columns) for topic, columns in parts["truths"].items()},
            "scalars": {topic: Scalars(*columns) for topic, columns in parts["scalars"].items()},
        }
    )


def nothing(**extra: Any) -> dict[str, Any]:
    return {"name": "", "imu": NO_SAMPLES, "truths": {}, "scalars": {}} | extra


NO_SAMPLES = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))
EMPTY = Imu(*NO_SAMPLES)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(parts=parts(), compression=st.sampled_from(["zstd", "lz4", "none"]))
@example(parts=nothing(), compression="zstd")
@example(parts=nothing(metadata={"imutool": {}}), compression="none")
@example(parts=nothing(metadata={"imutool": {"name": "y", "shadowed": "z", "other": ""}}), compression="lz4")
def test_what_is_written_is_read_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, parts: dict[str, Any], compression: str
) -> None:
    recording = built(parts)
    with tempfile.TemporaryDirectory(dir=tmp_path_factory.getbasetemp()) as folder:  # in memory: no example waits for a disk
        path = Path(folder) / "other name.mcap"
        write(recording, path, compression=compression)
        back = read(path)
        assert back == recording
        assert list(back.truths) == list(recording.truths)
        again = Path(folder) / "again.mcap"
        write(back, again, compression=compression)
        assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_long_recording_and_its_images_come_back(recording: Recording, tmp_path: Path, compression: str) -> None:
    path = tmp_path / "log.mcap"
    write(recording, path, compression=compression)
    back = read(path)
    assert back == recording
    (topic,) = recording.frames
    assert (back.frames[topic].format, back.frames[topic].count) == ("png", recording.frames[topic].count)
    for (t_ns, image), (t_back, image_back) in zip(recording.frames[topic].each(), back.frames[topic].each(), strict=True):
        assert (t_ns, image) == (t_back, image_back)


def test_a_time_range_selects_both_ends_included(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(recording, path)
    t_ns = recording.imu.t_ns
    for first, last in itertools.product((0, 1500, 3999), (3999, 1500)):
        start, end = int(t_ns[first]), int(t_ns[last])
        cut = read(path, start_ns=start, end_ns=end)
        assert cut == recording.between(start, end)
        inside = [item for frames in recording.frames.values() for item in frames.each() if start <= item[0] <= end]
        (frames,) = cut.frames.values()
        assert frames.count == len(inside)
        assert list(frames.each()) == inside


def test_chosen_truth_comes_alone(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(recording, path)
    topic = "/ground_truth_recomputed/pose"
    assert read(path, truth=topic) == recording.with_truth(topic)


def test_times_before_1970_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    imu = Imu(np.array([-1, 5]), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(DataError, match="-1 ns"):
        write(Recording("x", imu), tmp_path / "log.mcap")
    frames = Frames("png", 1, lambda: iter([(-5, b"")]))
    with pytest.raises(DataError, match="-5 ns"):
        write(Recording("x", EMPTY, frames={"/cam": frames}), tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []


def test_two_things_on_one_topic_are_refused(tmp_path: Path) -> None:
    scalars = {"/imu0": Scalars(np.array([1]), np.zeros((1, 1)))}
    with pytest.raises(DataError, match="/imu0"):
        write(Recording("x", EMPTY, scalars=scalars), tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_compression_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'bz2'.*none, zstd, lz4"):
        write(Recording("x", EMPTY), tmp_path / "log.mcap", compression="bz2")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_target_is_replaced_only_when_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_text("precious")
    with pytest.raises(ConfigError, match="exists"):
        write(Recording("x", EMPTY), path)
    assert path.read_text() == "precious"
    write(Recording("x", EMPTY), path, overwrite=True)
    with Log(path) as log:
        assert log.imu_topics == ["/imu0"]
    assert list(tmp_path.iterdir()) == [path]
