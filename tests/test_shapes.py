"""The tests check annotations: a wrong shape, type or result is refused, also after right ones have passed."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from jaxtyping import Float64, TypeCheckError
from support.shapes import check_shapes

from imutool import array_types
from imutool.inertial.preintegration import hat

SOURCE = """
from __future__ import annotations
from dataclasses import dataclass, field
from typing import Literal
import numpy as np
from jaxtyping import Float64

def scaled(t: Float64[np.ndarray, " n"], x: Float64[np.ndarray, "n 3"], wrong: bool = False) -> Float64[np.ndarray, "n 3"]:
    return x[1:] if wrong and x[0, 0] < 0 else x * t[:, None]

def named(start: Literal["rest", "truth"]) -> str:
    return start

def outer(width: int) -> object:
    def inner(x: Float64[np.ndarray, "n 3"]) -> int:
        return len(x)
    return inner(np.zeros((4, width)))

@dataclass(frozen=True)
class Samples:
    t: Float64[np.ndarray, " n"]
    x: Float64[np.ndarray, "n 3"]

@dataclass(frozen=True)
class Others:
    t: Float64[np.ndarray, " n"]
    x: Float64[np.ndarray, "n 4"]

@dataclass(frozen=True)
class Rest:
    x: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    t: Float64[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(2))

Shorter = Float64[np.ndarray, " n-1"]

def steps(t: Float64[np.ndarray, " n"]) -> Shorter:
    return np.zeros(99)
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    (tmp_path / "checked_shapes.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    check_shapes("checked_shapes")
    yield importlib.import_module("checked_shapes")
    del sys.modules["checked_shapes"]


def test_the_types_of_the_package_are_those_of_jaxtyping_under_tests() -> None:
    assert array_types.Float64 is Float64
    with pytest.raises(TypeCheckError):
        hat(np.zeros(4))


def test_a_wrong_shape_is_refused_after_right_ones(package: ModuleType) -> None:
    t, x = np.ones(5), np.ones((5, 3))
    for _ in range(3):
        package.scaled(t, x)
    for wrong in ((t, x[:4]), (t, x[:, :2]), (t.astype(np.float32), x), (t, list(x))):
        with pytest.raises(TypeCheckError):
            package.scaled(*wrong)


def test_wrong_lengths_are_refused_after_right_ones_of_other_lengths(package: ModuleType) -> None:
    for n in (100, 200, 64, 4):
        package.scaled(np.ones(n), np.ones((n, 3)))
    for wrong in ((300, 400), (3, 400), (400, 3), (64, 65)):
        with pytest.raises(TypeCheckError):
            package.scaled(np.ones(wrong[0]), np.ones((wrong[1], 3)))
    with pytest.raises(TypeCheckError, match="return value"):
        package.scaled(np.ones(300), -np.ones((300, 3)), wrong=True)


def test_a_computed_length_is_checked_for_each_length(package: ModuleType) -> None:
    package.steps(np.zeros(100))
    with pytest.raises(TypeCheckError, match="return value"):
        package.steps(np.zeros(101))


def test_classes_with_the_same_fields_are_checked_apart_and_factories_of_fields_are_not(package: ModuleType) -> None:
    t = np.ones(5)
    package.Samples(t, np.ones((5, 3))), package.Others(t, np.ones((5, 4)))
    for kind, columns in ((package.Samples, 4), (package.Others, 3)):
        with pytest.raises(TypeCheckError):
            kind(t, np.ones((5, columns)))
    package.Rest(), package.Rest(np.zeros(3)), package.Rest(t=t)
    with pytest.raises(TypeCheckError):
        package.Rest(t)


def test_a_wrong_result_is_refused_after_right_ones(package: ModuleType) -> None:
    t, x = np.ones(5), np.ones((5, 3))
    package.scaled(t, x, wrong=True)
    with pytest.raises(TypeCheckError, match="return value"):
        package.scaled(t, -x, wrong=True)


def test_a_word_a_field_and_an_inner_function_are_checked_after_right_ones(package: ModuleType) -> None:
    package.named("rest"), package.outer(3), package.Samples(np.ones(5), np.ones((5, 3)))
    for wrong in (
        lambda: package.named("best"),
        lambda: package.outer(2),
        lambda: package.Samples(np.ones(4), np.ones((5, 3))),
    ):
        with pytest.raises(TypeCheckError):
            wrong()
