"""A file dropped into its folder is found by its name, without being imported; a wrong name suggests the nearest."""

from __future__ import annotations

import importlib.util
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from support.loaded import loaded

from imutool import registry
from imutool.errors import ConfigError


@pytest.mark.parametrize("group", registry.GROUPS)
def test_every_file_of_a_group_is_there_but_the_hidden_ones(group: str) -> None:
    spec = importlib.util.find_spec(registry.GROUPS[group])
    assert spec is not None
    (folder,) = map(Path, spec.submodule_search_locations or ())
    files = {path.stem for path in folder.glob("*.py") if not path.name.startswith("_")}
    assert registry.names(group) == sorted(files - registry.NOT_PLUGINS.get(group, frozenset()))


def test_the_data_sets_and_methods_of_this_version_are_known() -> None:
    assert set(registry.names("imutool.converters")) >= {"euroc", "tum_vi", "fetch"}
    assert set(registry.names("imutool.bias")) >= {"static", "linear", "neural_ode"}


@pytest.mark.parametrize("group", registry.GROUPS)
def test_each_loads_and_has_a_one_line_summary(group: str) -> None:
    for name in registry.names(group):
        module = registry.load(group, name)
        assert module.__name__ == f"{registry.GROUPS[group]}.{name}"
        line = registry.summary(group, name)
        assert line == (module.__doc__ or "").partition("\n")[0]
        assert 10 < len(line) < 130
        assert line.endswith(".")


def test_listing_imports_nothing() -> None:
    code = "from imutool import registry\nfor g in registry.GROUPS:\n    [registry.summary(g, n) for n in registry.names(g)]"
    assert loaded(code, {"torch", "scipy", "rosbags", "imutool.bias.linear", "imutool.converters.euroc"}) == []


@pytest.mark.parametrize(
    ("group", "wrong", "near"),
    [
        ("imutool.bias", "linera", "linear"),
        ("imutool.bias", "neural-ode", "neural_ode"),
        ("imutool.converters", "tumvi", "tum_vi"),
    ],
)
def test_a_wrong_name_suggests_the_nearest_and_lists_all(group: str, wrong: str, near: str) -> None:
    with pytest.raises(ConfigError) as caught:
        registry.load(group, wrong)
    message = str(caught.value)
    assert message.endswith(f" Did you mean {near!r}?")
    assert all(name in message for name in registry.names(group))


@pytest.mark.parametrize("name", ["_base", "_file", "os", "..errors", "linear.Model", "", "static\n"])
def test_what_is_no_key_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="is not known"):
        registry.load("imutool.bias", name)


def test_a_name_like_nothing_suggests_nothing() -> None:
    with pytest.raises(ConfigError) as caught:
        registry.load("imutool.bias", "xyzzy")
    assert "Did you mean" not in str(caught.value)


def test_packages_outside_register_through_entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """`json` stands for somebody's module."""
    point = EntryPoint("theirs", "json", "imutool.bias")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == "imutool.bias" else [])
    assert "theirs" in registry.names("imutool.bias")
    assert registry.load("imutool.bias", "theirs").__name__ == "json"
    assert registry.load("imutool.bias", "linear").__name__ == "imutool.bias.linear"
    assert registry.every("imutool.bias")["theirs"].__name__ == "json"
    assert "theirs" not in registry.names("imutool.converters")
    assert registry.summary("imutool.bias", "theirs") != ""


@pytest.mark.parametrize("group", list(registry.GROUPS))
def test_every_module_is_the_one_that_its_key_loads(group: str) -> None:
    assert registry.every(group) == {name: registry.load(group, name) for name in registry.names(group)}
