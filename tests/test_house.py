"""The house stands: imports go one way, rooms and functions stay small, what is public is documented."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# docs/architecture.md, Rooms: lower never imports higher. A room is a module of imutool or a folder of them.
TIERS = (
    ("array_types", "errors"),
    ("config", "file_location", "registry", "report", "units", "geometry", "processes", "recording"),
    ("inertial", "mcap_io", "bag"),
    ("noise", "cleaning"),
    ("sensor", "log_info", "exporting"),
    ("bias",),
    ("bias_start",),
    ("debiasing",),
    ("training", "evaluation", "conversion", "diagnosis", "blind_cases"),
    ("noise_identification",),
    ("viewing", "vio"),
    ("diagnosis_output",),
    ("fleet",),
    ("api",),
    ("cli", "__main__"),
)
LEVEL = {room: level for level, rooms in enumerate(TIERS) for room in rooms}
FOR_CONVERTERS = {"converters", "array_types", "errors", "geometry", "recording", "bag"}


def modules(folder: Path, package: str) -> dict[str, ast.Module]:
    """Every module below a package's folder, by its dotted name; relative imports are made absolute."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        parts = (*package.split("."), *path.relative_to(folder).with_suffix("").parts)
        is_package = parts[-1] == "__init__"
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in nodes(tree):
            if isinstance(node, ast.ImportFrom) and node.level:
                assert node.level == 1 or package == "imutool.converters", "a relative import stays in its folder"
                base = ".".join(parts[: -node.level])
                node.level, node.module = 0, f"{base}.{node.module}" if node.module else base
        found[".".join(parts[:-1] if is_package else parts)] = tree
    return found


@functools.cache
def nodes(tree: ast.Module) -> list[ast.AST]:
    """All nodes of a module, found once for all tests."""
    return list(ast.walk(tree))


def imports(tree: ast.Module, known: set[str]) -> set[str]:
    """Modules that a module imports anywhere in it, also inside functions; `from package import module` names the module."""
    found = set()
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            of = [f"{node.module}.{name.name}" for name in node.names]
            found |= {name if name in known else str(node.module) for name in of}
    return found


def room(module: str) -> str:
    """`imutool.mcap_io.read` is in the room `mcap_io`; the package itself, which holds the version alone, in none."""
    package, _, rest = module.partition(".")
    return rest.partition(".")[0] if package == "imutool" else ""


def against_the_order(found: dict[str, ast.Module]) -> list[str]:
    """Every import of a higher room by a lower one."""
    pairs = [(name, other) for name, tree in found.items() for other in imports(tree, set(found)) if room(name) and room(other)]
    return sorted(f"{name} imports {other}" for name, other in pairs if LEVEL[room(other)] > LEVEL[room(name)])


@functools.cache
def package() -> dict[str, ast.Module]:
    return modules(ROOT / "imutool", "imutool")


@functools.cache
def converters() -> dict[str, ast.Module]:
    return modules(ROOT / "converters", "imutool.converters")


def everything() -> dict[str, ast.Module]:
    return package() | converters()


SOURCES = [*sorted((ROOT / "imutool").rglob("*.py")), *sorted((ROOT / "converters").rglob("*.py"))]


def test_every_room_has_its_place_in_the_order() -> None:
    assert {room(name) for name in package()} - {""} <= set(LEVEL)


def test_the_architecture_shows_the_same_order() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.partition("| floor | room |")[2].partition("\n\n")[0].splitlines()[2:]
    floors: list[set[str]] = []
    for _, floor, named, *_ in (line.split("|") for line in table):
        floors += [set()] if floor.strip() else []
        floors[-1] |= set(re.findall(r"`imutool/(\w+)(?:/|\.py)`", named))
    assert floors == [set(rooms) - {"__main__"} for rooms in TIERS]


def test_lower_rooms_never_import_higher_ones() -> None:
    assert against_the_order(package()) == []


def test_the_order_is_really_looked_at() -> None:
    wrong = ast.parse(
        "def f():\n    from imutool import debiasing\n    import imutool.cli\n"
        "    from imutool.viewing.model.load_view import load\n"
    )
    planted = {**package(), "imutool.inertial.metrics": wrong}
    assert against_the_order(planted) == [
        "imutool.inertial.metrics imports imutool.cli",
        "imutool.inertial.metrics imports imutool.debiasing",
        "imutool.inertial.metrics imports imutool.viewing.model.load_view",
    ]


# Floors of rooms, lowest first.
FLOORS = {
    "imutool.diagnosis": (("result", "settings"), ("wording",), ("estimation",), ("localization",), ("",)),
    "imutool.converters._tables": (("text",), ("columns",), ("files",), ("recordings",)),
}


