"""A message says where, what, what was expected and what to do; errors cross process borders whole."""

from __future__ import annotations

import inspect
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from imutool import errors
from imutool.errors import ConfigError, DataError, ImutoolError, LogError, ModelError, NumericsError, UsageError

CODES = {ConfigError: 3, UsageError: 2, DataError: 4, LogError: 5, ModelError: 6, NumericsError: 7}


def test_the_tree_is_as_drawn_and_every_code_its_own() -> None:
    found = {kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, ImutoolError)}
    assert found == {ImutoolError, *CODES}
    assert {kind: kind.exit_code for kind in CODES} == CODES
    assert all(kind.__bases__ == (ImutoolError,) for kind in CODES if kind is not UsageError)
    assert UsageError.__bases__ == (ConfigError,)
    drawing = errors.__doc__ or ""
    for kind, code in CODES.items():
        assert f"{kind.__name__:<13}".rstrip() in drawing
        assert f" {code} " in drawing


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({}, "what happened."),
        ({"where": "data.csv:17"}, "data.csv:17: what happened."),
        ({"where": Path("a/b.mcap")}, "a/b.mcap: what happened."),
        ({"expected": "a number"}, "what happened; expected a number."),
        ({"fix": "Do this"}, "what happened. Do this."),
        ({"fix": "Did you mean 'x'?"}, "what happened. Did you mean 'x'?"),
        ({"where": "w", "expected": "e", "fix": "F"}, "w: what happened; expected e. F."),
    ],
)
def test_its_parts_make_sentences(words: dict[str, str], message: str) -> None:
    error = DataError("what happened", **words)  # type: ignore[arg-type]
    assert str(error) == message
    assert error.args == (message,)


def test_an_address_is_filled_in_once() -> None:
    error = LogError("what", expected="e", fix="F")
    there = error.at("log.mcap")
    assert (type(there), str(there)) == (LogError, "log.mcap: what; expected e. F.")
    assert there.at("elsewhere") is there
    assert error.where is None


@pytest.mark.parametrize("kind", CODES)
def test_it_pickles_with_all_its_parts(kind: type[ImutoolError]) -> None:
    error = kind("what [0, 1]", where=Path("x.mcap"), expected="e", fix="F")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is kind
    assert (back.what, back.where, back.expected, back.fix) == (error.what, error.where, error.expected, error.fix)
    assert (str(back), back.exit_code) == (str(error), kind.exit_code)


def fail(kind: type[ImutoolError]) -> None:
    raise kind("what", where="w", expected="e", fix="F")


def test_it_comes_out_of_another_process_as_it_went() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for kind in CODES:
            with pytest.raises(kind, match=r"^w: what; expected e\. F\.$"):
                pool.submit(fail, kind).result(timeout=120)
