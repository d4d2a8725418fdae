"""JSON reports: typed Structs, their JSON values, and their JSON Schema.

A command's `--json` report is one `Report`: a frozen msgspec Struct whose tag is the first key, `"schema": "imutool.NAME/1"`.
Objects inside it are `Section`s. Text output reads the same Structs. To add a report: derive it, name it in `REPORTS`.
::

    class Models(Report, frozen=True, tag="imutool.models/1"):
        models: list[ModelEntry]

A key that not every report has is declared `key: T | UnsetType = UNSET`; the class
takes `kw_only=True` where such a key stands before one that every report has. Units stand in the names, as in settings.
"""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from imutool.errors import ConfigError, did_you_mean

__all__ = ["REPORTS", "UNSET", "NamedProgress", "Progress", "Report", "Section", "UnsetType"]
__all__ += ["json_schema", "json_text", "json_values", "report_type", "silent"]

# by name, the module and the type: imported when its schema is asked for, so that --help stays light
REPORTS = {
    "catalog": "imutool.fleet.rerun_catalog:CatalogReport",
    "audit": "imutool.diagnosis.audit:AuditReport",
    "clean": "imutool.cleaning.survey:CleaningReport",
    "conversion": "imutool.conversion.workers:ConvertReport",
    "debias": "imutool.cli.debias:DebiasSummary",
    "demo": "imutool.cli.demo:DemoReport",
    "diagnosis": "imutool.diagnosis.result:DiagnosisReport",
    "evaluation": "imutool.cli.evaluate:Evaluation",
    "export": "imutool.exporting:ExportReport",
    "fleet": "imutool.fleet.results:FleetSummary",
    "fleet-diagnosis": "imutool.fleet.robots:FleetDiagnosis",
    "info": "imutool.log_info.report:LogInfo",
    "infos": "imutool.log_info.report:LogInfos",
    "live": "imutool.cli.live:LiveReport",
    "models": "imutool.cli.models:Models",
    "repair": "imutool.cli.clean:Repair",
    "score": "imutool.blind_cases:OpenedCase",
    "simulation": "imutool.cli.simulate:SimulationReport",
    "training": "imutool.cli.train:TrainingReport",
    "unit": "imutool.fleet.one_log:UnitReport",
    "view": "imutool.cli.view:View",
    "vio": "imutool.cli.evaluate:VioReport",
}


Progress = Callable[[int, int], None]  # bytes done, bytes in all
NamedProgress = Callable[[int, int, str], None]  # steps done, steps in all, the current step


def silent(*_: object) -> None:
    """Progress that nobody looks at."""


class Section(msgspec.Struct, frozen=True):
    """Section of a report; numbers and lists may be numpy scalars and arrays."""


class Report(msgspec.Struct, frozen=True, tag_field="schema"):
    """Report of a command; the `tag` of a subclass is its schema's name and version."""

    def __str__(self) -> str:
        """JSON, as `--json` writes it."""
        return json_text(self).rstrip()

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as JSON has them: `json_values`."""
        return json_values(self)


def json_values(report: msgspec.Struct | Mapping[str, Any]) -> dict[str, Any]:
    """Plain JSON values of a report: arrays as lists, paths as text.

    NaN and infinity become null; unset keys are left out.
    """
    values = _finite(msgspec.to_builtins(report, enc_hook=_plain))
    assert isinstance(values, dict)
    return values


def json_text(report: msgspec.Struct | Mapping[str, Any]) -> str:
    """JSON of a report, indented, with a newline at its end.

    Characters that a terminal would act on (control, bidirectional, lone surrogates) are escaped; the values are the same.
    """
    text = json.dumps(json_values(report), indent=2, allow_nan=False, ensure_ascii=False)
    return "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text) + "\n"


def _escaped(character: str) -> str:
    return json.dumps(character)[1:-1] if ord(character) > 0x7F else f"\\u{ord(character):04x}"


def report_type(name: str) -> type[Report]:
    """Report type by name: `info` or `imutool.info/1`.

    Raises:
        ConfigError: no report has this name; the message names the nearest.
    """
    short = name.removeprefix("imutool.").partition("/")[0]
    if short not in REPORTS:
        raise ConfigError(
            f"no report is named {name!r}",
            where="schema",
            expected=f"one of {', '.join(sorted(REPORTS))}",
            fix=did_you_mean(short, REPORTS),
        )
    module, _, kind = REPORTS[short].partition(":")
    report = getattr(importlib.import_module(module), kind)
    assert isinstance(report, type)
    assert issubclass(report, Report)
    return report


def json_schema(name: str) -> dict[str, Any]:
    """JSON Schema (2020-12) of a report.

    Raises:
        ConfigError: no report has this name; the message names the nearest.
    """
    schema = msgspec.json.schema(report_type(name), schema_hook=lambda kind: {"type": "string"})  # of a path: `_plain`
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _plain(value: Any) -> Any:
    """Python values of numpy arrays and scalars (without an import of numpy), else text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value
