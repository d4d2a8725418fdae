"""What a recording and its simulation share, as robots log it: joints by name, gaps, units, other namespaces."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from scipy.signal import lfilter
from support.robot_cases.log import write

from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.ideal_signal import SignalPair, motion
from imutool.diagnosis.signals.lag import is_copy, lag_at_first_sight
from imutool.diagnosis.signals.pairing import Pairing, paired
from imutool.diagnosis.signals.quantities import in_one_unit
from imutool.diagnosis.signals.signal_constants import current_remark
from imutool.errors import DataError
from imutool.inertial.correlation import time_ahead_s
from imutool.mcap_io.fields import Fields

JOINTS, NUMBER, ODOMETRY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "nav_msgs/msg/Odometry"
T = np.arange(2000) / 100.0
EXACT = 1e-12


def wave(seed: int, t: np.ndarray = T) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(np.sin(np.outer(t, rng.uniform(0.5, 4.0, 6)) + rng.uniform(0.0, 6.0, 6)).sum(axis=1))


def joints(*positions: np.ndarray, effort: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Rows of positions, velocities and efforts."""
    speeds = [np.gradient(q, T) for q in positions]
    return np.stack([*positions, *speeds, *(effort or np.zeros((len(positions), len(T))))], axis=1)


def of_two(real: tuple[np.ndarray, np.ndarray], sim: tuple[np.ndarray, np.ndarray]) -> SignalPair:
    """Columns of two logs by their times (s)."""
    real_ns, sim_ns = (np.round(t_s * 1e9).astype(np.int64) for t_s, _ in (real, sim))
    names = tuple(f"/x.{k}" for k in range(real[1].shape[1]))
    return SignalPair("/x", names, ("",) * len(names), real_ns, real[1], sim_ns, sim[1])


def logged(
    folder: Path, real: dict[str, object], sim: dict[str, object], names: Sequence[str], others: Sequence[str]
) -> Pairing:
    write(folder / "real.mcap", real, names)  # type: ignore[arg-type]  # topics as `write` takes them
    write(folder / "sim.mcap", sim, others)  # type: ignore[arg-type]  # as above
    return paired(folder / "real.mcap", folder / "sim.mcap")


def test_a_joint_of_one_log_alone_is_left_out_and_the_others_are_paired_by_name(tmp_path: Path) -> None:
    """A gripper that the simulation lacks moves no other joint to its place."""
    hip, knee = wave(1), wave(2)
    real = {"/joint_states": (JOINTS, T, joints(wave(3), hip, knee))}
    sim = {"/joint_states": (JOINTS, T, joints(1.1 * knee, 1.1 * hip))}
    pairing = logged(tmp_path, real, sim, ("finger", "hip", "knee"), ("knee", "hip"))
    positions = {pair.name: pair.sim[:, 0] for pair in pairing.pairs if "position" in pair.name}
    assert set(positions) == {"/joint_states.position[1]", "/joint_states.position[2]"}
    assert np.allclose(positions["/joint_states.position[1]"], 1.1 * hip, atol=EXACT)
    assert np.allclose(positions["/joint_states.position[2]"], 1.1 * knee, atol=EXACT)
    assert "Joints of /joint_states: [0] finger, [1] hip, [2] knee" in pairing.remarks
    assert any("Only the recording has the joints finger" in remark for remark in pairing.remarks)


@pytest.mark.parametrize(
    ("name", "compared"),
    [("central", False), ("backward", False), ("half as large", True), ("filtered", True), ("alone", True)],
)
def test_a_velocity_is_compared_unless_it_is_the_rate_of_a_position_that_is(name: str, compared: bool, tmp_path: Path) -> None:
    hip = wave(1) + 1e-4 * np.random.default_rng(0).normal(size=len(T))
    rate = np.gradient(hip, T)
    speed = {
        "central": rate,
        "backward": np.append(0.0, np.diff(hip) / 0.01),
        "half as large": 0.5 * rate,
        "filtered": lfilter([0.05], [1.0, -0.95], rate),
        "alone": rate,
    }[name]
    position = np.full(len(T), np.nan) if name == "alone" else hip
    real = {"/joint_states": (JOINTS, T, np.stack([position, speed, np.zeros(len(T))], axis=1))}
    sim = {"/joint_states": (JOINTS, T, joints(1.1 * wave(1)))}
    pairing = logged(tmp_path, real, sim, ("hip",), ("hip",))
    names = {pair.name for pair in pairing.pairs}
    assert ("/joint_states.velocity[0]" in names) == compared
    assert ("/joint_states.position[0]" in names) == (name != "alone")
    told = "The rates of recorded positions, which are compared: /joint_states.velocity[0]"
    assert (told in pairing.remarks) == (not compared)


