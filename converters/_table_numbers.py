"""Numbers in the fields of a table of text."""

from __future__ import annotations

import re

import numpy as np

COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?(0?,\d+|\d+,(\d\d?|\d{4,}))([eE][+-]?\d+)?")  # in quotes; of 1,234 it may mark thousands
MOST_ODD = 0.1  # share of the fields of a column of numbers that are none: `-`, `ERR`, a garbled line


def is_number(text: str) -> bool:
    """Whether a field is a number, perhaps with a decimal comma."""
    text = text.strip().strip('"')
    return _number(text) is not None or ("_" not in text and bool(COMMA_NUMBER.fullmatch(text)))


def vector(text: str) -> list[str]:
    """Numbers of a vector in a text, as NumPy prints it: `[ 0.1 -0.2  9.8]`; none of others."""
    match = re.fullmatch(r"\s*[\[(]([^\[\]()]*)[\])]\s*", text)
    fields = re.split(r"[\s,;]+", match[1].strip()) if match else []
    return fields if len(fields) > 1 and all(_number(field) is not None for field in fields) else []


def vectors(texts: list[str]) -> np.ndarray | None:
    """Vectors of a column; None of other texts, or of several lengths."""
    if not vector(texts[0]):
        return None
    found = [vector(text) for text in texts]
    return np.array(found).astype(np.float64) if len({*map(len, found)}) == 1 else None


def decimal_points(texts: list[str], mark: re.Pattern[str]) -> list[str]:
    """Fields with points for their decimal commas; none where no field has one."""
    has_one = any("," in text and mark.fullmatch(text) for text in texts)
    return [text.replace(",", ".") for text in texts] if has_one else []


def numbers(texts: list[str]) -> tuple[np.ndarray, list[str]] | None:
    """Numbers of a column, nan for the few fields that are none, and these; None of texts."""
    if not any("_" in text for text in texts):
        try:
            return np.array(list(map(int, texts)), np.int64), []
        except (ValueError, OverflowError):
            pass
    found = [_number(text) for text in texts]
    odd = [text for text, number in zip(texts, found, strict=True) if number is None and text]
    if len(odd) > MOST_ODD * len(texts):
        return None
    return np.array([np.nan if number is None else number for number in found]), odd


def _number(text: str) -> float | None:
    """Number of a field; Python reads 2026_06_15 as one, nobody else does."""
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None
