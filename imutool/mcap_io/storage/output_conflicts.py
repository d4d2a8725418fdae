"""Refuse outputs that would destroy something, before any work.

An existing file is refused without `overwrite`. Always refused are an input, by whatever name or link, two outputs that are
one file, and a suffix that does not fit. A device or a pipe is written to.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import combinations
from pathlib import Path

from imutool.errors import ConfigError, ImutoolError, UsageError
from imutool.file_location import Location, LogPath, exists, is_folder, location
from imutool.mcap_io.storage.local import is_stream

JSON, HTML, PNG, TOML = (".json",), (".html", ".htm"), (".png",), (".toml",)
RRD, MODEL, LOG = (".rrd",), (".safetensors",), (".mcap",)
ENTRIES = 10_000  # of a folder that are looked at to learn whether it tells capital from small letters


@dataclass(frozen=True)
class OutputFile:
    """File or object that is written, or a folder with the files that are written there.

    Attributes:
        parameter: Name of the parameter.
        place: File, folder or URL; None where it is not wanted.
        suffixes: Suffixes that fit the content; with none of them, any fits.
        files: Of a folder: patterns of the names written into it; (): the command makes the folder first.
        keeps: The function itself decides about an existing one, before its work.
        of_each: Of a folder that keeps other files: pattern of the names about an input, with {} for the input's name.
        may_be_folder: An existing folder gets a file of its own in it.
    """

    parameter: str
    place: LogPath | None
    suffixes: tuple[str, ...] = ()
    files: tuple[str, ...] | None = None
    keeps: bool = False
    of_each: str = ""
    may_be_folder: bool = False

    @property
    def where(self) -> Location:
        """Place as a path or a URL."""
        assert self.place is not None
        return location(self.place)


def check_outputs(outputs: Iterable[OutputFile], inputs: Iterable[object] = (), *, overwrite: bool = False) -> None:
    """Refuse outputs that would destroy something, before any work.

    Args:
        outputs: Outputs of one command; those without a place are skipped.
        inputs: Whatever else the command was given; existing files and folders among it are its inputs.
        overwrite: Allow outputs that exist and are no input.

    Raises:
        UsageError: a suffix does not fit what is written.
        ConfigError: an output exists, is an input, or is another output.
    """
    wanted = [output for output in outputs if output.place is not None]
    for output in wanted:
        _check_name(output)
    files = [output for output in wanted if not (isinstance(output.where, Path) and is_stream(output.where))]
    read = [place for given in inputs for place in _places(given)]
    for output in files:
        _refuse_input(output, read, files)
    for first, second in combinations(files, 2):
        if _collide(first, second):
            what = f"`{first.parameter}` and `{second.parameter}` are the same file"
            raise ConfigError(what, where=second.place, fix="Give each output a name of its own")
    made = [Path(output.where).absolute() for output in files if output.files == () and isinstance(output.where, Path)]
    for output in files:
        if output.files is None and not (output.may_be_folder and is_folder(output.where)):
            _refuse_missing_folder(output.where, made)
        if not output.keeps:
            _refuse_existing_output(output, overwrite)
        elif output.of_each and not overwrite:
            _refuse_existing_files(output, [place.stem for place in read])


def refuse_existing(path: Location, *, overwrite: bool, choose: str = "Choose another name") -> None:
    """Refuse a target that is a folder, or exists without `overwrite`; a device may exist.

    `choose` tells how to give another name.

    Raises:
        ConfigError: it is a folder, a disk or a socket, or it exists.
    """
    if is_folder(path):
        raise ConfigError("the target is a folder", where=path, expected="the name of a file")
    if not isinstance(path, Path):
        is_taken = exists(path)
    elif is_stream(path):
        return
    elif path.is_block_device() or path.is_socket():
        raise ConfigError("the target is a disk or a socket", where=path, expected="the name of a file")
    else:
        is_taken = os.path.lexists(path)  # a link to nothing is there too
    if is_taken and not overwrite:
        raise ConfigError("the target exists", where=path, fix=f"{choose}, or add `overwrite=True`")


def _check_name(output: OutputFile) -> None:
    """Refuse a file whose suffix does not fit, or that is named as a folder.

    Raises:
        UsageError: with the suffix, or the slash.
    """
    place = output.where
    is_in_folder = output.files is not None or (output.may_be_folder and is_folder(place))
    if not is_in_folder and str(output.place).endswith(("/", os.sep)):
        fix = f"Write the file's own name behind the slash, as {output.place}NAME{next(iter(output.suffixes), '')}"
        raise UsageError("ends in a slash, as the name of a folder", where=output.place, expected="the name of a file", fix=fix)
    if not output.suffixes or place.suffix.lower() in (*output.suffixes, ""):  # a name without a suffix claims nothing
        return
    if isinstance(place, Path) and (is_stream(place) or (output.may_be_folder and place.is_dir())):
        return
    raise UsageError(
        f"the suffix {place.suffix!r} does not fit what is written",
        where=place,
        expected=" or ".join(output.suffixes),
        fix=f"Choose a name for `{output.parameter}` that ends in {output.suffixes[0]}",
    )


def _places(given: object) -> list[Location]:
    """Existing files and folders, and URLs, in an argument: itself, in a list, or as TOPIC=FILE."""
    if isinstance(given, str):
        words = [given, given.partition("=")[2]]
        return [place for word in words if word for place in _place(word)]
    if isinstance(given, Sequence):
        return [place for item in given for place in _places(item)]
    if isinstance(given, Path):
        return [given] if _exists(given) else []
    return [given] if hasattr(given, "fs") else []  # type: ignore[list-item]  # a URL's path; its package stays unimported


def _place(word: str) -> list[Location]:
    if "://" not in word:
        return [Path(word)] if _exists(Path(word)) else []
    try:
        return [location(word)]
    except ImutoolError:  # the command says what is wrong with it
        return []


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long, or with a NUL: a word, not a file
        return False


def _refuse_input(output: OutputFile, inputs: Sequence[Location], outputs: Sequence[OutputFile]) -> None:
    """Refuse an output that would replace an input or a file in a folder of inputs."""
    place = output.where
    for source in inputs:
        if not isinstance(place, Path) or not isinstance(source, Path):
            hit = place == source
        elif output.files is not None:
            hit = not source.is_dir() and _is_file_of(source, place, output.files)
        elif source.is_dir():
            hit = _lies_in(place, source) and not any(_lies_in(place, o.where) for o in outputs if o.files is not None)
        else:
            hit = place.exists() and place.samefile(source)
        if hit:
            raise ConfigError(
                f"`{output.parameter}` would replace the source {source}", where=place, expected="another file than any input"
            )


def _is_file_of(path: Path, folder: Path, patterns: Sequence[str]) -> bool:
    """Whether a file is one of those that are written into a folder."""
    inside = folder.is_dir() and path.parent.exists() and path.parent.samefile(folder)
    return inside and any(fnmatchcase(path.name, pattern) for pattern in patterns)


def _lies_in(path: Path | Location, folder: Location) -> bool:
    if not isinstance(path, Path) or not isinstance(folder, Path):
        return False
    return path.exists() and path.resolve().is_relative_to(folder.resolve())


def _collide(first: OutputFile, second: OutputFile) -> bool:
    """Whether two outputs are one file, or a file is one of those written into a folder."""
    a, b = first.where, second.where
    if not isinstance(a, Path) or not isinstance(b, Path):
        return a == b
    if first.files is not None and second.files is not None:
        return _same(a, b) and bool(set(first.files) & set(second.files) or {"*"} & {*first.files, *second.files})
    if first.files is None and second.files is None:
        return _same(a, b)
    folder, files, file = (a, first.files, b) if first.files is not None else (b, second.files, a)
    return _same(file, folder) or (_same(file.parent, folder) and any(fnmatchcase(file.name, p) for p in files or ()))


def _same(a: Path, b: Path) -> bool:
    """Whether two paths are one file, also one that does not exist yet."""
    if a.exists() and b.exists():
        return a.samefile(b)
    first, second = Path(os.path.realpath(a)), Path(os.path.realpath(b))
    if first == second:
        return True
    alike = folded(first.name) == folded(second.name)
    return alike and _same(first.parent, second.parent) and ignores_case(first.parent)


def folded(name: str) -> str:
    """Name without case and Unicode form: some systems take equal ones for one file."""
    return unicodedata.normalize("NFC", name).casefold()


def ignores_case(folder: Path) -> bool:
    """Whether names that differ by capital letters alone are one file in a folder."""
    try:
        names = [entry.name for entry, _ in zip(os.scandir(folder), range(ENTRIES), strict=False)]
    except OSError:
        return False
    name = next((name for name in names if name.swapcase() != name and name.swapcase() not in names), None)
    if name is None:
        return folder != folder.parent and folder.name.swapcase() != folder.name and _alias(folder)
    return _alias(folder / name)


def _alias(path: Path) -> bool:
    other = path.with_name(path.name.swapcase())
    return other.exists() and path.exists() and other.samefile(path)


def _refuse_existing_output(output: OutputFile, overwrite: bool) -> None:
    place = output.where
    if output.files is None:
        if not (output.may_be_folder and is_folder(place)):
            refuse_existing(place, overwrite=overwrite)
        return
    if exists(place) and not is_folder(place):
        raise ConfigError("is a file", where=place, expected="a folder, which need not exist")
    if isinstance(place, Path) and place.is_dir() and not overwrite:
        taken = sorted(e.name for e in place.iterdir() if any(fnmatchcase(e.name, pattern) for pattern in output.files))
        if taken:
            raise ConfigError("the target exists", where=place / taken[0], fix="Choose another folder, or add `overwrite=True`")


def _refuse_existing_files(output: OutputFile, inputs: Sequence[str]) -> None:
    """Refuse a folder with files about one of these inputs."""
    folder = output.where
    patterns = [output.of_each.format(re.sub(r"[^\w.+-]", "_", name)) for name in inputs]
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    for name in (name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)):
        raise ConfigError("the target exists", where=folder / name, fix="Choose another folder, or add `overwrite=True`")


def _refuse_missing_folder(place: Location, made: Sequence[Path]) -> None:
    """Refuse a file whose folder is not there or cannot be written, unless the command makes that folder first."""
    if not isinstance(place, Path):
        return
    folder = place.absolute().parent
    if not folder.is_dir() and folder in made:
        return
    if not folder.is_dir():
        raise ConfigError(
            f"cannot be written (no folder {folder})", where=place, fix="Make the folder first, or choose another"
        )
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"cannot be written (no permission in {folder})", where=place, fix="Choose another folder")
