"""What a release promises: links of the package, container and cluster files, reports, and formats of the version before."""

from __future__ import annotations

import json
import re
import runpy
import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest
import yaml
from support.report_schema import assert_valid

import imutool
from imutool.errors import ConfigError
from imutool.fleet.journal import Journal
from imutool.fleet.task import Settings
from imutool.report import REPORTS, json_schema

ROOT = Path(__file__).parents[1]
FIXTURES = ROOT / "tests" / "fixtures" / "0.1.0"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
HOME = "https://forge.invalid/who/imutool"

# Of the API of Kubernetes and KubeRay, the fields that the examples use; any other is a misspelling.
TEXTS = {"type": "object", "additionalProperties": {"type": "string"}}
SECURITY = {
    "type": "object",
    "properties": {
        "runAsNonRoot": {"const": True},
        "runAsUser": {"type": "integer", "minimum": 1},
        "allowPrivilegeEscalation": {"const": False},
        "capabilities": {"type": "object"},
    },
    "additionalProperties": False,
}
QUANTITIES = {
    "type": "object",
    "additionalProperties": False,
    "properties": {"cpu": {"pattern": r"^\d+m?$"}, "memory": {"pattern": r"^\d+[MG]i$"}},
}
CONTAINER = {
    "type": "object",
    "required": ["name", "image", "resources"],
    "properties": {
        "name": {"pattern": "^[a-z0-9-]+$"},
        "image": {"pattern": ":[0-9][0-9.]+$"},  # a version, not `latest`
        "args": {"type": "array", "items": {"type": "string"}},
        "envFrom": {"type": "array", "items": {"required": ["secretRef"]}},
        "resources": {
            "type": "object",
            "properties": {"requests": QUANTITIES, "limits": QUANTITIES},
            "required": ["requests", "limits"],
        },
        "securityContext": SECURITY,
    },
    "additionalProperties": False,
}
TEMPLATE = {
    "type": "object",
    "required": ["spec"],
    "properties": {
        "spec": {
            "type": "object",
            "required": ["containers", "securityContext"],
            "properties": {
                "containers": {"type": "array", "minItems": 1, "items": CONTAINER},
                "securityContext": SECURITY,
                "restartPolicy": {"enum": ["Never", "OnFailure"]},
            },
            "additionalProperties": False,
        }
    },
}
HEAD = {
    "type": "object",
    "required": ["rayStartParams", "template"],
    "properties": {"rayStartParams": TEXTS, "template": TEMPLATE},
    "additionalProperties": False,
}
COUNT = {"type": "integer", "minimum": 0}
GROUP = {
    "type": "object",
    "required": ["groupName", "rayStartParams", "template"],
    "properties": {
        **HEAD["properties"],  # type: ignore[dict-item]
        "groupName": {"type": "string"},
        **dict.fromkeys(("replicas", "minReplicas", "maxReplicas"), COUNT),
    },
    "additionalProperties": False,
}
CLUSTER = {
    "type": "object",
    "required": ["headGroupSpec", "workerGroupSpecs", "rayVersion"],
    "properties": {
        "rayVersion": {"type": "string"},
        "headGroupSpec": HEAD,
        "workerGroupSpecs": {"type": "array", "minItems": 1, "items": GROUP},
    },
    "additionalProperties": False,
}
SPECS: dict[str, dict[str, Any]] = {
    "Job": {
        "required": ["template"],
        "properties": {"backoffLimit": COUNT, "template": TEMPLATE},
        "additionalProperties": False,
    },
    "RayJob": {
        "required": ["entrypoint", "rayClusterSpec"],
        "properties": {
            "entrypoint": {"type": "string"},
            "shutdownAfterJobFinishes": {"type": "boolean"},
            "ttlSecondsAfterFinished": COUNT,
            "rayClusterSpec": CLUSTER,
        },
        "additionalProperties": False,
    },
}
VERSIONS = {"Job": "batch/v1", "RayJob": "ray.io/v1"}


def test_the_links_of_the_package_are_absolute_where_the_repository_is_known() -> None:
    hook = SimpleNamespace(**runpy.run_path(str(ROOT / "hatch_build.py")))
    text = hook.absolute((ROOT / "README.md").read_text(), HOME, "0.1.0")
    assert f"![A EuRoC flight in the viewer]({HOME}/raw/v0.1.0/docs/images/viewer-signals-dark.png)" in text
    assert f"]({HOME}/blob/v0.1.0/docs/viewing.md)" in text
    assert not re.findall(r"\]\((?!https?:|#)", text)
    assert hook.absolute(text, HOME, "0.1.0") == text


