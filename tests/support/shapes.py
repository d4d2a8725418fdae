"""Shapes of arrays and words in annotations, checked once for each combination of shapes and types that a function meets.

jaxtyping and beartype check every call, at 0.1 to 0.3 ms each: two thirds of the time of the tests of `diagnose`.
What they check depends on types, dtypes and shapes alone, so a combination that has passed passes again.
Only parameters and results whose annotation names an array or a Literal are looked at: mypy checks all other types.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import types
import typing
from collections.abc import Callable, Hashable, Iterable
from typing import Any

import jaxtyping
import numpy as np

LONGEST = 16
"""Longest tuple or list whose elements are all looked at; of a longer one its length and first elements."""
_CHECK_EACH_CALL: Any = jaxtyping.jaxtyped
_passed: dict[tuple[str, str, types.CodeType], dict[Hashable, set[Hashable]]] = {}
"""By function and arguments: the results that have passed. A function made inside a function shares its name and code.

The code alone may be that of two dataclasses with the same fields.
"""


def check_shapes(package: str) -> None:
    """Check annotations of a package's functions while tests run; call it before the package is imported."""
    jaxtyping.jaxtyped = _check_new_combinations
    jaxtyping.install_import_hook([package], "beartype.beartype").__enter__()


def _check_new_combinations(checked: Any = None, *, typechecker: Any) -> Any:
    if checked is None:
        return functools.partial(_check_new_combinations, typechecker=typechecker)
    if inspect.isclass(checked):
        if dataclasses.is_dataclass(checked) and isinstance(init := vars(checked).get("__init__"), types.FunctionType):
            names = vars(sys.modules[checked.__module__])
            checked.__init__ = _check_function(init, names, typechecker)  # type: ignore[misc]
        return checked
    if not isinstance(checked, types.FunctionType):
        return _CHECK_EACH_CALL(checked, typechecker=typechecker)
    return _check_function(checked, checked.__globals__, typechecker)


def _to_check(function: types.FunctionType, names: dict[str, Any]) -> set[str]:
    """Parameters, and `return`, with an array or a Literal in the annotation (a text, by `from __future__ import`)."""
    words = {name: re.findall(r"\w+", str(annotation)) for name, annotation in function.__annotations__.items()}
    return {name for name, of_one in words.items() if any(_is_checked(names.get(word)) for word in of_one)}


def _is_checked(kind: Any) -> bool:
    module = str(getattr(kind, "__module__", None))
    return kind is typing.Literal or module.startswith("jaxtyping") or any(map(_is_checked, typing.get_args(kind)))


def _check_function(function: types.FunctionType, names: dict[str, Any], typechecker: Any) -> Callable[..., Any]:
    asked, code = _to_check(function, names), function.__code__
    if not asked:
        return function
    places = [k for k, name in enumerate(code.co_varnames[: code.co_argcount]) if name in asked]
    more = code.co_argcount if code.co_flags & inspect.CO_VARARGS else sys.maxsize  # where *args begin
    every = bool(code.co_flags & inspect.CO_VARKEYWORDS)
    passed = _passed.setdefault((function.__module__, function.__qualname__, code), {})
    check = functools.cache(functools.partial(_CHECK_EACH_CALL, typechecker=typechecker))
    results: list[Any] = []
    give_result = _with_signature(lambda *_, **__: results.pop(), function)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        given = len(args)
        called: Hashable = _combinations([args[k] for k in places if k < given])
        if kwargs:
            called = called, *kwargs, _combinations([kwargs[name] for name in kwargs if every or name in asked])
        if given > more:
            called = called, _combinations(args[more:])
        returned = passed.get(called)
        if returned is None:
            result = check(function)(*args, **kwargs)
            passed[called] = {_combination(result)}
            return result
        result = function(*args, **kwargs)
        if "return" in asked and (combination := _combination(result)) not in returned:
            results.append(result)
            check(give_result)(*args, **kwargs)
            returned.add(combination)
        return result

    return checked


def _with_signature(function: Any, of: types.FunctionType) -> Any:
    code, name, closure = function.__code__, of.__name__, function.__closure__
    return functools.update_wrapper(types.FunctionType(code, of.__globals__, name, None, closure), of)


def _combinations(values: Iterable[Any]) -> Hashable:
    """As `_combination` of each; this is called millions of times, so the usual types take no call of their own."""
    return tuple([kind if (look := _looks.get(kind := type(value), _look)) is None else look(value) for value in values])


def _combination(value: Any) -> Hashable:
    """All of a value that a check depends on."""
    kind = type(value)
    look = _looks.get(kind, _look)
    return kind if look is None else look(value)


def _look(value: Any) -> Hashable:
    """As `_combination`, of a type that is met for the first time."""
    kind = type(value)
    torch = sys.modules.get("torch")
    if not issubclass(kind, np.ndarray) and not (torch is not None and issubclass(kind, torch.Tensor)):
        _looks[kind] = None
        return kind
    _looks[kind] = lambda array: (kind, array.dtype, tuple(array.shape))
    return _combination(value)


_looks: dict[type, Callable[[Any], Hashable] | None] = {
    np.ndarray: lambda array: (array.dtype, array.shape),
    tuple: lambda items: (tuple, len(items), _combinations(items[:LONGEST])),
    list: lambda items: (list, len(items), _combinations(items[:LONGEST])),
    dict: lambda items: (
        dict,
        len(items),
        *((_combination(key), _combination(of)) for key, of in list(items.items())[:LONGEST]),
    ),
    str: lambda text: text if len(text) < LONGEST else str,  # a Literal is short
}
"""By type: what a check depends on beside the type; None where that is all."""
