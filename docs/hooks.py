"""Pages that the build makes: the command-line reference from the commands, and the project's own files."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
INTRODUCTION = """# Commands

Every command has `--help`. With `--json FILE|-` a command writes its report as JSON;
`imutool schema NAME` prints the schema. [Exit codes](exit-codes.md) lists what each exit code means.
"""

EFFECTS = """# Effects

What distinguishes a real sensor from an ideal one: `imutool simulate` applies it, `imutool diagnose` finds it, bias
models correct it. Each is one file in `imutool/sensor/effects/`.
"""

PLACEHOLDERS = {"str": "TEXT", "int": "N", "float": "X", "Path": "PATH", "path": "PATH", "int range": "N"}


def on_files(files: Files, config: Any) -> Files:
    """Adds the generated pages."""
    for name, text in (
        ("reference/commands.md", commands()),
        ("reference/effects.md", effects()),
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


def commands() -> str:
    """Markdown with a section for each command, from the application itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import typer

        from imutool.cli import load

        root = typer.main.get_command(load())
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
    rows += [(f"`{', '.join([*p.opts, *p.secondary_opts])}{value_of(p)}`", help_of(p)) for p in options]
    lines += ["| argument or option | |", "|---|---|", *(f"| {left} | {cell(right)} |" for left, right in rows)]
    return "\n".join([*lines, "", *values_of(command), "", example_of(command), ""])


def cell(text: str) -> str:
    """Text for a table's cell."""
    return text.replace("|", "\\|").replace("\n", " ")


def value_of(option: Any) -> str:
    """Placeholder of an option's value; none for a flag."""
    if option.is_flag:
        return ""
    shown = option.metavar or re.sub(r"[<>]|list\[|\]", "", option.display_type(None))
    return f" {PLACEHOLDERS.get(shown.partition(' [')[0], shown)}"


def help_of(parameter: Any) -> str:
    """Help text, and the default where there is one that says something."""
    text = text_of(getattr(parameter, "help", "") or "")
    default = parameter.default
    if parameter.required or isinstance(default, bool) or not isinstance(default, str | int | float | Path):
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
