"""Arrays of a recording are checked when made, never change, compare bit for bit, and keep integer time exact."""

from __future__ import annotations

import ast
import inspect
import pickle
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import MISSING, FrozenInstanceError, fields, replace
from datetime import UTC, datetime
from fractions import Fraction
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imutool.errors import DataError
from imutool.recording import Frames, Imu, Poses, Recording, Scalars, nanoseconds, seconds, unit_quaternions
from imutool.recording.columns import median, quantile

EPOCH_NS = 1_403_638_128_245_096_960  # in EuRoC's MH_04
SECONDS = 2.0**-52  # relative: one rounding of the difference, one of the product
SLERP_RAD = 1e-14


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    q = rng.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1)[:, None]


def make_imu(n: int = 20, seed: int = 0) -> Imu:
    rng = np.random.default_rng(seed)
    return Imu(EPOCH_NS + 5_000_000 * np.arange(n), rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))


def make_poses(n: int = 20, *, moving: bool = True) -> Poses:
    rng = np.random.default_rng(1)
    v_w = rng.normal(size=(n, 3)) if moving else None
    return Poses(EPOCH_NS + 10_000_000 * np.arange(n), rng.normal(size=(n, 3)), unit(rng, n), v_w)


def make_recording() -> Recording:
    imu, poses = make_imu(), make_poses()
    temperature = Scalars(imu.t_ns[::4], np.arange(5.0)[:, None], "degC")
    return Recording("r", imu, {"/a": poses, "/b": make_poses(5)}, {"/t": temperature}, metadata={"m": {"k": "v"}}, source="s")


# ── time ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


@given(st.lists(st.integers(-(10**12), 10**12), min_size=1, max_size=20), st.integers(0, 2**62))
def test_seconds_are_exact_to_a_rounding_at_any_epoch(offsets: list[int], start_ns: int) -> None:
    t_ns = start_ns + np.array(offsets, dtype=np.int64)
    for found, offset in zip(seconds(t_ns, start_ns), offsets, strict=True):
        exact = Fraction(offset, 10**9)
        assert abs(Fraction(float(found)) - exact) <= abs(exact) * Fraction(SECONDS) * 2


def test_seconds_do_what_float_seconds_of_an_epoch_cannot() -> None:
    t_ns = EPOCH_NS + np.arange(3, dtype=np.int64)
    np.testing.assert_allclose(seconds(t_ns, EPOCH_NS), [0.0, 1e-9, 2e-9], rtol=SECONDS * 2)
    naive = t_ns.astype(np.float64) * 1e-9 - EPOCH_NS * 1e-9
    assert np.abs(naive - [0.0, 1e-9, 2e-9]).max() > 1e-10  # 256 ns are one float apart there


@given(st.integers(0, 10**15))
def test_nanoseconds_are_the_inverse_of_seconds(n: int) -> None:
    assert nanoseconds(float(seconds(np.array([n]), 0)[0])) == n


# ── what may be in it ────────────────────────────────────────────────────────────────────────────────────────────────


def with_value(array: np.ndarray, row: int, value: float) -> np.ndarray:
    changed = array.copy()
    changed[row, 1] = value
    return changed


T = EPOCH_NS + np.arange(4, dtype=np.int64)
V = np.arange(12.0).reshape(4, 3)
Q = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Imu(T, with_value(V, 2, np.nan), V), r"Imu.gyro row 2 is \[6.0, nan, 8.0\]; expected finite .* Leave such"),
        (lambda: Imu(T, V, with_value(V, 3, -np.inf)), r"Imu.accel row 3 is \[9.0, -inf, 11.0\]"),
        (lambda: Imu(T[[0, 2, 1, 3]], V, V), rf"Imu time goes from {T[2]} to {T[1]} ns at row 2; expected strictly increasing"),
        (lambda: Imu(T[[0, 1, 1, 3]], V, V), r"at row 2"),
        (lambda: Poses(T, V, 1.1 * Q), r"Poses.q_wb_wxyz row 0 is \[1.1, 0.0, 0.0, 0.0\]; expected norm 1"),
        (lambda: Poses(T, V, 0.0 * Q), r"expected norm 1"),
        (lambda: Poses(T, V, Q, with_value(V, 1, np.nan)), r"Poses.v_w row 1"),
        (lambda: Scalars(T, with_value(V, 0, np.nan)), r"Scalars.values row 0"),
        (lambda: Scalars(T, V[:, :2]), r"Scalars.values is \[4, 2\]; expected \[n, 1\] or \[n, 3\]"),
    ],
)
def test_what_no_sensor_gives_is_refused_with_its_row(build: Callable[[], object], message: str) -> None:
    with pytest.raises(DataError, match=message):
        build()


