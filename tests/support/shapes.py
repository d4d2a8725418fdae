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
from collections.abc import Callable, Hashable, Sequence
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
    places = tuple(k for k, name in enumerate(code.co_varnames[: code.co_argcount]) if name in asked)
    more = code.co_argcount if code.co_flags & inspect.CO_VARARGS else sys.maxsize  # where *args begin
    every = bool(code.co_flags & inspect.CO_VARKEYWORDS)
    passed = _passed.setdefault((function.__module__, function.__qualname__, code), {})
    check = functools.cache(functools.partial(_CHECK_EACH_CALL, typechecker=typechecker))
    results: list[Any] = []
    give_result = _with_signature(lambda *_, **__: results.pop(), function)

    def any_call(*args: Any, **kwargs: Any) -> Any:
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
            new_result(result, returned, combination, args, kwargs)
        return result

    def new_result(result: Any, returned: set[Hashable], combination: Hashable, args: Any, kwargs: Any) -> None:
        __tracebackhide__ = True
        results.append(result)
        check(give_result)(*args, **kwargs)
        returned.add(combination)

    names_in_code = {**_IN_CODE, "any_call": any_call, "new_result": new_result, "passed": passed, "function": function}
    code_of = _usual_call(places, code.co_argcount, "return" in asked)
    exec(code_of, names_in_code)
    return functools.wraps(function)(names_in_code["usual_call"])


@functools.cache
def _usual_call(places: tuple[int, ...], most: int, result_too: bool) -> types.CodeType:
    """Code of a function for the usual call, in which all that is looked at comes by position: a third of the time."""
    looks = "".join(f"    c{k} = {_LOOK.format(f'args[{k}]')}\n" for k in places)
    of_result = (
        f"    c = {_LOOK.format('result')}\n    if c not in returned:\n        new_result(result, returned, c, args, {{}})\n"
    )
    text = (
        "def usual_call(*args, **kwargs):\n"
        "    __tracebackhide__ = True\n"
        f"    if kwargs or not {max(places, default=-1)} < len(args) <= {most}:\n"
        "        return any_call(*args, **kwargs)\n"
        f"{looks}"
        f"    returned = passed.get(({''.join(f'c{k}, ' for k in places)}))\n"
        "    if returned is None:\n"
        "        return any_call(*args)\n"
        "    result = function(*args)\n"
        f"{of_result if result_too else ''}"
        "    return result\n"
    )
    return compile(text, __file__, "exec")


_LOOK = "(v.dtype, v.shape) if (kind := type(v := {})) is ndarray else kind if (look := looks(kind, new)) is None else look(v)"


def _with_signature(function: Any, of: types.FunctionType) -> Any:
    code, name, closure = function.__code__, of.__name__, function.__closure__
    return functools.update_wrapper(types.FunctionType(code, of.__globals__, name, None, closure), of)


def _combinations(values: Sequence[Any]) -> tuple[Hashable, ...]:
    """As `_combination` of each; this is called millions of times, so the usual types take no call of their own."""
    if len(values) > LONGEST:
        return (len(values), *_combinations(values[:LONGEST]))
    return tuple(
        [
            (value.dtype, value.shape)
            if (kind := type(value)) is np.ndarray
            else kind
            if (look := _looks.get(kind, _look)) is None
            else look(value)
            for value in values
        ]
    )


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
    tuple: _combinations,
    list: lambda items: (list, _combinations(items)),
    dict: lambda items: (
        dict,
        len(items),
        *((_combination(key), _combination(of)) for key, of in list(items.items())[:LONGEST]),
    ),
    str: lambda text: text if len(text) < LONGEST else str,  # a Literal is short
}
"""By type: what a check depends on beside the type; None where that is all."""
_IN_CODE = {"ndarray": np.ndarray, "looks": _looks.get, "new": _look}
