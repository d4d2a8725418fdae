"""Tables of text, as loggers write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def write_csv(path: Path, names: Sequence[str], columns: Sequence[np.ndarray], mark: str = ",", above: str = "") -> Path:
    """A table of columns under a header, numbers exact to the last bit, with lines above it."""
    rows = [mark.join(map(repr, row)) for row in zip(*(np.asarray(column).tolist() for column in columns), strict=True)]
    path.write_text(above + "\n".join([mark.join(names), *rows]) + "\n")
    return path