def floor_of(module: str, home: str) -> int:
    """Floor of a room whose name is the longest beginning of a module's name."""
    floors = {f"{home}.{name}".rstrip("."): level for level, names in enumerate(FLOORS[home]) for name in names}
    return floors[max((name for name in floors if f"{module}.".startswith(f"{name}.")), key=len)]


@pytest.mark.parametrize("home", FLOORS)
def test_lower_floors_of_a_room_never_import_higher_ones(home: str) -> None:
    inside = {name: tree for name, tree in everything().items() if name.startswith(f"{home}.")}
    pairs = [(name, other) for name, tree in inside.items() for other in imports(tree, set(everything())) if other in inside]
    assert len(pairs) > len(inside)
    assert [f"{name} imports {other}" for name, other in pairs if floor_of(other, home) > floor_of(name, home)] == []


def test_no_two_modules_import_each_other() -> None:
    """But for the package itself, which imports its public names when they are first used."""
    known = set(everything()) - {"imutool"}
    graph = {name: imports(tree, set(everything())) & known - {name} for name, tree in everything().items()}
    graphlib.TopologicalSorter(graph).prepare()


def test_converters_know_errors_recordings_and_bags_alone() -> None:
    for name, tree in converters().items():
        ours = {room(other) for other in imports(tree, set(package())) if other.partition(".")[0] == "imutool"}
        assert ours <= FOR_CONVERTERS, name


def test_converters_are_never_imported_by_name() -> None:
    for name, tree in package().items():
        assert not {other for other in imports(tree, set()) if room(other) == "converters"}, name


def test_no_room_is_a_drawer() -> None:
    names = {name.rpartition(".")[2].strip("_") for name in package() | converters()}
    assert not names & {"utils", "util", "helpers", "common", "misc"}


# ── the size of rooms, files and functions ──

MAX_MODULES, MAX_LINES, MAX_FUNCTION_LINES, MEDIAN_FUNCTION_LINES = 12, 300, 60, 7
CATALOGUES = {"imutool.cleaning.rules", "imutool.cli", "imutool.converters", "imutool.sensor.effects"}  # a file is an entry