@pytest.mark.parametrize("effort", [0.0, np.nan])
def test_a_gripper_without_effort_leaves_the_arm_its_efforts(effort: float, tmp_path: Path) -> None:
    hip, finger = wave(1), 0.04 + 0.01 * np.sign(wave(2))
    rows = joints(hip, finger, effort=(wave(3), np.full(len(T), effort)))
    sim = joints(wave(5), finger, effort=(wave(4), np.zeros(len(T))))
    topic = "/joint_states"
    pairing = logged(tmp_path, {topic: (JOINTS, T, rows)}, {topic: (JOINTS, T, sim)}, ("hip", "finger"), ("hip", "finger"))
    (efforts,) = (pair for pair in pairing.pairs if pair.kind == "efforts")
    assert efforts.names == ("/joint_states.effort[0]",)
    assert set(efforts.state) == {"q0", "dq0"}


def test_wheels_are_paired_by_name_and_a_caster_is_no_wheel(tmp_path: Path) -> None:
    left, right = 5.0 + wave(1), 5.0 + wave(2)
    still = np.zeros((len(T), 13))

    def odometry(forward: np.ndarray, turn: np.ndarray) -> np.ndarray:
        rows = still.copy()
        rows[:, 6], rows[:, 7], rows[:, 12] = 1.0, forward, turn
        return rows

    def rows(*speeds: np.ndarray) -> np.ndarray:
        turned = [np.cumsum(speed) * 0.01 for speed in speeds]
        return np.stack([*turned, *speeds, *np.zeros((len(speeds), len(T)))], axis=1)

    moved = odometry(0.05 * (left + right), 0.2 * (right - left))
    real = {"/odom": (ODOMETRY, T, moved), "/joint_states": (JOINTS, T, rows(wave(4), left, right))}
    simulated = odometry(0.05 * (left + right) + 1e-6 * wave(6), 0.2 * (right - left))
    sim = {"/odom": (ODOMETRY, T, simulated), "/joint_states": (JOINTS, T, rows(1.001 * right, 1.001 * left, wave(5)))}
    pairing = logged(tmp_path, real, sim, ("caster", "left", "right"), ("right", "left", "caster"))
    (wheels,) = (pair for pair in pairing.pairs if pair.kind == "wheels")
    assert set(wheels.state) == {"w0", "w1"}
    assert np.allclose(wheels.state["w0"].values, left)
    assert np.allclose(wheels.sim_state["w0"].values, 1.001 * left)


def test_readings_without_a_number_are_gaps(tmp_path: Path) -> None:
    """A range beyond its maximum is infinite: the rest is compared."""
    distance = 3.0 + wave(1)
    beyond = np.where(distance > 5.0, np.inf, distance)[:, None]
    kind = "sensor_msgs/msg/Range"
    real, sim = {"/sonar": (kind, T, beyond)}, {"/sonar": (kind, T, 1.01 * distance[:, None])}
    pairing = logged(tmp_path, real, sim, (), ())
    (pair,) = pairing.pairs
    assert len(pair.real) == int((distance <= 5.0).sum())
    assert any(f"{int((distance > 5.0).sum())} of /sonar.range" in remark for remark in pairing.remarks)


def test_topics_in_another_namespace_are_paired_and_a_dead_field_is_told(tmp_path: Path) -> None:
    a, b = wave(1)[:, None], wave(2)[:, None]
    real = {"/left/speed": (NUMBER, T, a), "/right/speed": (NUMBER, T, b), "/load": (NUMBER, T, np.ones((len(T), 1)))}
    sim = {"/robot/left/speed": (NUMBER, T, 1.1 * a), "/robot/right/speed": (NUMBER, T, 1.1 * b), "/load": (NUMBER, T, a)}
    real["/load"] = (NUMBER, T, np.ones((len(T), 1)))
    pairing = logged(tmp_path, real, sim, (), ())
    assert {pair.name for pair in pairing.pairs} == {"/left/speed.data", "/right/speed.data"}


