"""Validation of `--json` reports against the schemas that `imutool schema` prints."""

from __future__ import annotations

from typing import Any

import jsonschema

from imutool.report import json_schema


def assert_valid(report: dict[str, Any]) -> None:
    """Validate a report against its schema.

    Raises:
        AssertionError: it has no schema, or violates it.
    """
    validator = jsonschema.Draft202012Validator(json_schema(report["schema"]))
    problems = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(report)]
    assert not problems, problems[:5]