@functools.cache
def folders() -> dict[str, list[str]]:
    """The modules that lie in each folder, by the folder's dotted name."""
    packages = {name.rpartition(".")[0] for name in everything()} & set(everything())
    return {package: [name for name in everything() if name.rpartition(".")[0] == package] for package in packages}


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Every function and method of a module."""
    yield from (node for node in nodes(tree) if isinstance(node, ast.FunctionDef))


def lines_of(node: ast.FunctionDef) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1


def test_a_room_has_at_most_a_dozen_modules() -> None:
    def counts(name: str, room: str) -> bool:
        return name not in folders() and (room not in CATALOGUES or is_private(name))

    sizes = {room: sum(counts(name, room) for name in names) for room, names in folders().items()}
    assert {room: size for room, size in sizes.items() if size > MAX_MODULES} == {}


def test_no_file_is_longer_than_a_reader_likes() -> None:
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert {str(path.relative_to(ROOT)): size for path, size in sizes.items() if size > MAX_LINES} == {}


def test_functions_are_short() -> None:
    sizes = [(f"{name}.{node.name}", lines_of(node)) for name, tree in everything().items() for node in functions(tree)]
    assert [(name, size) for name, size in sizes if size > MAX_FUNCTION_LINES] == []
    assert statistics.median(size for _, size in sizes) <= MEDIAN_FUNCTION_LINES


# ── what only some systems have: one module knows it ──

POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "posix", "syslog"}
POSIX_NAMES = {
    "os": {
        *("fork", "forkpty", "sync", "sysconf", "getuid", "geteuid", "getgid", "killpg", "setsid", "getpgid", "mkfifo", "nice"),
        *("chown", "lchown", "pread", "pwrite", "posix_fadvise", "posix_fallocate", "sendfile", "copy_file_range", "statvfs"),
        *("sched_getaffinity", "wait3", "wait4", "WNOHANG", "O_DIRECTORY", "O_NONBLOCK", "fchmod", "getloadavg", "pipe2"),
    },
    "signal": {"SIGKILL", "SIGALRM", "SIGHUP", "SIGPIPE", "SIGUSR1", "SIGCHLD", "setitimer", "alarm", "pause", "pthread_kill"},
}
SYSTEM = "imutool.processes.system"


def of_posix_alone(tree: ast.Module) -> Iterator[str]:
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in POSIX_MODULES)
        elif isinstance(node, ast.ImportFrom) and (node.module in POSIX_MODULES or node.module in POSIX_NAMES):
            names = {alias.name for alias in node.names}
            yield from names & POSIX_NAMES.get(node.module or "", names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in POSIX_NAMES.get(node.value.id, ()):
                yield f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("/dev/shm"):
            yield node.value
        elif isinstance(node, ast.keyword) and node.arg in {"pass_fds", "preexec_fn"}:
            yield f"{node.arg}="


def test_no_other_module_uses_what_only_posix_has() -> None:
    assert {name: used for name, tree in everything().items() if name != SYSTEM and (used := [*of_posix_alone(tree)])} == {}
    assert {*of_posix_alone(everything()[SYSTEM])} >= {"fcntl", "resource", "os.sysconf"}


# ── names and words ──

FIRST_LINE = 90  # characters of a docstring's first line


def is_overload(node: ast.FunctionDef | ast.ClassDef) -> bool:
    return any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


def is_private(name: str) -> bool:
    return any(part.startswith("_") and not part.startswith("__") for part in name.split("."))


def test_no_private_name_is_imported_from_another_room() -> None:
    """A private folder is open to all that lies next to it and in it."""
    found = []
    for name, tree in everything().items():
        home = name if name in folders() else name.rpartition(".")[0]
        home = home.partition("._")[0]
        for node in nodes(tree):
            if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "imutool":
                named = [f"{node.module}.{alias.name}" for alias in node.names]
                found += [f"{name}: {other}" for other in named if is_private(other) and not other.startswith(f"{home}.")]
    assert found == []


OF_NAMED_TUPLES = {"_asdict", "_fields", "_make", "_replace"}


def private_attributes(tree: ast.Module) -> Iterator[str]:
    """Private attributes that a module reads of others than itself, its parents and `os`, and does not define."""
    own = {node.name for node in nodes(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    own |= {node.attr for node in nodes(tree) if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)}
    own |= {node.id for node in nodes(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    for node in nodes(tree):
        if (
            isinstance(node, ast.Attribute)
            and is_private(node.attr)
            and node.attr not in own | OF_NAMED_TUPLES
            and ast.unparse(node.value) not in {"self", "cls", "super()", "os"}
        ):
            yield ast.unparse(node)


def test_no_private_attribute_is_read_from_another_module() -> None:
    assert {name: read for name, tree in everything().items() if (read := [*private_attributes(tree)])} == {}
    wrong = ast.parse("def f(log):\n    self._own = log._replace(a=1)\n    return self.log._source, log._own, self._parents")
    assert [*private_attributes(wrong)] == ["self.log._source"]


def test_a_module_says_in_one_line_what_it_holds() -> None:
    first = {name: (ast.get_docstring(tree) or "").partition("\n")[0] for name, tree in everything().items()}
    assert {name: line for name, line in first.items() if not 0 < len(line) <= FIRST_LINE} == {}


def test_every_public_function_and_class_says_in_one_line_what_it_is() -> None:
    found = []
    for name, tree in everything().items():
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not (node.name.startswith("_") or is_overload(node)):
                line = (ast.get_docstring(node) or "").partition("\n")[0]
                if not 0 < len(line) <= FIRST_LINE:
                    found.append(f"{name}.{node.name}: {line}")
    assert found == []


def test_what_is_public_is_documented() -> None:
    import imutool

    assert imutool.__all__ == sorted(imutool.__all__)
    assert [name for name in imutool.__all__ if not (getattr(imutool, name).__doc__ or "").strip()] == []


FIGURES_OF_SPEECH = {
    "again",
    "apart",
    "course",
    "faint",
    "felt",
    "held",
    "here",
    "least",
    "mine",
    "most",
    "one",
    "said",
    "theirs",
}
FIGURES_OF_SPEECH |= {"there", "thin", "this", "told", "untold", "ways"}


def test_no_local_name_is_a_figure_of_speech() -> None:
    found = []
    for name, tree in everything().items():
        for function in functions(tree):
            arguments = [argument.arg for argument in nodes(function) if isinstance(argument, ast.arg)]
            local = [node.id for node in nodes(function) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
            found += [f"{name}.{function.name}: {word}" for word in [*arguments, *local] if word in FIGURES_OF_SPEECH]
    assert found == []


def quaternions_without_order(tree: ast.Module) -> Iterator[str]:
    """Names q_AB of quaternions, of arguments, variables and fields, that do not say the order of their numbers."""
    named = (
        (node.arg if isinstance(node, ast.arg) else node.id) for node in nodes(tree) if isinstance(node, ast.arg | ast.Name)
    )
    yield from (name for name in named if re.fullmatch(r"q_\w+(?<!_wxyz)(?<!_xyzw)", name))


def test_quaternions_say_their_order() -> None:
    assert {name: found for name, tree in everything().items() if (found := [*quaternions_without_order(tree)])} == {}
    assert [*quaternions_without_order(ast.parse("def f(q_wb, q_wb_wxyz):\n    q_wa, q = q_wb, q_wb_wxyz"))][:2] == [
        "q_wb",
        "q_wa",
    ]


PRIVATE_PHRASES = ("what is told", "what is said", "is had", "cannot be had", "nothing of it", "is no longer told")


def test_no_private_language_in_docstrings() -> None:
    found = []
    for name, tree in everything().items():
        for node in nodes(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                text = (ast.get_docstring(node) or "").lower()
                found += [f"{name}: {phrase}" for phrase in PRIVATE_PHRASES if phrase in text]
    assert found == []


FLAG = re.compile(r"(?<![\w-])--[a-z]")
COMMAND = re.compile(r"`\w+ [^`]*`|imutool .*")  # with its flags


def flags_in_errors(tree: ast.Module) -> Iterator[str]:
    """Texts of errors that name a flag, but for those that spell out a whole command."""
    for node in nodes(tree):
        name = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
        if name.rpartition(".")[2].endswith("Error"):
            texts = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)]
            yield from (text for text in texts if FLAG.search(COMMAND.sub("", text)))


def test_errors_of_the_library_name_parameters_and_no_flags() -> None:
    library = {name: tree for name, tree in everything().items() if room(name) != "cli"}
    assert {name: found for name, tree in library.items() if (found := [*flags_in_errors(tree)])} == {}
    assert [*flags_in_errors(ast.parse('ConfigError("is there", fix="Add --overwrite")'))] == ["Add --overwrite"]


# ── the project's own files ──


def pins() -> Iterator[tuple[str, str]]:
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            name, _, version = line.partition("==")
            yield name, version


def test_constraints_are_exact_and_hold_no_local_version() -> None:
    found = dict(pins())
    assert found["torch"] == "2.13.0"
    assert list(found) == sorted(found)
    assert all(re.fullmatch(r"[0-9][0-9a-z.]*", version) for version in found.values())
    assert not found.keys() & {"imutool", "ahrs"}


def dependencies() -> set[str]:
    """Names of the packages in pyproject.toml, those of all extras included."""
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(line for name in extras for line in extras[name])]
    return {re.split(r"[<>=!~\[;]", line)[0].strip() for line in wanted} - {"imutool"}


def test_constraints_hold_all_we_depend_on() -> None:
    assert dependencies() <= dict(pins()).keys()


def test_what_is_imported_is_a_dependency_of_ours_and_not_of_another_package() -> None:
    from importlib.metadata import packages_distributions

    imported = {other.partition(".")[0] for tree in everything().values() for other in imports(tree, set())}
    known = {
        module: {re.sub(r"[-_.]+", "-", name).lower() for name in names} for module, names in packages_distributions().items()
    }
    others = imported - set(sys.stdlib_module_names) - {"imutool"}
    assert {module for module in others if not known.get(module, set()) & dependencies()} == set()


def test_a_list_of_arrays_names_no_length() -> None:
    """Arrays of several logs differ in length: a named one holds by chance, for the element that a check happens to draw."""
    aliases = {
        f"{module}.{target.id}": node.value
        for module, tree in package().items()
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }

    def shapes(annotation: ast.expr, names: dict[str, str]) -> Iterator[str]:
        for node in ast.walk(annotation):
            if isinstance(node, ast.Name) and names.get(node.id) in aliases:
                yield from shapes(aliases[names.pop(node.id)], names)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value

    named = []
    for module, tree in package().items():
        names = {name.rpartition(".")[2]: name for name in aliases if name.rpartition(".")[0] == module}
        for node in nodes(tree):
            if isinstance(node, ast.ImportFrom):
                names |= {name.asname or name.name: f"{node.module}.{name.name}" for name in node.names}
        for function in (node for node in nodes(tree) if isinstance(node, ast.FunctionDef)):
            for argument in function.args.args + function.args.kwonlyargs:
                for node in ast.walk(argument.annotation or ast.Constant(None)):
                    if (
                        isinstance(node, ast.Subscript)
                        and isinstance(node.value, ast.Name)
                        and node.value.id in {"Sequence", "list"}
                    ):
                        lengths = [shape.split()[0] for shape in shapes(node.slice, dict(names)) if " " in shape]
                        named += [f"{module}.{function.name}: {argument.arg} has {name}" for name in lengths if name == "n"]
    assert named == []
