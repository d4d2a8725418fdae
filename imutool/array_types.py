"""Array types of annotations, with jaxtyping for type checkers and tests only.

Elsewhere nobody looks at them, and a type is the bare array. jaxtyping takes 65 ms of CPU to import, a sixth of the start of a
command: it imports unittest.mock, and that asyncio.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import (
        Bool,
        Complex128,
        Float,
        Float64,
        Int,
        Int64,
        Num,
        Shaped,
        UInt8,
        UInt16,
        UInt32,
        UInt64,
    )
    from numpy.typing import ArrayLike
else:

    class Shaped:
        """Any array: `Shaped[np.ndarray, "n 3"]` is `np.ndarray`."""

        def __class_getitem__(cls, item: tuple[Any, str]) -> Any:
            return item[0]

    ArrayLike = Any
    Bool = Complex128 = Float = Float64 = Int = Int64 = Num = UInt8 = UInt16 = UInt32 = UInt64 = Shaped

Vectors = Float64[np.ndarray, "n 3"]  # of three axes, a row a sample
Rows6 = Float64[np.ndarray, "n 6"]  # of the gyro, then of the accelerometer

__all__ = [
    "ArrayLike",
    "Bool",
    "Complex128",
    "Float",
    "Float64",
    "Int",
    "Int64",
    "Num",
    "Rows6",
    "Shaped",
    "UInt8",
    "UInt16",
    "UInt32",
    "UInt64",
]
