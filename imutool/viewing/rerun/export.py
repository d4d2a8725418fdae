"""The viewer and a recording as a folder that any web server can serve, and no page of which asks anybody else."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from imutool.errors import ConfigError
from imutool.viewing.model.output import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun.sdk import need_sdk
from imutool.viewing.rerun.web import FILES, PAGE, site


def refuse(folder: Path, *, overwrite: bool = False) -> None:
    """Nothing, where the folder may be written; to be asked before the work.

    Raises:
        ConfigError: a file of that name, a folder of anything else, or such a folder already (without `overwrite`).
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ConfigError("is a file", where=folder, expected="a folder, which need not exist")
    others = sorted({path.name for path in folder.iterdir()} - set(FILES))
    if others:
        raise ConfigError(f"holds something else ({others[0]})", where=folder, fix="Choose another folder")
    if not overwrite and any(folder.iterdir()):
        raise ConfigError("the target exists", where=folder, fix="Choose another folder, or add --overwrite")


def export(
    logs: Sequence[RunData], folder: Path, *, source: bool = True, at_s: float | None = None, overwrite: bool = False
) -> Output:
    """Writes the folder, whole or not at all: the page, the viewer's two files and the recording.

    Raises:
        ConfigError: as `refuse`, Rerun is not installed or does not run, or the system refuses to write.
    """
    refuse(folder, overwrite=overwrite)
    need_sdk()
    files = site(logs, source=source, at_s=at_s)
    place = folder.absolute()  # "." has no name of its own
    beside = place.with_name(f".{place.name}.{os.getpid()}.{secrets.token_hex(4)}.partial")
    with _told(folder):
        try:
            beside.mkdir(parents=True)
            for name, content in files.items():
                (beside / name).write_bytes(content)
            refuse(folder, overwrite=overwrite)
            _put(beside, place)
        finally:
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(beside)
    served = f"python -m http.server --bind 127.0.0.1 --directory {folder}"
    return Output("folder", str(folder / PAGE), f"Exported {folder} for any web server, for instance: {served}")


def _put(made: Path, place: Path) -> None:
    """Moves a folder to its place; one that is there already goes when the new one has come, and comes back if it cannot."""
    if not place.exists():
        made.rename(place)
        return
    old = made.with_suffix(".replaced")
    place.rename(old)
    try:
        made.rename(place)
    except BaseException:
        old.rename(place)
        raise
    shutil.rmtree(old)


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", where=folder, fix="Choose another place") from error