def test_joints_of_two_publishers_on_one_topic_are_not_mixed(tmp_path: Path) -> None:
    """An index is now the finger, now the hip."""
    write(tmp_path / "both.mcap", {"/joint_states": (JOINTS, T, joints(wave(1)))}, ("hip",))
    write(tmp_path / "finger.mcap", {"/joint_states": (JOINTS, T + 0.003, joints(wave(2)))}, ("finger",))
    merged = tmp_path / "real.mcap"
    with merged.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "two publishers")
        channel = None
        for name in ("both.mcap", "finger.mcap"):
            for schema, _, message in make_reader(io.BytesIO((tmp_path / name).read_bytes())).iter_messages():
                assert schema is not None
                if channel is None:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channel = writer.register_channel("/joint_states", "cdr", known)
                writer.add_message(channel, message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap has no annotation for it
    write(tmp_path / "sim.mcap", {"/joint_states": (JOINTS, T, joints(wave(1)))}, ("hip",))
    pairing = paired(merged, tmp_path / "sim.mcap")
    assert not pairing.pairs
    assert pairing.remarks == ("Not compared, for its messages name now these joints and now those: /joint_states",)


def fields_of_other_topics(count: int) -> dict[str, object]:
    return {f"/aaa{k:03d}": (NUMBER, T[::100], wave(k)[::100, None]) for k in range(count)}


def test_hundreds_of_other_topics_hide_no_signal(tmp_path: Path) -> None:
    real = {**fields_of_other_topics(420), "/speed": (NUMBER, T, wave(1)[:, None])}
    pairing = logged(tmp_path, real, {"/speed": (NUMBER, T, 1.1 * wave(1)[:, None])}, (), ())
    assert [pair.name for pair in pairing.pairs] == ["/speed.data"]


UNITS = (
    ("magnetic", 5e-5, 1.0, 1e4, 1.0),
    ("magnetic", 5e-5, 1e6, 1.0, 1e-6),
    ("pressure", 1e5, 1.0, 0.01, 1.0),
    ("number", 2.0, 1000.0, 1.0, 1e-3),
    ("number", 2.0, 1.0, 1000.0, 1000.0),
)


def test_noise_of_simulated_joints_adds_no_effect_to_a_friction(tmp_path: Path) -> None:
    """Noise of velocities is that of accelerations: a low-pass would smooth it, and a gain make up for that."""
    motion, rng, t_s = np.random.default_rng(1), np.random.default_rng(0), np.arange(4000) / 100.0
    wide, fast, phase = (motion.uniform(*ends, 5) for ends in ((0.2, 0.5), (0.5, 5.0), (0.0, 6.0)))
    q = np.sin(np.outer(t_s, fast) + phase) @ wide
    dq = np.gradient(q, t_s)
    effort = 0.5 * np.gradient(dq, t_s) + 2.0 * np.sin(q)
    for name, friction in (("sim", 0.0), ("real", 0.2)):
        rows = np.stack([q, dq, effort + friction * np.sign(dq)], axis=1) + 1e-3 * rng.normal(size=(4000, 3))
        write(tmp_path / f"{name}.mcap", {"/joint_states": (JOINTS, t_s, rows)}, ("hip",))
    found = diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap")
    assert [finding.effect for finding in found.findings] == ["coulomb_friction"]


def test_signals_with_the_same_remark_share_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    sides = {
        name: {f"/{k}": (NUMBER, first_s + T, wave(k)[:, None] + 0.01 * rng.normal(size=(len(T), 1))) for k in (1, 2)}
        for name, first_s in (("real", 0.0), ("sim", 1e6))
    }
    logged(tmp_path, *sides.values(), (), ())  # type: ignore[arg-type]  # topics as `write` takes them
    found = diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap")
    (remark,) = [remark for remark in found.remarks if "share no epoch" in remark]
    assert remark.startswith("/1.data, /2.data: the two clocks")


@pytest.mark.parametrize(("kind", "size", "real", "sim", "by"), UNITS)
def test_units_of_either_log_are_brought_to_the_message_or_to_the_simulation(
    kind: str, size: float, real: float, sim: float, by: float
) -> None:
    """Also next to a gain of 1.15, as no sensor's own gain is a thousand."""
    values = (size + 0.1 * size * wave(1))[:, None]
    t_ns = (T * 1e9).astype(np.int64)
    given = SignalPair.of_fields(Fields(t_ns, 1.15 * real * values[:, 0]), Fields(t_ns, sim * values[:, 0]), "/x.y")
    pair, remark = in_one_unit(SignalPair(**{**vars(given), "kind": kind}))
    assert np.allclose(pair.real, 1.15 * real * by * values, rtol=EXACT)
    assert np.allclose(pair.real, 1.15 * pair.sim, rtol=EXACT)
    assert "as in another unit" in remark


def test_a_gain_is_no_unit() -> None:
    t_ns = (T * 1e9).astype(np.int64)
    given = SignalPair.of_fields(Fields(t_ns, 1.5 * wave(1)), Fields(t_ns, wave(1)), "/x.y")
    assert in_one_unit(given) == (given, "")


def test_two_noises_differ_by_no_unit() -> None:
    """The vertical speed of a rover on a plane: a hundred times the simulation's."""
    rng, t_ns = np.random.default_rng(0), (T * 1e9).astype(np.int64)
    real, sim = (Fields(t_ns, size * rng.normal(size=len(T))) for size in (100.0, 1.0))
    given = SignalPair.of_fields(real, sim, "/x.y")
    assert in_one_unit(given) == (given, "")


@pytest.mark.parametrize("seed", range(12))
def test_two_motions_are_not_taken_for_one(seed: int) -> None:
    """Slow signals correlate by chance, the more so at any lag."""
    rng = np.random.default_rng(seed)
    f, p = rng.uniform(0.03, 0.4, (2, 5)), rng.uniform(0.0, 6.0, (2, 5))
    real, sim = (np.sin(2.0 * np.pi * np.outer(T * 3.0, f[k]) + p[k]).sum(axis=1)[:, None] for k in (0, 1))
    with pytest.raises(DataError, match="not alike"):
        lag_at_first_sight(of_two((T * 3.0, real), (T * 3.0, sim)), DiagnoseSettings())


EPOCH_S = 1.7e9
COPIES = {
    "another epoch": (T + EPOCH_S, wave(1), True),
    "float32": (T, wave(1).astype(np.float32).astype(float), True),
    "every third sample of another epoch": (T[::3] + EPOCH_S, wave(1)[::3], True),
    "interpolated to another rate": (T[5:-5] + 0.004, np.interp(T[5:-5] + 0.004, T, wave(1)), True),
    "noise of a thousandth": (T + EPOCH_S, wave(1) + 1e-3 * np.random.default_rng(0).normal(size=len(T)), False),
    "a small gain": (T + EPOCH_S, 1.001 * wave(1), False),
    "an offset": (T, wave(1) + 0.001, False),
    "half of the time": (T[:1000], wave(1)[:1000], False),
    "another motion": (T, wave(2), False),
}


@pytest.mark.parametrize("case", COPIES)
def test_copies_are_known_whatever_their_clock_and_what_differs_is_none(case: str) -> None:
    t_s, values, copied = COPIES[case]
    both = (t_s, values[:, None]), (T, wave(1)[:, None])
    assert is_copy(of_two(*both), DiagnoseSettings()) == copied
    assert is_copy(of_two(*both[::-1]), DiagnoseSettings()) == copied


@pytest.mark.parametrize(("real", "sim", "copied"), [(0.0, 0.0, True), (0.0, 1.0, False), (5.0, 5.0, True)])
def test_what_stands_still_in_both_is_compared_too(real: float, sim: float, copied: bool) -> None:
    """The speed of a planar robot to its side."""
    columns = [np.stack([wave(1), np.full(len(T), value)], axis=1) for value in (real, sim)]
    assert is_copy(of_two((T, columns[0]), (T + EPOCH_S, columns[1])), DiagnoseSettings()) == copied
    assert is_copy(of_two((T, columns[0][:, 1:]), (T, columns[1][:, 1:])), DiagnoseSettings()) == copied


def test_efforts_that_are_motor_currents_are_told() -> None:
    (remark,) = current_remark({"/j.effort[0]": 9.0, "/j.effort[1]": 0.95})
    assert "motor currents" in remark
    assert "/j.effort[0]: 9" in remark
    assert "/j.effort[1]" not in remark
    assert current_remark({"/j.effort[0]": 0.8}) == []


def json_log(path: Path, messages: Sequence[dict[str, object]]) -> None:
    """A log of one topic in JSON, stamped by its log times."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "a fleet's own logger")
        schema = writer.register_schema("acme.Sensors", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/drone0/sensors", "json", schema)
        for t_s, message in zip(T, messages, strict=False):
            writer.add_message(channel, round(t_s * 1e9), json.dumps(message).encode(), round(t_s * 1e9))
        writer.finish()  # type: ignore[no-untyped-call]  # mcap has no annotation for it


def test_a_field_and_an_air_pressure_are_known_in_any_message_by_their_names_and_sizes(tmp_path: Path) -> None:
    """Gauss and hectopascal; a pump, a thermometer next to the barometer and a spectrum are none."""
    turned = np.stack([wave(1), wave(2), 2.0 + wave(3)], axis=1)
    field = 0.5 * turned / np.linalg.norm(turned, axis=1, keepdims=True)
    for name, gain in (("real", 1.1), ("sim", 1.0)):
        columns = {
            "pressure_hpa": 1000.0 + gain * wave(4),
            "pump_pressure_bar": 6.0 + 0.2 * gain * wave(5),
            "baro_temperature": 35.0 + gain * wave(6),
        }
        messages = [
            {
                "magnetometer_ga": (gain * field[k]).tolist(),
                "magnitude": (1.0 + gain * turned[k]).tolist(),
                **{path: float(values[k]) for path, values in columns.items()},
            }
            for k in range(len(T))
        ]
        json_log(tmp_path / f"{name}.mcap", messages)
    pairs = {pair.name: pair for pair in paired(tmp_path / "real.mcap", tmp_path / "sim.mcap").pairs}
    magnetic, air = pairs["/drone0/sensors"], pairs["/drone0/sensors.pressure_hpa"]
    assert (magnetic.kind, magnetic.units, air.kind, air.units) == ("magnetic", ("T",) * 3, "pressure", ("Pa",))
    assert np.allclose(magnetic.sim, 1e-4 * field, rtol=1e-9)
    assert np.allclose(air.sim[:, 0], 1e5 + 100.0 * wave(4), rtol=1e-9)
    assert {pair.kind for name, pair in pairs.items() if name not in (magnetic.name, air.name)} == {"number"}
    assert sum("magnitude" in name for name in pairs) == 3


def test_columns_of_a_table_that_are_a_magnetic_field_are_compared_together(tmp_path: Path) -> None:
    """Each alone would have a constant of its own, and hard iron is three constants."""
    turned = np.stack([wave(1), wave(2), 2.0 + wave(3)], axis=1)
    field = 50.0 * turned / np.linalg.norm(turned, axis=1, keepdims=True)
    iron = np.array([12.0, -5.0, 3.0])
    real, sim = (
        {f"/mag_{axis}_uT": (NUMBER, T, x[:, None]) for axis, x in zip("xyz", values.T, strict=True)}
        for values in (field + iron, field)
    )
    pairs = {pair.name: pair for pair in logged(tmp_path, real, sim, (), ()).pairs}
    magnetic = pairs["/mag_xyz_uT"]
    assert (magnetic.kind, magnetic.units, magnetic.names[0]) == ("magnetic", ("T",) * 3, "/mag_xyz_uT.x")
    assert np.allclose(magnetic.real - magnetic.sim, 1e-6 * iron)
    assert len(pairs) == 1


def test_a_current_that_both_logs_hold_may_drive_a_misfit(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    for name, noise in (("real", 0.01), ("sim", 0.0)):
        current = 5.0 + wave(1) + noise * rng.normal(size=len(T))
        json_log(tmp_path / f"{name}.mcap", [{"current_a": c, "level": v} for c, v in zip(current, wave(2), strict=True)])
    assert "/drone0/sensors.current_a" in paired(tmp_path / "real.mcap", tmp_path / "sim.mcap").drivers


@pytest.mark.parametrize("late_s", [0.004, -0.0005, 0.0])
def test_velocities_are_brought_to_the_clock_of_their_positions(late_s: float) -> None:
    """Half a step late in a semi-implicit integrator, later behind a filter: an effort would lead them."""
    t_s = np.arange(4000) / 200.0
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    w, phase = 2.0 * np.pi * np.array([0.2, 0.7, 1.3]), np.array([0.0, 1.0, 2.0])
    rng = np.random.default_rng(5)
    q = np.sin(np.outer(t_s, w) + phase).sum(axis=1) + 3e-5 * rng.normal(size=len(t_s))
    dq = (w * np.cos(np.outer(t_s - late_s, w) + phase)).sum(axis=1) + 1e-3 * rng.normal(size=len(t_s))
    at_s, _, state = motion({"q0": Fields(t_ns, q), "dq0": Fields(t_ns, dq)}, DiagnoseSettings())
    inner = (at_s > 1.0) & (at_s < at_s[-1] - 1.0)
    exact = (w * np.cos(np.outer(at_s, w) + phase)).sum(axis=1)
    for velocity in ("dq0", "v0"):
        assert abs(time_ahead_s(exact[inner], state[velocity][inner], at_s[inner])) < 5e-5
