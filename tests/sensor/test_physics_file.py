"""physics.toml: what is written comes back to the bit, what is wrong is named, and what it says acts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.errors import ConfigError, DataError
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.physics_file import Bias, Curve, Entry, PhysicsFile, Term, Value, read, write
from imutool.sensor.samples import IdealMotion, SensorSamples

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
POSITIVE = st.floats(min_value=0.0, allow_nan=False, allow_infinity=False)
THREE, THREE_STD = st.tuples(NUMBERS, NUMBERS, NUMBERS), st.tuples(POSITIVE, POSITIVE, POSITIVE)
SENSORS = st.sampled_from(["gyro", "accel"])
VALUES = st.builds(Value, value=NUMBERS, std=st.none() | POSITIVE, unit=st.text())
ENTRIES = st.builds(
    Entry,
    name=st.text(),
    signal=st.sampled_from(["gyro", "accel", "both", ""]),
    driver=st.text(),
    column=st.text(),
    equation=st.text(),
    parameters=st.dictionaries(st.text(), VALUES, max_size=3),
)
RISING = st.lists(NUMBERS, min_size=2, max_size=4, unique_by=lambda x: x + 0.0).map(lambda xs: tuple(sorted(xs)))


@st.composite
def curves(draw: st.DrawFn) -> Curve:
    x = draw(RISING)
    rows = st.lists(THREE, min_size=len(x), max_size=len(x)).map(tuple)
    band = st.just(()) | st.lists(THREE_STD, min_size=len(x), max_size=len(x)).map(tuple)
    return Curve(signal=draw(SENSORS), variable=draw(st.text()), unit=draw(st.text()), x=x, y=draw(rows), band=draw(band))


FILES = st.builds(
    PhysicsFile,
    conventions=st.lists(st.text(), max_size=2).map(tuple),
    effect=st.lists(ENTRIES, max_size=3).map(tuple),
    bias=st.none() | st.builds(Bias, gyro=THREE, accel=THREE),
    unknown=st.lists(curves(), max_size=2).map(tuple),
    term=st.lists(st.builds(Term, signal=SENSORS, term=st.text(), value=THREE, std=st.none() | THREE_STD), max_size=2).map(
        tuple
    ),
)


def bits(file: PhysicsFile) -> str:
    """With the sign of every zero."""
    return repr(file)


@settings(max_examples=60, deadline=None)
@given(FILES)
def test_what_is_written_comes_back_to_the_bit(file: PhysicsFile) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "physics.toml"
        write(file, path)
        assert bits(read(path)) == bits(file)


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "physics.toml"
    path.write_text("mine")
    with pytest.raises(ConfigError, match="exists"):
        write(PhysicsFile(), path)
    assert path.read_text() == "mine"


LEVER = '[[effect]]\nname = "lever_arm"\nsignal = "accel"\n[effect.parameters.x]\nvalue = 0.1\nstd = 0.004\nunit = "m"\n'
CURVE = '[[unknown]]\nsignal = "accel"\nvariable = "omega_x"\nunit = "rad/s"\nx = [0.0, 1.0]\ny = [[0, 0, 0], [1, 0, 0]]\n'


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[[effect]\n", "cannot be read"),
        ("frobnicate = 1\n", "frobnicate"),
        ("efect = []\n", "Did you mean effect?"),
        (LEVER.replace("value = 0.1\n", ""), "value"),
        (LEVER.replace("0.1", '"0.1"'), "value"),
        (LEVER.replace("0.1", "inf"), r"effect\[0\].parameters.x.value is inf"),
        (LEVER.replace("0.004", "-1"), "std"),
        (LEVER.replace('"accel"', '"magnet"'), "signal"),
        (LEVER + "colour = 1\n", "colour"),
        (CURVE.replace("[0.0, 1.0]", "[1.0, 1.0]"), r"unknown\[0\].x does not rise"),
        (CURVE.replace("[0.0, 1.0]", "[0.0, 1.0, 2.0]"), r"unknown\[0\].y has 2 rows"),
        ("[bias]\ngyro = [0, 0]\n", r"bias\.gyro: has 2 items; expected a list of length 3"),
        ('schema = "imutool.physics/9"\n', "schema"),
    ],
    ids=lambda value: value.strip().splitlines()[-1][:30],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "physics.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=named) as told:
        read(path)
    assert str(path) in str(told.value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (LEVER.replace("lever_arm", "lever_arn"), r"effect\[0\].name: 'lever_arn'.*Did you mean 'lever_arm'\?"),
        (LEVER.replace("parameters.x", "parameters.xx"), r"effect\[0\].parameters.xx: 'xx' is not known.*Did you mean x\?"),
        (LEVER.replace('"m"', '"mm"'), r"effect\[0\].parameters.x.unit is 'mm'; expected 'm'"),
        (LEVER.replace('"accel"', '"gyro"'), r"effect\[0\].signal is gyro"),
        ('[[effect]]\nname = "lever_arm"\nparameters = {}\n', r"effect\[0\].parameters is empty"),
        (
            '[[effect]]\nname = "low_pass"\n[effect.parameters.f_c]\nvalue = -3.0\nunit = "Hz"\n',
            r"effect\[0\].parameters.f_c.value is -3; expected more than 0",
        ),
        (CURVE.replace("omega_x", "omega_q"), r"unknown\[0\].variable: 'omega_q'"),
        ('[[term]]\nsignal = "gyro"\nterm = "omega_x banana"\nvalue = [1, 0, 0]\n', r"term\[0\].term: 'omega_x banana'"),
        ('[[effect]]\nname = "driven"\n[effect.parameters.x]\nvalue = 1.0\nunit = "u"\n', r"effect\[0\].signal is ''"),
    ],
    ids=lambda value: value.strip().splitlines()[-1][:30],
)
def test_what_cannot_act_is_named(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "physics.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=named):
        read(path).acting(where=path)


def test_parameters_go_in_the_effects_own_order_and_what_is_left_out_does_nothing() -> None:
    numbers = (Parameter("b", "m", 1.0), Parameter("a", "s", 1.0), Parameter("cut", "Hz", 1.0, null_value=np.inf))
    planted = Effect("planted", Stage.SENSOR, ("gyro",), "", numbers, "", lambda read, theta: read)

    def known(names: Sequence[str]) -> tuple[Effect, ...]:
        assert list(names) == ["planted"]
        return (planted,)

    entry = Entry(name="planted", parameters={"a": Value(value=2.0, unit="s"), "b": Value(value=1.0, unit="m")})
    ((physics, theta),) = PhysicsFile(effect=(entry,)).acting(known=known)
    assert physics is planted
    np.testing.assert_array_equal(theta, [1.0, 2.0, np.inf])


def test_a_low_pass_acts_on_the_sensor_that_the_file_names() -> None:
    rng = np.random.default_rng(1)
    felt = IdealMotion(0.01 * np.arange(200), *(rng.normal(size=(200, 3)) for _ in range(3)))
    slow = {"f_c": Value(value=5.0, unit="Hz")}
    for signal, changed in (("accel", [False, True]), ("gyro", [True, False]), ("both", [True, True]), ("", [True, True])):
        effect, theta = one(PhysicsFile(effect=(Entry(name="low_pass", signal=signal, parameters=slow),)))
        out = effect.forward(felt, theta)
        assert [bool((out.gyro != felt.gyro).any()), bool((out.accel != felt.accel).any())] == changed


@pytest.fixture
def ideal() -> SensorSamples:
    rng = np.random.default_rng(0)
    t_s = 0.01 * np.arange(200)
    gyro, accel, alpha = (rng.normal(size=(200, 3)) for _ in range(3))
    return IdealMotion(t_s, gyro, accel, alpha, channels={"/motor": np.sin(t_s)}).sample(t_s, t_s + 5.0)


def one(file: PhysicsFile) -> tuple[Effect, Theta]:
    (pair,) = file.acting()
    return pair


def test_a_scale_with_a_time_acts_from_then_on(ideal: SensorSamples) -> None:
    parameters = {"x": Value(value=0.5, unit="-"), "t_step": Value(value=6.0, unit="s")}
    physics, theta = one(PhysicsFile(effect=(Entry(name="accel_scale", parameters=parameters),)))
    gain = np.where(ideal.stamp_s >= 6.0, 1.5, 1.0)[:, None] ** [1, 0, 0]
    np.testing.assert_allclose(physics.forward(ideal, theta).accel, ideal.accel * gain)


def test_effects_of_other_signals_are_told_and_do_not_act(tmp_path: Path) -> None:
    friction = Entry(
        name="coulomb_friction", column="/joint_states.effort[0]", parameters={"level": Value(value=0.5, unit="N m")}
    )
    arm = Entry(name="lever_arm", parameters={"x": Value(value=0.1, unit="m")})
    write(PhysicsFile(effect=(friction, arm)), tmp_path / "physics.toml")
    assert "do not apply it" in (tmp_path / "physics.toml").read_text()
    assert [effect.name for effect, _ in read(tmp_path / "physics.toml").acting()] == ["lever_arm"]


def test_a_bias_is_added(ideal: SensorSamples) -> None:
    physics, theta = one(PhysicsFile(bias=Bias(gyro=(1.0, 2.0, 3.0), accel=(4.0, 5.0, 6.0))))
    out = physics.forward(ideal, theta)
    np.testing.assert_allclose(out.gyro - ideal.gyro, np.tile([1.0, 2.0, 3.0], (200, 1)))
    np.testing.assert_allclose(out.accel - ideal.accel, np.tile([4.0, 5.0, 6.0], (200, 1)))


def test_a_curve_is_straight_between_its_points_and_held_beyond(ideal: SensorSamples) -> None:
    curve = Curve(signal="accel", variable="omega_y", unit="rad/s", x=(-0.5, 0.5), y=((0.0, 1.0, 0.0), (0.0, 3.0, 2.0)))
    physics, theta = one(PhysicsFile(unknown=(curve,)))
    out = physics.forward(ideal, theta)
    share = np.clip(ideal.gyro[:, 1] + 0.5, 0.0, 1.0)
    np.testing.assert_allclose(
        out.accel - ideal.accel, np.stack([0.0 * share, 1.0 + 2.0 * share, 2.0 * share], axis=1), atol=1e-12
    )
    np.testing.assert_array_equal(out.gyro, ideal.gyro)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("omega_x omega_y", lambda r: r.gyro[:, 0] * r.gyro[:, 1]),
        ("omega_x|omega_x|", lambda r: r.gyro[:, 0] * np.abs(r.gyro[:, 0])),
        ("|f_z|", lambda r: np.abs(r.accel[:, 2])),
        ("|f|", lambda r: np.linalg.norm(r.accel, axis=1)),
        ("alpha_y^3", lambda r: r.alpha[:, 1] ** 3),
        ("sign(f_x)", lambda r: np.sign(r.accel[:, 0])),
        ("t", lambda r: r.stamp_s),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_term_is_what_it_says(ideal: SensorSamples, text: str, expected: object) -> None:
    physics, theta = one(PhysicsFile(term=(Term(signal="gyro", term=text, value=(0.0, 2.0, 0.0)),)))
    out = physics.forward(ideal, theta)
    np.testing.assert_allclose(out.gyro[:, 1] - ideal.gyro[:, 1], 2.0 * expected(ideal), atol=1e-12)  # type: ignore[operator]
    np.testing.assert_array_equal(out.gyro[:, [0, 2]], ideal.gyro[:, [0, 2]])


def test_what_is_driven_follows_its_channel_later(ideal: SensorSamples) -> None:
    parameters = {"y": Value(value=3.0, unit="rad/s per A"), "lag": Value(value=0.1, unit="s")}
    entry = Entry(name="driven", signal="gyro", driver="/motor", parameters=parameters)
    physics, theta = one(PhysicsFile(effect=(entry,)))
    added = (physics.forward(ideal, theta).gyro - ideal.gyro)[:, 1]
    c = ideal.channels["/motor"]
    np.testing.assert_allclose(added[10:], 3.0 * (c[:-10] - c.mean()), atol=1e-12)


def test_a_channel_that_is_not_there_is_named(ideal: SensorSamples) -> None:
    entry = Entry(name="driven", signal="gyro", driver="/wheel", parameters={"y": Value(value=3.0, unit="")})
    physics, theta = one(PhysicsFile(effect=(entry,)))
    with pytest.raises(DataError, match=r"no channel /wheel; expected one of the log's channels: /motor"):
        physics.forward(ideal, theta)