def unchecked(kind: type, *columns: Any) -> Any:
    """A dataclass made as users make it: without the hook that checks annotations in these tests."""
    made = object.__new__(kind)
    for number, field in enumerate(fields(kind)):
        default = field.default if field.default_factory is MISSING else field.default_factory()
        object.__setattr__(made, field.name, columns[number] if number < len(columns) else default)
    made.__post_init__()
    return made


@pytest.mark.parametrize(
    ("kind", "columns", "message"),
    [
        (Imu, (T, V[:3], V), r"Imu.gyro is float64\[3, 3\]; expected float64\[4, 3\]"),
        (Imu, (T * 1e-9, V, V), r"Imu.t_ns is float64\[4\]; expected int64\[n\]. Convert seconds with np.round"),
        (Imu, (T, V[:, :2], V), r"expected float64\[4, 3\]"),
        (Imu, (T, V, None), "Imu.accel is of type NoneType"),
        (Imu, (None, V, V), "Imu.t_ns is of type NoneType"),
        (Imu, (T, [[0.0], [0.0, 1.0]], V), "Imu.gyro is of type list"),
        (Imu, (T, np.ma.masked_greater(V, 9.0), V), "Imu.gyro is .* with masked values"),
        (Imu, (np.array(["2026", "NaT", "2027", "2028"], "datetime64[s]"), V, V), r"Imu.t_ns is datetime64\[s\]"),
        (Imu, (T.astype(np.uint64) + np.uint64(2**63), V, V), r"Imu.t_ns is uint64\[4\]; expected int64"),
        (Imu, (np.array(["3026", "3027", "3028", "3029"], "datetime64[s]"), V, V), r"Imu.t_ns is datetime64\[s\]"),
        (Imu, (T, np.full((4, 3), 2**53 + 1), V), r"Imu.gyro is int64\[4, 3\]; expected float64"),
        (Imu, ([datetime.fromtimestamp(k, UTC) for k in range(4)], V, V), r"of type list; .* the time zone off"),
        (Imu, ([datetime.fromtimestamp(k) for k in range(4)], V, V), r"of type list; .* np.asarray"),
        (Imu, (T, torch.zeros(4, 3, requires_grad=True), V), r"Imu.gyro is of type Tensor; .* Use tensor.detach"),
        (Recording, ("r", make_imu(), {1: Poses(T, V, Q)}), "Recording.truths holds a name of type int; expected str"),
        (Poses, (T, V, Q[:, :3]), r"expected float64\[4, 4\]"),
        (Poses, (T, V, Q, V[:, :2]), "Poses.v_w"),
        (Scalars, (T, V[:3], ""), r"Scalars.values is float64\[3, 3\]"),
        (Recording, (V, make_imu()), "Recording.name is of type ndarray; expected str"),
        (Recording, ("r", V), "Recording.imu is of type ndarray; expected Imu"),
        (
            Recording,
            ("r", make_imu(), Poses(T, V, Q)),
            "Recording.truths is of type Poses; expected a mapping from names to Poses",
        ),
        (Recording, ("r", make_imu(), {"/a": V}), "Recording.truths holds a value of type ndarray; expected Poses"),
        (
            Recording,
            ("r", make_imu(), {}, {}, {}, {"a": {"b": 3}}),
            "Recording.metadata holds a value of type int; expected str",
        ),
    ],
)
def test_wrong_shapes_and_types_are_refused_without_the_type_checker_too(
    kind: type, columns: tuple[Any, ...], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        unchecked(kind, *columns)


@pytest.mark.parametrize(
    ("t_ns", "gyro"),
    [
        (T.tolist(), V.tolist()),
        (T.astype(np.uint64), V.astype(np.float32)),
        (T.astype(">i8"), V.astype(">f8")),
        (T.astype("datetime64[ns]"), V.astype(np.int16)),
        (T.astype("timedelta64[ns]"), V),
        (T, np.ma.masked_greater(V, 99.0)),
        (T.astype(object), V.astype(object)),
        (T, torch.from_numpy(V.copy())),
    ],
    ids=["lists", "smaller", "byte order", "dates", "durations", "nothing masked", "objects", "tensor"],
)
def test_what_converts_without_loss_is_taken(t_ns: Any, gyro: Any) -> None:
    assert unchecked(Imu, t_ns, gyro, V) == Imu(T, V, V)


@pytest.mark.parametrize("kind", [Imu, Poses, Scalars])
def test_type_checkers_know_that_lists_are_taken(kind: type) -> None:
    defined = [node for node in ast.walk(ast.parse(inspect.getsource(kind))) if isinstance(node, ast.FunctionDef)]
    (known,) = [node.args for node in defined if node.name == "__init__"]
    assert [each.arg for each in known.args[1:]] == list(inspect.signature(kind).parameters)
    arrays = [ast.unparse(each.annotation) for each in known.args if each.annotation and each.arg != "unit"]
    assert {text.split(" | ")[0] for text in arrays} == {"ArrayLike"}


def test_a_column_of_numbers_is_a_scalar() -> None:
    assert unchecked(Scalars, T, V[:, 0], "K") == Scalars(T, V[:, :1], "K")


def test_nothing_at_all_is_a_recording_too() -> None:
    empty = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    assert (len(empty), empty.duration_s) == (0, 0.0)
    for few in (empty, make_imu(1)):
        with pytest.raises(DataError, match=f"Imu has {len(few)} rows; expected at least 2"):
            _ = few.period_s


# ── it never changes ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_arrays_are_the_recordings_own_and_cannot_be_written() -> None:
    t_ns, gyro, accel = EPOCH_NS + np.arange(4), V.copy(), V.copy()
    imu = Imu(t_ns, gyro, accel)
    gyro[0] = 99.0
    t_ns[0] = 0
    assert imu.gyro[0, 0] == 0.0
    assert imu.t_ns[0] == EPOCH_NS
    for column in (imu.t_ns, imu.gyro, imu.accel):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 0
    with pytest.raises(FrozenInstanceError):
        imu.gyro = V  # type: ignore[misc]


def test_a_read_only_view_of_somebodys_array_is_copied() -> None:
    """The view cannot be written, what it looks at can."""
    gyro = V.copy()
    view = gyro.view()
    view.flags.writeable = False
    imu = Imu(T, view, view[:])
    gyro[:] = 99.0
    assert imu.gyro[0, 0] == imu.accel[0, 0] == 0.0


def test_slices_share_memory_and_are_as_fixed() -> None:
    imu = make_imu()
    part = imu.rows(slice(3, 9))
    assert np.shares_memory(part.gyro, imu.gyro)
    with pytest.raises(ValueError, match="read-only"):
        part.gyro[0] = 0


def test_mappings_of_a_recording_cannot_be_changed() -> None:
    recording, poses = make_recording(), {"/p": make_poses()}
    other = Recording("x", make_imu(), poses)
    poses["/q"] = make_poses()
    assert list(other.truths) == ["/p"]
    for mapping in (recording.truths, recording.scalars, recording.frames, recording.metadata, recording.metadata["m"]):
        with pytest.raises(TypeError):
            mapping["new"] = 1  # type: ignore[index]


# ── equality ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_equality_is_that_of_bits() -> None:
    imu = make_imu()
    assert imu == make_imu()
    flipped = imu.gyro.copy()
    flipped.view(np.uint64)[7, 1] ^= 1
    assert imu != Imu(imu.t_ns, flipped, imu.accel)
    zero, minus = np.zeros((4, 3)), -np.zeros((4, 3))
    assert Imu(T, zero, zero) != Imu(T, minus, zero)
    assert Poses(T, V, Q) != Poses(T, V, Q, V)
    assert Poses(T, V, Q) != Poses(T, V, -Q)  # the same rotations, other bits
    assert imu != make_poses()
    assert Scalars(T, V, "T") != Scalars(T, V, "uT")
    with pytest.raises(TypeError):
        hash(imu)


@pytest.mark.parametrize(
    "change",
    [
        {"name": "other"},
        {"source": "other"},
        {"imu_topic": "/imu1"},
        {"truths": {}},
        {"scalars": {}},
        {"metadata": {"m": {"k": "w"}}},
        {"imu": make_imu(seed=1)},
    ],
)
def test_recordings_differ_in_any_part_but_their_frames(change: dict[str, Any]) -> None:
    recording = make_recording()
    assert recording == make_recording()
    assert recording != replace(recording, **change)
    assert recording == replace(recording, frames={"/cam": Frames("png", 1, lambda: iter([]))})


# ── across processes ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_it_pickles_bit_for_bit_and_stays_fixed() -> None:
    recording = make_recording()
    back = pickle.loads(pickle.dumps(recording))
    assert back == recording
    for column in (back.imu.gyro, back.imu.t_ns, back.truth.q_wb_wxyz, back.scalars["/t"].values):
        assert not column.flags.writeable
    with pytest.raises(TypeError):
        back.truths["/new"] = recording.truth


def mirror(recording: Recording) -> tuple[Recording, bool]:
    return recording, recording.imu.gyro.flags.writeable


def test_it_crosses_to_another_process_and_back() -> None:
    recording = make_recording()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        back, writeable = pool.submit(mirror, recording).result(timeout=120)
    assert back == recording
    assert not writeable


# ── slicing ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@given(st.integers(-5, 25), st.integers(-5, 25), st.integers(-2, 2), st.integers(-2, 2))
def test_between_is_both_ends_included(first: int, last: int, before: int, after: int) -> None:
    imu = make_imu()
    start, end = (EPOCH_NS + 5_000_000 * k + off for k, off in ((first, before), (last, after)))
    np.testing.assert_array_equal(imu.between(start, end).t_ns, imu.t_ns[(imu.t_ns >= start) & (imu.t_ns <= end)])


def test_seconds_are_no_times_of_a_cut() -> None:
    """Of an epoch in float nanoseconds the ends would be 128 ns off, and of seconds nothing would be left."""
    for start in (0.5, float(EPOCH_NS), None):
        with pytest.raises(DataError, match=r"start_ns is .*; expected integer nanoseconds"):
            make_imu().between(start, EPOCH_NS)  # type: ignore[arg-type]


def test_rows_by_slice_and_by_mask() -> None:
    poses = make_poses()
    mask = np.arange(20) % 3 == 0
    assert poses.rows(mask) == poses.rows(slice(0, 20, 3))
    bare: Poses = make_poses(moving=False).rows(mask)
    assert bare.v_w is None


def test_period_and_duration() -> None:
    jittered = Imu(np.cumsum([0, 5, 5, 5, 50, 5, 5]).astype(np.int64) * 1_000_000, np.zeros((7, 3)), np.zeros((7, 3)))
    assert jittered.period_s == pytest.approx(5e-3)  # the median: one hole does not count
    assert jittered.duration_s == pytest.approx(75e-3)


def test_cutting_a_recording_cuts_everything() -> None:
    recording = make_recording()
    start, end = EPOCH_NS + 20_000_000, EPOCH_NS + 70_000_000
    cut = recording.between(start, end)
    assert (cut.imu, cut.truth) == (recording.imu.between(start, end), recording.truth.between(start, end))
    assert cut.scalars["/t"] == recording.scalars["/t"].between(start, end)
    assert (cut.name, cut.metadata, cut.source) == (recording.name, recording.metadata, recording.source)


def test_the_overlap_is_where_both_are() -> None:
    imu = make_imu(200)
    poses = make_poses(20)  # 190 ms of the IMU's 995
    early, late = (replace_times(poses, shift_ns) for shift_ns in (-100_000_000, 900_000_000))
    for truth, start, end in (
        (poses, EPOCH_NS, EPOCH_NS + 190_000_000),
        (early, EPOCH_NS, EPOCH_NS + 90_000_000),
        (late, EPOCH_NS + 900_000_000, EPOCH_NS + 995_000_000),
    ):
        both = Recording("r", imu, {"/t": truth}).overlap()
        assert both.imu == imu.between(start, end)
        assert both.truth == truth.between(start, end)


def replace_times(poses: Poses, shift_ns: int) -> Poses:
    return replace(poses, t_ns=poses.t_ns + shift_ns)


def test_no_overlap_and_no_truth_are_said() -> None:
    imu, poses = make_imu(), make_poses()
    with pytest.raises(DataError, match="r: no true poses; expected a pose topic in the log"):
        Recording("r", imu).overlap()
    for shift_ns in (10**9, -(10**9)):
        with pytest.raises(DataError, match="r: IMU and true poses share no time"):
            Recording("r", imu, {"/t": replace_times(poses, shift_ns)}).overlap()
    with pytest.raises(DataError, match="r: IMU and true poses share fewer than two samples"):
        Recording("r", imu, {"/t": replace_times(poses, 90_000_000)}).overlap()


def test_one_truth_of_several() -> None:
    recording = make_recording()
    assert recording.truth is recording.truths["/a"]
    assert list(recording.with_truth("/b").truths) == ["/b"]
    with pytest.raises(DataError, match="r: no true poses on /c; expected one of /a, /b"):
        recording.with_truth("/c")
    with pytest.raises(DataError, match=r"expected one of \(none\)"):
        Recording("r", make_imu()).with_truth("/c")


# ── poses between poses ──────────────────────────────────────────────────────────────────────────────────────────────


def test_a_steady_turn_is_interpolated_exactly() -> None:
    axis = np.array([0.3, -0.5, 0.8])
    t = np.arange(11) * 0.01
    poses = Poses(
        EPOCH_NS + np.round(t * 1e9).astype(np.int64),
        t[:, None] * np.array([1.0, 2.0, 3.0]),
        Rotation.from_rotvec(t[:, None] * axis).as_quat(scalar_first=True),
        t[:, None] * np.array([-1.0, 0.0, 5.0]),
    )
    wanted_ns = EPOCH_NS + np.arange(0, 100_000_001, 1_234_567)
    found, valid = poses.at(wanted_ns)
    s = seconds(wanted_ns, EPOCH_NS)[:, None]
    assert valid.all()
    turn = Rotation.from_rotvec(s * axis).inv() * Rotation.from_quat(found.q_wb_wxyz, scalar_first=True)
    assert turn.magnitude().max() < SLERP_RAD
    np.testing.assert_allclose(found.p_wb, s * [1.0, 2.0, 3.0], rtol=0, atol=1e-15)
    assert found.v_w is not None
    np.testing.assert_allclose(found.v_w, s * [-1.0, 0.0, 5.0], rtol=0, atol=1e-15)


def test_the_shorter_arc_is_taken_whatever_the_signs() -> None:
    """q and -q are one rotation: half-way between 10 and 30 degrees is 20, not 200."""
    q = Rotation.from_euler("z", [[10.0], [30.0]], degrees=True).as_quat(scalar_first=True)
    for signs in ((1, 1), (1, -1), (-1, 1)):
        poses = Poses(EPOCH_NS + np.array([0, 10_000_000]), np.zeros((2, 3)), q * np.array(signs)[:, None])
        found, _ = poses.at(np.array([EPOCH_NS + 5_000_000]))
        angle = Rotation.from_quat(found.q_wb_wxyz, scalar_first=True).magnitude()
        assert np.degrees(angle[0]) == pytest.approx(20.0, abs=1e-9)


def test_at_a_pose_it_is_that_pose() -> None:
    poses = make_poses()
    found, valid = poses.at(poses.t_ns)
    assert valid.all()
    np.testing.assert_array_equal(found.p_wb, poses.p_wb)
    turn = Rotation.from_quat(found.q_wb_wxyz, scalar_first=True).inv() * Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True)
    assert turn.magnitude().max() < SLERP_RAD


