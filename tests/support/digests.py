"""Digests of files, to see whether they changed."""

from __future__ import annotations

from pathlib import Path

from imutool.mcap_io.storage.source import sha256


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    return {str(path.relative_to(folder)): sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}
