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
    assert not code.co_posonlyargcount, f"{function.__qualname__}: `/` in parameters is not known here"
    passed = _passed.setdefault((function.__module__, function.__qualname__, code), {})
    defaults, places = _defaults(function), code.co_varnames[: code.co_argcount]
    results: list[Any] = []
    again = _with_signature(lambda *args, **kwargs: results.pop() if results else function(*args, **kwargs), function)
    check = functools.cache(lambda: _CHECK_EACH_CALL(again, typechecker=typechecker))  # of few functions: it takes a while

    def checked(in_place: tuple[Any, ...], rest: tuple[Any, ...], named: dict[str, Any]) -> Any:
        __tracebackhide__ = True
        if rest:
            return check()(*in_place, *rest, **named)
        named = {**dict(zip(places, in_place, strict=True)), **named}
        return check()(**{name: value for name, value in named.items() if value is not defaults.get(name, _no_default)})

    def new_call(called: Hashable, *given: Any) -> Any:
        __tracebackhide__ = True
        result = checked(*given)
        passed[called] = {_combination(result)}
        return result

    def new_result(result: Any, returned: set[Hashable], combination: Hashable, *given: Any) -> None:
        __tracebackhide__ = True
        results.append(result)
        checked(*given)
        returned.add(combination)

    known = {**_IN_CODE, "_passed": passed, "_function": function, "_new_call": new_call, "_new_result": new_result}
    known |= {f"_default_{name}": value for name, value in defaults.items()}
    exec(_call_of(code.co_varnames, code.co_argcount, code.co_kwonlyargcount, code.co_flags, asked, frozenset(defaults)), known)
    return functools.wraps(function)(known["_call"])


def _defaults(function: types.FunctionType) -> dict[str, Any]:
    """Parameters that may be left out, with what they are then; what is left out is not checked."""
    values, count = function.__defaults__ or (), function.__code__.co_argcount
    last = function.__code__.co_varnames[count - len(values) : count]
    return {**dict(zip(last, values, strict=True)), **(function.__kwdefaults__ or {})}


def _call_of(
    names: tuple[str, ...], in_place: int, in_words: int, flags: int, asked: set[str], defaults: frozenset[str]
) -> types.CodeType:
    """Code of a function with the same parameters: Python calls it in half the time of one of `*args, **kwargs`."""
    places, words = names[:in_place], names[in_place : in_place + in_words]
    others = list(names[in_place + in_words :])
    rest = [others.pop(0)] if flags & inspect.CO_VARARGS else []
    more = [others.pop(0)] if flags & inspect.CO_VARKEYWORDS else []
    taken = {name: f"{name}=_default_{name}" if name in defaults else name for name in (*places, *words)}
    star = [f"*{name}" for name in rest] or ["*"] * bool(words)
    stars = [f"**{name}" for name in more]
    parameters = ", ".join([*(taken[name] for name in places), *star, *(taken[name] for name in words), *stars])
    arguments = ", ".join([*places, *(f"*{name}" for name in rest), *(f"{name}={name}" for name in words), *stars])
    named = ", ".join([*(f"{name!r}: {name}" for name in words), *stars])
    given = f"({''.join(f'{name}, ' for name in places)}), {(*rest, '()')[0]}, {{{named}}}"
    looks = [*(name for name in (*places, *words) if name in asked), *rest, *more]
    result = _OF_RESULT.format(look=_LOOK.format("_result"), given=given) if "return" in asked else ""
    key = "".join(f"{_LOOK.format(name)}, " for name in looks)
    return compile(
        _CALL.format(parameters=parameters, arguments=arguments, given=given, key=key, result=result), __file__, "exec"
    )


_LOOK = (
    "((_v.dtype, _v.shape) if (_kind := type(_v := {})) is _ndarray"
    " else _kind if (_look := _looks(_kind, _new)) is None else _look(_v))"
)
_CALL = """
def _call({parameters}):
    __tracebackhide__ = True
    _returned = _passed.get(_called := ({key}))
    if _returned is None:
        return _new_call(_called, {given})
    _result = _function({arguments})
{result}    return _result
"""
_OF_RESULT = """\
    if (_c := {look}) not in _returned:
        _new_result(_result, _returned, _c, {given})
"""
_no_default = object()


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
    _looks[kind] = lambda array: (kind, array.dtype, array.shape)
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
"""By type: what a check depends on next to the type; None where that is all."""
_IN_CODE = {"_ndarray": np.ndarray, "_looks": _looks.get, "_new": _look}
