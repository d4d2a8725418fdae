"""Shapes of arrays and words in annotations, checked once for each combination of shapes and types that a function meets.

jaxtyping and beartype check every call, at 0.1 to 0.3 ms each: two thirds of the time of the tests of `diagnose`.
What they check depends on types, dtypes and shapes alone, so a combination that has passed passes again, and also with
other lengths that annotations name.
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
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, cast

import jaxtyping
import numpy as np

LONGEST = 16
"""Longest tuple or list whose elements are all looked at; of a longer one its length and first elements."""
_CHECK_EACH_CALL: Any = jaxtyping.jaxtyped
LARGEST = 64
"""Largest length that an annotation may fix; longer ones have names."""
_known: dict[tuple[str, str, types.CodeType], _Known] = {}


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
    which = names["__name__"], function.__qualname__, function.__code__  # code alone may be that of two dataclasses
    if which not in _known:
        _known[which] = _looking(function, names)
    known = _known[which]
    if known.make is None:
        return function
    check = functools.cache(functools.partial(_CHECK_EACH_CALL, typechecker=typechecker))
    results: list[Any] = []
    give_result = _with_signature(lambda *_, **__: results.pop(), function)

    def first(called: Hashable, *args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        alike = known.alike(called)
        if alike in known.passed_alike:
            result = function(*args, **kwargs)
        else:
            result = _call_with_given(check(function), function, args, kwargs)
            known.passed_alike |= {alike, known.alike((called, _combination(result)))}
        known.passed[called] = set()
        if known.returns:
            again(called, result, *args, **kwargs)
        return result

    def again(called: Hashable, result: Any, *args: Any, **kwargs: Any) -> None:
        __tracebackhide__ = True
        combination = _combination(result)
        alike = known.alike((called, combination))
        if alike not in known.passed_alike:
            results.append(result)
            _call_with_given(check(give_result), function, args, kwargs)
            known.passed_alike.add(alike)
        known.passed[called].add(combination)

    checked = known.make(function, known.passed, first, again, _combination, np.ndarray)
    checked.__defaults__, checked.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    return functools.update_wrapper(checked, function)


@dataclasses.dataclass
class _Known:
    """What is known of a function, whose instances share it if another function makes it."""

    make: Callable[..., Any] | None
    alike: Callable[[Hashable], Hashable]
    returns: bool
    passed: dict[Hashable, set[Hashable]] = dataclasses.field(default_factory=dict)
    """By arguments: the results that have passed."""
    passed_alike: set[Hashable] = dataclasses.field(default_factory=set)


def _looking(function: types.FunctionType, names: dict[str, Any]) -> _Known:
    """Source of a function that looks at what is asked and calls another, made once; and which combinations are alike."""
    asked, code = _to_check(function, names), function.__code__
    if not asked:
        return _Known(None, _alike, False)
    positional, keywords = code.co_varnames[: code.co_argcount], code.co_varnames[code.co_argcount :][: code.co_kwonlyargcount]
    others = iter(code.co_varnames[code.co_argcount + code.co_kwonlyargcount :])
    more = [f"*{next(others)}"] if code.co_flags & inspect.CO_VARARGS else []
    rest = [f"**{next(others)}"] if code.co_flags & inspect.CO_VARKEYWORDS else []
    given = ", ".join([*positional, *(more or ["*"] * bool(keywords)), *keywords, *rest])
    passed_on = ", ".join([*positional, *more, *(f"{name}={name}" for name in keywords), *rest])

    def look(name: str) -> str:  # an array, the usual case, takes no call of its own
        return f"({name}.dtype, {name}.shape) if {name}.__class__ is _array else _look({name})"

    looks = "".join(
        f"{look(name)}, " for name in [*positional, *keywords, *(word.strip("*") for word in more + rest)] if name in asked
    )
    source = f"""
def make(_function, _passed, _first, _again, _look, _array):
    def checked({given}):
        __tracebackhide__ = True
        _called = ({looks})
        _returned = _passed.get(_called)
        if _returned is None:
            return _first(_called, {passed_on})
        _result = _function({passed_on})
        if {"return" in asked} and ({look("_result")}) not in _returned:
            _again(_called, _result, {passed_on})
        return _result
    return checked
"""
    made: dict[str, Any] = {}
    exec(compile(source, f"<shapes of {function.__qualname__}>", "exec"), made)
    annotations = " ".join(str(function.__annotations__[name]) for name in asked)
    dims = [annotations, *(text for word in re.findall(r"\w+", annotations) for text in _dims(names.get(word)))]
    computed = any(re.search(r"\w[-+/*]\w|[{(]", text) for text in re.findall(r"""['"](.*?)['"]""", annotations) + dims[1:])
    fixed = max(map(int, re.findall(r"\d+", " ".join(dims))), default=0)
    few_lengths = not computed and fixed <= LARGEST
    return _Known(made["make"], _alike if few_lengths else lambda combination: combination, "return" in asked)


def _dims(kind: Any) -> Iterator[str]:
    """Dimensions of the arrays that a name in an annotation stands for."""
    if dims := getattr(kind, "dim_str", ""):
        yield dims
    for part in typing.get_args(kind):
        yield from _dims(part)


def _alike(combination: Hashable) -> Hashable:
    """A combination with long lengths by their order: annotations name them, so that another length alone changes nothing."""
    lengths: dict[int, int] = {}

    def named(part: Any) -> Any:
        if type(part) is tuple:
            return tuple(map(named, part))
        return part if type(part) is not int or part <= LARGEST else -1 - lengths.setdefault(part, len(lengths))

    return cast(Hashable, named(combination))


def _call_with_given(checked: Any, of: types.FunctionType, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call without what equals a default, which may be of another type, as that of a field with a factory."""
    __tracebackhide__ = True
    code, defaults, keywords = of.__code__, of.__defaults__ or (), of.__kwdefaults__ or {}
    if len(args) <= code.co_argcount:
        first = max(code.co_argcount - len(defaults), code.co_posonlyargcount)
        begun = zip(code.co_varnames[first:], args[first:], defaults[first - code.co_argcount :], strict=False)
        kwargs = {**{name: value for name, value, default in begun if value is not default}, **kwargs}
        args = args[:first]
    missing = object()
    return checked(*args, **{name: value for name, value in kwargs.items() if value is not keywords.get(name, missing)})


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
