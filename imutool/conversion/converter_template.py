"""Template of a converter: a package with its entry point, and a test that passes at once."""

from __future__ import annotations

import re
from pathlib import Path

from imutool import registry
from imutool.conversion.workers import GROUP
from imutool.errors import ConfigError
from imutool.mcap_io.storage.target import FolderTarget, writing

PROJECT = """\
[build-system]
requires = ["hatchling>=1.26"]
build-backend = "hatchling.build"

[project]
name = "imutool-@NAME@"
version = "0.1.0"
dependencies = ["imutool", "numpy"]

[project.entry-points."imutool.converters"]
@NAME@ = "imutool_@NAME@"

[tool.hatch.build.targets.wheel]
only-include = ["imutool_@NAME@.py"]
"""

MODULE = '''\
"""Recordings of @NAME@: replace this line, it is the help of `imutool convert`.

The example reads a text file that begins with `# @NAME@`, then rows of: time in s, rates in deg/s, accelerations in g.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imutool.converters import Sequence
from imutool.errors import DataError
from imutool.recording import Imu, Recording

FIRST_LINE = b"# @NAME@"  # what only files of this kind begin with
GRAVITY_M_S2 = 9.80665


def sequences(source: Path) -> list[Sequence]:
    """What could be read there: the file itself, or files in the folder. Cheap; empty when nothing fits."""
    files = sorted(source.glob("*.txt")) if source.is_dir() else [source]
    return [Sequence(path.stem, path) for path in files if _begins_rightly(path)]


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is really of this kind; look at the content, not at the file's name."""
    return _begins_rightly(sequence.path)


def read_sequence(sequence: Sequence, *, images: bool = True) -> Recording:
    """The recording: stamps in ns, rates in rad/s, specific force in m/s^2 (at rest it reads +g up)."""
    try:
        rows = np.loadtxt(sequence.path, ndmin=2)
    except ValueError as error:
        raise DataError(str(error), where=sequence.path, expected="rows of seven numbers") from error
    if rows.shape[1:] != (7,):
        raise DataError(f"has {rows.shape[1]} columns", where=sequence.path, expected="7")
    t_ns = np.rint(rows[:, 0] * 1e9).astype(np.int64)
    imu = Imu(t_ns, np.radians(rows[:, 1:4]), rows[:, 4:7] * GRAVITY_M_S2)
    # Claim only what the file itself says. True poses go to Recording(truths={"/ground_truth/pose": Poses(...)}).
    metadata = {"imutool": {"format": "@NAME@", "sequence": sequence.name}}
    return Recording(sequence.name, imu, metadata=metadata, source=sequence.path.name)


def read(source: Path) -> Iterator[Recording]:
    """Recordings of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _begins_rightly(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(FIRST_LINE)) == FIRST_LINE
    except OSError:
        return False
'''

TEST = '''\
"""The converter of @NAME@ on a made-up file."""

from __future__ import annotations

import numpy as np
import pytest

import imutool_@NAME@ as converter
from imutool.errors import DataError

ROWS = [(10.0 + 0.005 * n, 90.0, 0.0, 0.0, 0.0, 0.0, 1.0) for n in range(50)]


def write_file(folder, rows=ROWS):
    path = folder / "run1.txt"
    path.write_text("\\n".join(["# @NAME@", *(" ".join(map(str, row)) for row in rows)]))
    return path


def test_values_arrive_in_si_units(tmp_path):
    (recording,) = converter.read(write_file(tmp_path))
    assert recording.name == "run1"
    assert recording.imu.t_ns[1] - recording.imu.t_ns[0] == 5_000_000
    np.testing.assert_allclose(recording.imu.gyro[0], [np.pi / 2, 0.0, 0.0])
    np.testing.assert_allclose(recording.imu.accel[0], [0.0, 0.0, 9.80665])


def test_a_file_of_another_kind_is_not_recognised(tmp_path):
    (tmp_path / "notes.txt").write_text("something else")
    assert converter.sequences(tmp_path) == []


def test_a_broken_row_is_named(tmp_path):
    with pytest.raises(DataError, match="run1"):
        list(converter.read(write_file(tmp_path, [*ROWS, (1.0, 2.0)])))
'''


def write_template(name: str, folder: Path) -> list[Path]:
    """Write a converter's package into a new folder; return its files.

    Raises:
        ConfigError: the name is no Python name or taken, or the folder exists or cannot be made.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ConfigError(f"{name!r}", where="name", expected="lower-case letters, digits and underscores")
    if name in (taken := ["auto", *registry.names(GROUP)]):
        raise ConfigError(f"{name!r} is taken", where="name", expected=f"none of {', '.join(taken)}")
    texts = {"pyproject.toml": PROJECT, f"imutool_{name}.py": MODULE, f"test_{name}.py": TEST}
    if folder.exists():
        raise ConfigError("exists", where=folder, fix="Choose another folder")
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FolderTarget(folder, folder, signed="", holds="", overwrite=False) as partial:
            for file, text in texts.items():
                (partial / file).write_text(text.replace("@NAME@", name), encoding="utf-8")
    return [folder / file for file in texts]
