"""Pages that the build makes: the command-line reference from the commands, and the project's own files."""

from __future__ import annotations

import inspect
import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from mkdocs.structure.files import File, Files

from imutool.cli.parameters import value_of
from imutool.config import Settings

ROOT = Path(__file__).parents[1]
INTRODUCTION = """# Commands

Every command has `--help`. With `--json FILE|-` a command writes its report as JSON;
`imutool schema NAME` prints the schema. [Exit codes](exit-codes.md) lists what each exit code means.
"""

EFFECTS = """# Effects

What distinguishes a real sensor from an ideal one: `imutool simulate` applies it, `imutool diagnose` finds it, bias
models correct it. Each is one file in `imutool/sensor/effects/`.
"""

SETTINGS = """# Settings

`imutool train`, `diagnose` and `vio` take `--set KEY=VALUE`, more than once. `train` and `diagnose` also take a file with
the same keys, `--config FILE.toml`. Values are those of TOML; the shell wants quotes around lists:
`--set 'gyro_window_s=[1, 4, 15]'`. A key that does not exist is refused, and the nearest is named.
"""


def on_files(files: Files, config: Any) -> Files:
    """Adds the generated pages."""
    for name, text in (
        ("reference/commands.md", commands()),
        ("reference/effects.md", effects()),
        ("reference/settings.md", "\n".join([SETTINGS, *settings()])),
        *project_files(),
    ):
        files.append(File.generated(config, name, content=text))
    return files


def project_files() -> Iterator[tuple[str, str]]:
    """CONTRIBUTING.md and CHANGELOG.md; their links to pages are relative to the docs folder."""
    for name in ("CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        yield name.lower(), re.sub(r"\]\(docs/", "](", text)


def effects() -> str:
    """Markdown with a table of the effects, from the catalogue itself."""
    from imutool.sensor import catalogue

    rows = ["| effect | equation | parameters | observable if |", "|---|---|---|---|"]
    for effect in catalogue.effects():
        units = dict.fromkeys(parameter.unit for parameter in effect.parameters)
        parameters = f"{len(effect.parameters)} ({', '.join(units)})"
        rows.append(" | ".join(("", f"`{effect.name}`", f"`{effect.equation}`", parameters, effect.observable_if, "")).strip())
    return "\n".join([EFFECTS, *rows, ""])


def settings() -> Iterator[str]:
    """A section for the settings of each command and each method, from their classes."""
    from imutool import registry
    from imutool.diagnosis.settings import DiagnoseSettings
    from imutool.training.settings import TrainSettings
    from imutool.vio.run import VioSettings

    yield from tables("imutool train", TrainSettings)
    for method in registry.names("imutool.networks"):
        network = registry.load("imutool.networks", method).Network
        if network.iterative:
            yield from tables(f"imutool train --method {method}", registry.load("imutool.bias", method).Config)
            yield "".join(f"- Its default of `{name}` is `{value}`.\n" for name, value in network.prefers.items())
    yield from tables("imutool diagnose", DiagnoseSettings)
    yield from tables("imutool vio", VioSettings)


def tables(title: str, kind: type[Any], prefix: str = "") -> Iterator[str]:
    """A table of a class of settings, and one for each group in it."""
    yield f"{'###' if prefix else '##'} {title}\n\n{(inspect.getdoc(kind) or '').partition(chr(10))[0]}\n"
    groups = {}
    rows = ["| setting | default | meaning |", "|---|---|---|"]
    for field in msgspec.structs.fields(kind):
        if isinstance(field.type, type) and issubclass(field.type, Settings):
            groups[field.name] = field.type
        else:
            default = "" if field.default in (None, msgspec.UNSET, msgspec.NODEFAULT) else f"`{toml(field.default)}`"
            rows.append(f"| `{prefix}{field.name}` | {default} | {cell(meaning_of(kind, field.name))} |")
    yield "\n".join([*rows, ""]) if len(rows) > 2 else ""
    for name, group in groups.items():
        yield from tables(f"`{prefix}{name}`", group, f"{prefix}{name}.")


def toml(value: Any) -> str:
    """A default as it is written in a file of settings."""
    return json.dumps(value, ensure_ascii=False)


def meaning_of(kind: type[Any], name: str) -> str:
    """The comment next to a setting in the source of its class."""
    sources = (inspect.getsource(each) for each in kind.__mro__ if name in vars(each).get("__annotations__", {}))
    found = re.search(rf"^    {name}: .*?  # (.*)$", next(sources), re.MULTILINE)
    return found[1] if found else ""


def commands() -> str:
    """Markdown with a section for each command, from the application itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import typer

        from imutool.cli import load
        from imutool.cli.overview import COMMANDS

        root: Any = typer.main.get_command(load())
    root.commands = {name: root.commands[name] for name in COMMANDS}  # in the order of --help
    return "\n".join([INTRODUCTION, *sections(root, "imutool")])


def sections(group: Any, name: str) -> Iterator[str]:
    """One section for each command of a group, and of the groups below it."""
    for word, command in group.commands.items():
        full = f"{name} {word}"
        if hasattr(command, "commands"):
            yield f"## {full}\n\n{text_of(command.help)}\n"
            yield from sections(command, full)
        else:
            yield section(command, full)


def section(command: Any, name: str) -> str:
    """What a command does, how it is called, its arguments, options and values."""
    given = [p for p in command.params if not getattr(p, "hidden", False)]
    arguments = [p for p in given if p.param_type_name == "argument"]
    options = [p for p in given if p.param_type_name == "option"]
    words = [f"{p.metavar or p.name}{'...' * (p.nargs == -1)}" for p in arguments]
    words = [word if p.required else f"[{word}]" for p, word in zip(arguments, words, strict=True)]
    lines = [f"## {name}", "", text_of(command.help), "", "```console", f"$ {' '.join([name, '[OPTIONS]', *words])}", "```", ""]
    rows = [(f"`{p.metavar or p.name}`", help_of(p)) for p in arguments]
    rows += [(f"`{', '.join([*p.opts, *p.secondary_opts])} {value_of(p)}".rstrip() + "`", help_of(p)) for p in options]
    lines += ["| argument or option | |", "|---|---|", *(f"| {left} | {cell(right)} |" for left, right in rows)]
    return "\n".join([*lines, "", *values_of(command), "", example_of(command), ""])


def cell(text: str) -> str:
    """Text for a table's cell."""
    return text.replace("|", "\\|").replace("\n", " ")


def help_of(parameter: Any) -> str:
    """Help text, and the default where there is one that says something."""
    text = text_of(getattr(parameter, "help", "") or "")
    default = parameter.default
    if parameter.required or default == "" or isinstance(default, bool) or not isinstance(default, str | int | float | Path):
        return text
    return f"{text} Default: `{getattr(default, 'value', default)}`."


def values_of(command: Any) -> list[str]:
    """What `--format`, `--method` and `--rule` can name: one line each."""
    from imutool import registry

    found = getattr(type(command), "values", None)
    if found is None:
        return []
    group, option = found
    return [f"Values of `{option}`:", "", *(f"- `{name}`: {registry.summary(group, name)}" for name in registry.names(group))]


def example_of(command: Any) -> str:
    """The example below a command's help."""
    return text_of(command.epilog or "")


def text_of(text: str | None) -> str:
    """Help text in Markdown: rich's bold becomes code."""
    return re.sub(r"\[bold\](.*?)\[/\]", r"`\1`", (text or "").strip())
