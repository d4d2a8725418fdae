"""Settings are read, laid over one another and checked; what is wrong is named, with what was probably meant."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imutool import registry
from imutool.config import MAX_BYTES, Settings, build, load, plain
from imutool.errors import ConfigError
from imutool.inertial.stationary import StationarySettings
from imutool.noise.datasheet import read as read_noise
from imutool.sensor.made_up_flight import FlightSettings
from imutool.sensor.physics_file import read as read_physics
from imutool.training.fit import TrainSettings
from imutool.training.settings import settings_of


class Inner(Settings, frozen=True):
    window_s: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    name: str = "x"


class Outer(Settings, frozen=True):
    steps: Annotated[int, msgspec.Meta(ge=1)] = 10
    rate: float = 0.5
    on: bool = False
    lengths: tuple[float, ...] = (1.0, 2.0)
    inner: Inner = Inner()
    anything: dict[str, Any] = msgspec.field(default_factory=dict)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "settings.toml"
    path.write_text('steps = 20\nlengths = [3.0]\n[inner]\nname = "y"\n')
    return path


def test_defaults_then_the_file_then_the_words(file: Path) -> None:
    assert load(Outer) == Outer()
    assert load(Outer, file) == Outer(steps=20, lengths=(3.0,), inner=Inner(name="y"))
    words = ["steps=30", "inner.window_s=2.5", "on=true"]
    assert load(Outer, file, words) == Outer(steps=30, lengths=(3.0,), on=True, inner=Inner(2.5, "y"))
    assert load(Outer, None, ["steps=1", "steps=2"]).steps == 2  # the last word wins


@pytest.mark.parametrize(
    ("word", "field", "value"),
    [
        ("rate=3", "rate", 3.0),
        ("rate=1e-3", "rate", 1e-3),
        ("lengths=[1, 2.5]", "lengths", (1.0, 2.5)),
        ("inner.name=plain words", "inner", Inner(name="plain words")),
        ('inner.name="quoted"', "inner", Inner(name="quoted")),
        ("inner.name=a=b", "inner", Inner(name="a=b")),
        ("inner.name=", "inner", Inner(name="")),
        ("anything.a.b=1", "anything", {"a": {"b": 1}}),
        ("inner={window_s = 4.0}", "inner", Inner(4.0)),
    ],
)
def test_a_word_is_read_as_toml_or_taken_as_it_is(word: str, field: str, value: object) -> None:
    assert getattr(load(Outer, None, [word]), field) == value


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("stesp=3", r"stesp is not a setting; expected one of .*steps.* Did you mean steps\?$"),
        ("inner.windw_s=3", r"inner.windw_s is not a setting; expected one of name, window_s. Did you mean inner.window_s\?$"),
        ("zzz=3", r"zzz is not a setting; expected one of anything, inner, lengths, on, rate, steps\.$"),
        ("steps=0", r"steps: is 0, out of range; expected an integer >= 1"),
        ("steps=2.5", r"steps: is 2.5, a number; expected an integer"),
        ("steps=many", r"steps: is 'many', text; expected an integer"),
        ("on=1", r"on: is 1, an integer; expected true or false"),
        ("inner.window_s=-1", r"inner.window_s: is -1, out of range; expected a number > 0"),
        ("inner=3", r"inner"),
        ("steps", r"set: 'steps' sets nothing; expected key=value"),
        ("=3", r"set: '=3' sets nothing; expected key=value"),
        ("steps.more=3", r"steps: is .*a table; expected an integer"),
    ],
)
def test_a_wrong_word_is_refused_with_what_is_wrong(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load(Outer, None, [word])


def test_a_table_over_a_value_is_refused(file: Path) -> None:
    with pytest.raises(ConfigError, match=r"set=steps.more=3: 'steps' is a value, not a table"):
        load(Outer, file, ["steps.more=3"])
    with pytest.raises(ConfigError, match=r"'steps' is a value, not a table"):
        load(Outer, None, ["steps=3", "steps.more=3"])


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("gyro_window_s=[]", "gyro_window_s: is [], out of range"),
        ("gyro_window_s=[1, -2]", "gyro_window_s[1]: is -2, out of range"),
        (f"seed={10**20}", f"seed: is {10**20}, out of range"),
    ],
)
def test_settings_without_a_meaning_are_refused_before_a_training(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        load(settings_of("linear"), None, [word])


def test_a_word_sets_one_value_only() -> None:
    """What follows a line break is not read as a second setting, nor dropped without a word."""
    with pytest.raises(ConfigError):
        load(Outer, None, ["steps=3\nrate=4"])
    assert load(Outer, None, ["inner.name=a\nb"]).inner.name == "a\nb"


@pytest.mark.parametrize("word", ["rate=nan", "rate=inf", "inner.window_s=inf", "inner.window_s=nan", "lengths=[1.0, -inf]"])
def test_numbers_that_are_none_are_refused(word: str) -> None:
    with pytest.raises(ConfigError, match="finite"):
        load(Outer, None, [word])


@pytest.mark.parametrize("content", [b"steps = ", b"\xff\xfe", b"steps = 1\nsteps = 2", b"[inner\n"])
def test_a_file_that_is_no_toml_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"broken.toml: settings cannot be read \(.*; expected a TOML file"):
        load(Outer, path)


@pytest.mark.parametrize("read", [partial(load, Outer), read_noise, read_physics], ids=["settings", "noise", "physics"])
def test_a_file_too_large_or_nested_without_end_is_refused_before_it_costs_anything(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a terabyte that takes no room
    with pytest.raises(ConfigError, match=rf"huge.toml: .* cannot be read \(more than {MAX_BYTES} bytes\); expected"):
        read(path)
    path.write_text("a = " + "[" * 100_000)
    with pytest.raises(ConfigError, match="nested too deeply"):
        read(path)
    path.write_text("a = " + "9" * 5000)
    with pytest.raises(ConfigError, match=r"huge.toml: .* cannot be read .*thousands of digits"):
        read(path)


def test_a_word_nested_without_end_is_text() -> None:
    assert load(Inner, None, ["name=" + "[" * 100_000]).name == "[" * 100_000


def test_a_file_that_is_not_there_or_a_folder_is_refused_by_name(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(ConfigError, match="settings cannot be read"):
            load(Outer, path)


def test_a_wrong_value_in_a_file_is_said_with_its_file(file: Path) -> None:
    file.write_text("steps = -1\n")
    with pytest.raises(ConfigError, match=r"settings.toml: .*>= 1"):
        load(Outer, file)
    file.write_text("stepz = 1\n")
    with pytest.raises(ConfigError, match=r"settings.toml: stepz is not a setting.*Did you mean steps\?"):
        load(Outer, file)


def test_a_wrong_word_over_a_file_does_not_touch_the_file(file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(ConfigError):
        load(Outer, file, ["nothing=1"])
    assert file.read_bytes() == before


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.builds(
        Outer,
        steps=st.integers(1, 2**53),
        rate=finite,
        on=st.booleans(),
        lengths=st.lists(finite).map(tuple),
        inner=st.builds(Inner, window_s=finite.filter(lambda x: x > 0), name=st.text()),
        anything=st.dictionaries(st.text(), st.integers() | st.text() | finite),
    )
)
def test_build_is_the_inverse_of_plain(settings: Outer) -> None:
    assert build(Outer, plain(settings)) == settings


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        Outer().steps = 3  # type: ignore[misc]


@pytest.mark.parametrize("name", registry.names("imutool.bias"))
def test_every_methods_settings_round_trip(name: str) -> None:
    kind = registry.load("imutool.bias", name).Config
    assert issubclass(kind, Settings)
    assert build(kind, plain(kind())) == kind()


@pytest.mark.parametrize("kind", [TrainSettings, FlightSettings, StationarySettings])
def test_settings_of_the_rooms_round_trip(kind: type[Settings]) -> None:
    assert build(kind, plain(kind())) == kind()
