"""Reports: JSON values and schemas."""

from __future__ import annotations

import jsonschema
import numpy as np
import pytest

from imutool.errors import ConfigError
from imutool.report import REPORTS, UNSET, Report, Section, UnsetType, json_schema, json_values, report_type


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
