"""Metadata that depends on where the project is published: links and addresses, from the variable IMUTOOL_REPOSITORY.

A package index shows README.md away from the repository, where relative links lead nowhere. With
IMUTOOL_REPOSITORY=https://HOST/OWNER/NAME the links of the built package are absolute, at the tag of the version, and the
project's addresses are filled in. Without it the text stays as it is.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

REPOSITORY = "IMUTOOL_REPOSITORY"
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)")
VERSION = re.compile(r'^__version__ = "([^"]+)"', re.MULTILINE)


def absolute(text: str, repository: str, version: str) -> str:
    """Markdown whose relative links lead into the repository at the tag of a version; pictures to their raw files."""

    def link(match: re.Match[str]) -> str:
        picture, words, path = match.groups()
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/v{version}/{path})"

    return LINK.sub(link, text)


class CustomMetadataHook(MetadataHookInterface):
    """Readme and project addresses."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Fill in the readme, and the addresses where they are known."""
        root = Path(self.root)
        text = (root / "README.md").read_text(encoding="utf-8")
        repository = os.environ.get(REPOSITORY, "").rstrip("/")
        if repository:
            found = VERSION.search((root / "imutool" / "__init__.py").read_text(encoding="utf-8"))
            assert found is not None, "the package names its version"
            text = absolute(text, repository, found[1])
            metadata["urls"] = {
                "Source": repository,
                "Documentation": f"{repository}/tree/v{found[1]}/docs",
                "Changelog": f"{repository}/blob/v{found[1]}/CHANGELOG.md",
                "Issues": f"{repository}/issues",
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
