"""Shapes in annotations are checked while the tests run; real recordings are found here, or their absence is said."""

from __future__ import annotations

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

install_import_hook(["imutool", "converters"], "beartype.beartype").__enter__()

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings."""
    if not DATA.is_dir():
        pytest.skip(f"real recordings are not at {DATA}")
    return DATA
