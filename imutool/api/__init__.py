"""Public functions behind `import imutool`, for paths, URLs and arrays."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]  # bytes done, bytes in all
NamedProgress = Callable[[int, int, str], None]  # steps done, steps in all, the current step
