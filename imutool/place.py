"""Where files lie: `pathlib.Path` on this machine, `upath.UPath` for s3://, gs://, az:// and memory://."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from imutool.errors import ConfigError

if TYPE_CHECKING:
    Place: TypeAlias = Path
else:
    Place: TypeAlias = Any  # a UPath of a store is no pathlib.Path, though it does what one does


def place(text: str) -> Place:
    """The place that a path or URL names.

    Raises:
        ConfigError: a URL, and universal-pathlib or the library of its store is not installed.
    """
    if "://" not in text:
        return Path(text)
    try:
        from upath import UPath

        found: Place = UPath(text)
    except (ImportError, ValueError) as error:
        raise ConfigError(f"cannot be opened ({error})", where=text, fix="Install imutool[cloud]") from error
    return found
