"""Converters of raw data sets: one file each, `read(source) -> Iterator[Recording]`.

A converter is a module, in this folder or behind the entry-point group `imutool.converters`, that holds::

    read(source: Path) -> Iterator[Recording]                  every sequence of the source, one after the other

and, so that sequences convert in parallel, fail one by one and are recognised by `--format auto`::

    sequences(source: Path) -> list[Sequence]                  what could be read there; cheap; empty when nothing fits
    recognises(sequence: Sequence) -> bool                     whether it is really of this data set
    read_sequence(sequence: Sequence, *, images=True) -> Recording

One of a file format, whatever data set it is from, says `GENERAL = True`: it lists only what it recognises.

The first line of the module's docstring is its help. The data sets that ship have all four, and one contract test.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Sequence:
    """Sequence found but not read.

    `path` is a folder, an archive or a bag; `inside` is the sequence's folder in the archive. `losses` name what is left out
    of all sequences of the source.

    Small and picklable, so that it can be handed to a worker process.
    """

    name: str
    path: Path
    inside: str = ""
    losses: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.path}/{self.inside}" if self.inside else str(self.path)
