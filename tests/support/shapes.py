"""Shapes and types in annotations, checked once for each combination of shapes and types that a function meets.

jaxtyping and beartype check every call, at 0.1 to 0.3 ms each: two thirds of the time of the tests of `diagnose`.
What they check depends on types, dtypes and shapes alone, so a combination that has passed passes again.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import sys
import types
from collections.abc import Callable, Hashable
from typing import Any

import jaxtyping
import numpy as np

LONGEST = 16
"""Longest tuple or list whose elements are all looked at; of a longer one its length and first elements."""
_CHECK_EACH_CALL: Any = jaxtyping.jaxtyped
_passed: dict[types.CodeType, set[Hashable]] = {}
"""By code: arguments, and arguments with a result, that have passed. A function made inside a function shares its code."""


def check_shapes(package: str) -> None:
    """Check annotations of a package's functions while tests run; call it before the package is imported."""
    jaxtyping.jaxtyped = _check_new_combinations
    jaxtyping.install_import_hook([package], "beartype.beartype").__enter__()


def _check_new_combinations(checked: Any = None, *, typechecker: Any) -> Any:
    if checked is None:
        return functools.partial(_check_new_combinations, typechecker=typechecker)
    if inspect.isclass(checked):
        if dataclasses.is_dataclass(checked) and isinstance(init := vars(checked).get("__init__"), types.FunctionType):
            checked.__init__ = _check_function(init, typechecker)  # type: ignore[misc]
        return checked
    if not isinstance(checked, types.FunctionType):
        return _CHECK_EACH_CALL(checked, typechecker=typechecker)
    return _check_function(checked, typechecker)


def _check_function(function: types.FunctionType, typechecker: Any) -> Callable[..., Any]:
    passed = _passed.setdefault(function.__code__, set())
    check = functools.cache(functools.partial(_CHECK_EACH_CALL, typechecker=typechecker))
    results: list[Any] = []
    give_result = _with_signature(lambda *_, **__: results.pop(), function)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        called = (*map(_combination, args), *kwargs, *map(_combination, kwargs.values()))
        if called not in passed:
            result = check(function)(*args, **kwargs)
            passed.update((called, (called, _combination(result))))
            return result
        result = function(*args, **kwargs)
        returned = (called, _combination(result))
        if returned not in passed:
            results.append(result)
            check(give_result)(*args, **kwargs)
            passed.add(returned)
        return result

    return checked


def _with_signature(function: Any, of: types.FunctionType) -> Any:
    code, name, closure = function.__code__, of.__name__, function.__closure__
    return functools.update_wrapper(types.FunctionType(code, of.__globals__, name, None, closure), of)


def _combination(value: Any) -> Hashable:
    """All of a value that a check depends on."""
    kind = type(value)
    if isinstance(value, np.ndarray):
        return kind, value.dtype, value.shape
    if kind in (tuple, list):
        return kind, len(value), *map(_combination, value[:LONGEST])
    if kind is dict:
        return kind, len(value), *((_combination(key), _combination(of)) for key, of in list(value.items())[:LONGEST])
    if kind is str:
        return value if len(value) < LONGEST else kind  # a Literal is short
    torch = sys.modules.get("torch")
    return (kind, value.dtype, value.shape) if torch is not None and isinstance(value, torch.Tensor) else kind
