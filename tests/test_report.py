"""Reports: JSON values and schemas."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from imutool.errors import ConfigError
from imutool.report import REPORTS, UNSET, Report, Section, UnsetType, json_schema, json_text, json_values, report_type


class Axis(Section, frozen=True):
    name: str
    std: float | None
    bins: list[float] | UnsetType = UNSET


class Example(Report, frozen=True, tag="imutool.example/1"):
    axes: list[Axis]


def test_json_knows_no_arrays_no_nan_and_no_unset_keys() -> None:
    report = Example(axes=[Axis("x", np.float64("nan")), Axis("y", np.float32(0.5), np.arange(2.0))])  # type: ignore[arg-type]
    assert json_values(report) == {
        "schema": "imutool.example/1",
        "axes": [{"name": "x", "std": None}, {"name": "y", "std": 0.5, "bins": [0.0, 1.0]}],
    }


HOSTILE = [
    float("nan"),
    float("inf"),
    np.float32("-inf"),
    np.bool_(True),
    np.int64(3),
    np.float64(0.5),
    np.array([1.0, np.nan]),
    10**30,
]


def test_json_is_written_of_any_value() -> None:
    text = json_text({"schema": "imutool.example/1", "values": [*HOSTILE, {"inner": (np.nan, {"x": np.uint8(7)})}, Path("a")]})
    values = json.loads(text, parse_constant=pytest.fail)["values"]
    assert values == [None, None, None, True, 3, 0.5, [1.0, None], 10**30, {"inner": [None, {"x": 7}]}, "a"]


def test_json_holds_no_character_that_a_terminal_acts_on() -> None:
    names = "a\u202eb\x1b[31mc\x9bd\udcffe\u2066f\x7fgä漢\n\U000e0001"
    text = json_text({"name": names})
    assert all(c.isprintable() or c == "\n" for c in text)
    assert "ä漢" in text
    assert json.loads(text)["name"] == names


@pytest.mark.parametrize("name", sorted(REPORTS))
def test_every_report_has_a_schema_with_its_name(name: str) -> None:
    schema = json_schema(name)
    jsonschema.Draft202012Validator.check_schema(schema)
    (tag,) = schema["$defs"][report_type(name).__name__]["properties"]["schema"]["enum"]
    assert tag.startswith(f"imutool.{name}/")
    assert json_schema(tag) == schema


def test_a_name_that_no_report_has_meets_the_nearest() -> None:
    with pytest.raises(ConfigError, match="no report is named 'modelz'"):
        json_schema("modelz")