def test_the_mask_is_false_outside_and_inside_gaps_and_true_at_their_edges() -> None:
    poses = make_poses(100)  # every 10 ms
    holed: Poses = poses.rows((np.arange(100) < 30) | (np.arange(100) >= 50))  # the last pose before at 290 ms, the next at 500
    ms = np.array([-10, -0.001, 0, 5, 290, 290.001, 400, 499.999, 500, 505, 990, 990.001, 2000])
    wanted_ns = EPOCH_NS + np.round(ms * 1e6).astype(np.int64)
    found, valid = holed.at(wanted_ns)
    assert valid.tolist() == [False, False, True, True, True, False, False, False, True, True, True, False, False]
    assert len(found) == len(wanted_ns)  # masked rows are valid poses all the same
    np.testing.assert_allclose(np.linalg.norm(found.q_wb_wxyz, axis=1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(found.p_wb[[0, -1]], holed.p_wb[[0, -1]])  # before and after: the nearest


@pytest.mark.parametrize(("missing", "gap"), [(6, False), (8, True)])
def test_a_gap_is_80_ms_or_four_periods(missing: int, gap: bool) -> None:
    poses = make_poses(60)
    holed: Poses = poses.rows((np.arange(60) < 20) | (np.arange(60) >= 20 + missing))
    _, valid = holed.at(np.array([EPOCH_NS + 205_000_000]))
    assert valid[0] == (not gap)
    slow = replace(holed, t_ns=EPOCH_NS + (holed.t_ns - EPOCH_NS) * 5)  # 20 Hz: four periods are 200 ms
    _, valid = slow.at(np.array([EPOCH_NS + 5 * 205_000_000]))
    assert not valid[0]
    assert holed.at(np.array([EPOCH_NS + 205_000_000]), max_gap_s=1.0)[1][0]
    assert not holed.at(np.array([EPOCH_NS + 5_000_000]), max_gap_s=0.005)[1][0]


@pytest.mark.parametrize("max_gap_s", [None, 1.0])
@pytest.mark.parametrize("count", [0, 1])
def test_one_pose_is_no_path(count: int, max_gap_s: float | None) -> None:
    with pytest.raises(DataError, match=f"Poses has {count} rows; expected at least 2"):
        make_poses(2).rows(slice(0, count)).at(np.array([EPOCH_NS]), max_gap_s)


def test_no_gap_is_longer_than_infinity() -> None:
    poses = make_poses(100)
    assert poses.rows((np.arange(100) < 30) | (np.arange(100) >= 50)).at(poses.t_ns, float("inf"))[1].all()


def test_quaternions_are_made_unit_where_they_are_not_and_refused_where_they_are_none() -> None:
    rng = np.random.default_rng(3)
    q = unit(rng, 50)
    np.testing.assert_array_equal(unit_quaternions(q), q)
    rounded = np.round(q, 4)
    fixed = unit_quaternions(rounded)
    np.testing.assert_allclose(np.linalg.norm(fixed, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(fixed, q, atol=1e-4)
    for bad in (0.0, 1.5, np.nan):
        spoiled = q.copy()
        spoiled[7] *= bad
        with pytest.raises(DataError, match=r"in row 7 has norm .*; expected norm 1"):
            unit_quaternions(spoiled)


def test_a_recording_prints_a_line_for_each_topic_and_no_array() -> None:
    recording = replace(
        make_recording(), other_poses={"/odom": "odometry"}, frames={"/cam": Frames("png", 3, lambda: iter(()))}
    )
    assert repr(recording).splitlines() == [
        "Recording 'r'",
        "  /imu0: Imu(20 rows at 200 Hz, 0.095 s; gyro [20, 3], accel [20, 3])",
        "  /a: Poses(20 rows at 100 Hz, 0.190 s; p_wb [20, 3], q_wb_wxyz [20, 4], v_w [20, 3])",
        "  /b: Poses(5 rows at 100 Hz, 0.040 s; p_wb [5, 3], q_wb_wxyz [5, 4], v_w [5, 3])",
        "  /t: Scalars(5 rows at 50 Hz, 0.080 s; values [5, 1])",
        "  /cam: 3 frames, png",
        "  /odom: poses (odometry), not read",
    ]
    assert repr(make_imu(1)) == "Imu(1 rows, 0.000 s; gyro [1, 3], accel [1, 3])"


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_a_quantile_is_that_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3))
    for share in (0.0, 0.25, 0.5, 0.9, 1.0):
        np.testing.assert_allclose(quantile(values, share), np.quantile(values, share, axis=0), rtol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 3, 100])
def test_a_median_is_that_of_numpy(count: int) -> None:
    values = np.random.default_rng(1).normal(size=(count, 3))
    for table in (values, (1e9 * values).astype(np.int64)):
        np.testing.assert_array_equal(median(table), np.median(table, axis=0))
        np.testing.assert_array_equal(median(table.T, axis=1), np.median(table, axis=0))


def test_positions_that_are_zero_while_the_body_turns_are_none() -> None:
    q = unit(np.random.default_rng(0), 5)
    t_ns, still = np.arange(5), np.tile(q[:1], (5, 1))
    assert not Poses(t_ns, np.zeros((5, 3)), q).has_positions
    assert Poses(t_ns, np.ones((5, 3)), q).has_positions
    assert Poses(t_ns, np.zeros((5, 3)), q, np.ones((5, 3))).has_positions
    assert Poses(t_ns, np.zeros((5, 3)), still).has_positions, "it rests at the origin"
    begins = np.array([[np.cos(half), np.sin(half), 0.0, 0.0] for half in np.linspace(0.0, 0.04, 5)])
    assert Poses(t_ns, np.zeros((5, 3)), begins).has_positions, "it is about to leave the origin"