def test_the_metadata_say_what_an_index_asks_for() -> None:
    project, sdist = PROJECT["project"], PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert project["license"] == "Apache-2.0"  # SPDX
    assert not [c for c in project["classifiers"] if c.startswith("License ::")]  # superseded by the expression
    assert {f"Operating System :: {name}" for name in ("POSIX :: Linux", "MacOS", "Microsoft :: Windows")} <= set(
        project["classifiers"]
    )
    assert {"/docs", "/hatch_build.py", "/CHANGELOG.md", "/CITATION.cff", "/containers"} <= set(sdist)
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (cited["version"], cited["license"]) == (imutool.__version__, project["license"])


@pytest.mark.parametrize("name", ["job.yaml", "rayjob.yaml"])
def test_a_cluster_file_is_valid(name: str) -> None:
    job = yaml.safe_load((ROOT / "containers" / name).read_text())
    assert set(job) == {"apiVersion", "kind", "metadata", "spec"}
    assert job["apiVersion"] == VERSIONS[job["kind"]]
    jsonschema.validate(job["spec"], {"type": "object", **SPECS[job["kind"]]})
    template = job["spec"].get("template") or job["spec"]["rayClusterSpec"]["headGroupSpec"]["template"]
    words = job["spec"].get("entrypoint", "").split()[1:] or template["spec"]["containers"][0]["args"]
    assert_parses(words)
    assert json.dumps(job).count(f":{imutool.__version__}") >= 1


def assert_parses(words: list[str]) -> None:
    """The command line of a file is one that imutool takes."""
    import typer

    from imutool.cli import load

    group = typer.main.get_command(load()).commands["fleet"]  # type: ignore[attr-defined]
    group.commands[words[1]].make_context("fleet", words[2:], resilient_parsing=False)


def test_the_container_runs_a_fleet_as_nobody_special() -> None:
    lines = (ROOT / "containers" / "Containerfile").read_text().splitlines()
    copied = {word for line in lines if line.startswith("COPY") for word in line.split()[1:-1]}
    assert all((ROOT / name).exists() for name in copied)
    users = [line.split()[1] for line in lines if line.startswith("USER")]
    assert users == ["10001"]
    assert not [line for line in lines if line.startswith("FROM") and (":" not in line or "latest" in line)]
    extras = set(re.findall(r"\[([a-z,]+)\]", "\n".join(line for line in lines if "imutool[" in line))[0].split(","))
    assert extras <= set(PROJECT["project"]["optional-dependencies"])
    assert {"fleet", "cloud"} <= extras


@pytest.mark.parametrize("name", sorted(REPORTS))
def test_a_report_has_a_version(name: str) -> None:
    schema = json.dumps(json_schema(name))
    assert re.search(r'"imutool\.[a-z-]+/\d+"', schema)


# ── formats of 0.1.0, as that version wrote them (tests/fixtures/README.md) ──


def test_reports_of_the_release_are_valid_today() -> None:
    reports = sorted(FIXTURES.glob("*.json"))
    assert len(reports) >= 3
    for path in reports:
        assert_valid(json.loads(path.read_text()))


def test_a_model_of_the_release_is_read_and_gives_its_numbers() -> None:
    model = imutool.load_model(FIXTURES / "linear.safetensors")
    expected = json.loads((FIXTURES / "linear_bias.txt").read_text())
    imu = imutool.example_recording(duration_s=4.0).imu
    debiased = imutool.debias(imutool.Recording("made up", imu), model, init="prior")  # of the file alone, not of the filter
    assert debiased.bias[-1].tolist() == pytest.approx(expected, abs=1e-9)


def test_a_journal_of_the_release_is_resumed_by_it_and_refused_by_others(tmp_path: Path) -> None:
    shutil.copy(FIXTURES / "fleet.journal", tmp_path)
    settings = Settings(command="info")
    if imutool.__version__ != "0.1.0":
        with pytest.raises(ConfigError), Journal(tmp_path, settings, resume=True):
            pass
        return
    with Journal(tmp_path, settings, resume=True) as journal:
        result = journal.done("0123456789abcdef")
        assert result is not None
        assert (result.target, result.status, result.messages) == ("flight_1.json", "ok", 8002)
        assert journal.ours("flight_1.json")
