"""The generator of `tests/bench/audit.py` as a module."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

PATH = Path(__file__).parents[1] / "bench" / "audit.py"
SPEC = importlib.util.spec_from_file_location("audit_bench", PATH)
assert SPEC is not None
assert SPEC.loader is not None
bench: Any = importlib.util.module_from_spec(SPEC)
sys.modules["audit_bench"] = bench
SPEC.loader.exec_module(bench)
