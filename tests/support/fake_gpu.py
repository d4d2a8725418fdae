"""A GPU that is not there, simulated on the CPU, so that what would fail on one fails here.

While `simulated_gpu` lasts, a tensor that is asked for on "cuda" is an `OnGpu`: torch sees a tensor on a device of its own
(its "meta" device, which it knows everywhere) and hands every operation on it to `__torch_dispatch__`, with those of autograd
and of optimisers; the numbers lie in a tensor of the CPU inside, and the results are those of the CPU to the bit.

Refused, as on a GPU: tensors of two devices in one operation, but for copies, for single numbers (no axes) of the CPU in
elementwise operations, and for indices of the CPU into a tensor of the GPU; a generator of the CPU for numbers drawn on the
GPU; `.numpy()` and whatever makes an array.

Not seen: what a GPU computes otherwise than a CPU (rounding, the order of sums, kernels that are missing there or are not
deterministic, random numbers of its own), `torch.Generator(device="cuda")`, pinned memory and streams, several GPUs, and too
little memory. A tensor asked for on "meta" meanwhile is one on the GPU, with its numbers.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

GPU, STANDS_FOR_IT = torch.device("cuda", 0), torch.device("meta")
ATEN = torch.ops.aten
INDEXED = (ATEN.index, ATEN.index_put, ATEN.index_put_, ATEN._index_put_impl_, ATEN._unsafe_index)  # tensor, indices, values
FILLED = (ATEN.fill, ATEN.fill_, ATEN.masked_fill, ATEN.masked_fill_)
NAMES_DEVICE = (str, torch.device)
PLAIN = frozenset((int, float, bool, str, type(None), torch.dtype, torch.device))  # most of what is no tensor
OPTIMISERS = importlib.import_module("torch.optim.optimizer")  # torch.optim hides it


@contextmanager
def simulated_gpu() -> Iterator[None]:
    """A CUDA device is there as long as this lasts."""
    run_backward = torch.autograd._engine_run_backward

    def with_names(*args: Any, **named: Any) -> Any:
        with _Names():  # a mode does not see what is called from within a call it sees, as gradients written in Python are
            return run_backward(*args, **named)

    with (
        patch("torch.cuda.is_available", lambda: True),
        patch("torch.autograd._engine_run_backward", with_names),
        patch.object(OPTIMISERS, "_foreach_supported_types", [Tensor, nn.Parameter, OnGpu]),  # as torch does on a GPU
        _Names(),
        _Operations(),
    ):
        yield


class OnGpu(Tensor):
    """A tensor on the GPU; `numbers` holds what is in it, on the CPU."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor) -> OnGpu:
        made: OnGpu = Tensor._make_wrapper_subclass(
            cls,
            numbers.shape,
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            device=STANDS_FOR_IT,
        )
        made.numbers = numbers
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)
    is_meta = property(lambda self: False)

    @classmethod
    def __torch_dispatch__(
        cls, operation: Any, types: Sequence[type], args: tuple[Any, ...] = (), named: dict[str, Any] | None = None
    ) -> Any:
        return _computed(operation, args, named or {})

    def numpy(self, *, force: bool = False) -> Any:
        """Refused as on a GPU."""
        if not force:
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")
        return self.detach().cpu().numpy()

    def tolist(self) -> Any:
        """The numbers: a GPU copies them of itself."""
        return self.cpu().tolist()

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"OnGpu({self.numbers})"


class _Names(TorchFunctionMode):
    """Writes the device that stands for the GPU where one is asked for, and copies what Python brings."""

    def __torch_function__(
        self, function: Any, types: Sequence[type], args: tuple[Any, ...] = (), named: dict[str, Any] | None = None
    ) -> Any:
        if function is torch.device:
            return function(*args, **(named or {}))
        args = tuple([_renamed(value) if type(value) in NAMES_DEVICE else value for value in args])
        named = {name: _renamed(value) for name, value in named.items()} if named else {}
        if function in (torch.tensor, torch.as_tensor) and named.get("device") == STANDS_FOR_IT:
            return function(*args, **named | {"device": "cpu"}).to(STANDS_FOR_IT)
        if function is Tensor.new_tensor and isinstance(args[0], OnGpu):
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype} | named).to(STANDS_FOR_IT)
        if function in (Tensor.__getitem__, Tensor.__setitem__):
            args = (args[0], _indices(args[1]), *args[2:])
        return function(*args, **named)


class _Operations(TorchDispatchMode):
    """Every operation passes here, also one that makes a tensor from none."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled here, and telling the compiler so takes a sixth of the time

    def __torch_dispatch__(
        self, operation: Any, types: Sequence[type], args: tuple[Any, ...] = (), named: dict[str, Any] | None = None
    ) -> Any:
        return _computed(operation, args, named or {})


def _renamed(value: Any) -> Any:
    named = isinstance(value, str) and value.partition(":")[0] == "cuda"
    return STANDS_FOR_IT if named or (isinstance(value, torch.device) and value.type == "cuda") else value


def _indices(index: Any) -> Any:
    """Lists of places as tensors of the CPU, which may index anything."""
    if isinstance(index, tuple):
        return tuple(map(_indices, index))
    return torch.tensor(index, dtype=None if index else torch.int64, device="cpu") if isinstance(index, list) else index


def _computed(operation: Any, args: tuple[Any, ...], named: dict[str, Any]) -> Any:
    """An operation done on the CPU; its results are where its tensors are, or where they are asked for."""
    given: list[Tensor | torch.Generator] = []
    here = [_with_numbers(value, given) for value in args]
    here_named = {name: _with_numbers(value, given) for name, value in named.items()}
    tensors = [one for one in given if isinstance(one, Tensor)]
    cpu = [one for one in tensors if type(one) is not OnGpu]
    assert not any(one.is_meta for one in cpu), f"{operation} on a tensor without numbers"
    if 0 < len(cpu) < len(tensors):
        _refuse_two_devices(operation, args, cpu)
    there = len(cpu) < len(tensors)
    if named.get("device") is not None:
        there, here_named["device"] = named["device"] == STANDS_FOR_IT, "cpu"
    if there and len(tensors) < len(given):
        _refuse_foreign_generator(given)
    done = operation(*here, **here_named)
    if _changes_shape(operation):  # such as squeeze_: the shape that torch sees changes as well
        with no_dispatch():
            operation(*args, **named)
    return _in_place(done, {id(_numbers(one)): one for one in tensors}, there)


@functools.cache
def _changes_shape(operation: Any) -> bool:
    return torch.Tag.inplace_view in operation.tags


def _refuse_two_devices(operation: Any, args: tuple[Any, ...], cpu: Sequence[Tensor]) -> None:
    """Refuses what a GPU does not do with some tensors of the CPU.

    Raises:
        RuntimeError: tensors on both devices.
    """
    kind = operation.overloadpacket
    if kind is ATEN.copy_:
        return
    if kind in INDEXED and isinstance(args[0], OnGpu):  # the indices may be on either, and one number may be put everywhere
        cpu = [one for one in args[2:3] if isinstance(one, Tensor) and not isinstance(one, OnGpu) and one.dim()]
    elif (torch.Tag.pointwise in operation.tags or kind in FILLED) and not _written_on_cpu(operation, args):
        cpu = [one for one in cpu if one.dim()]
    if cpu:
        raise RuntimeError(f"Expected all tensors to be on the same device, but {operation} has some on cuda:0 and some on cpu")


def _written_on_cpu(operation: Any, args: tuple[Any, ...]) -> bool:
    """Whether an operation writes into its first argument, and that is on the CPU."""
    alias = operation._schema.arguments[0].alias_info
    return alias is not None and alias.is_write and not isinstance(args[0], OnGpu)


def _refuse_foreign_generator(given: Sequence[Any]) -> None:
    """Refuses to draw numbers of the GPU with a generator of the CPU.

    Raises:
        RuntimeError: if asked to.
    """
    if any(isinstance(one, torch.Generator) and one.device.type == "cpu" for one in given):
        raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")


def _numbers(value: Tensor) -> Tensor:
    return value.numbers if type(value) is OnGpu else value


def _with_numbers(value: Any, given: list[Tensor | torch.Generator]) -> Any:
    """A value, or all in lists and tuples of values, with the numbers of tensors; tensors and generators go to `given`."""
    kind = type(value)
    if kind is OnGpu:
        given.append(value)
        return value.numbers
    if kind is tuple or kind is list:
        return kind([_with_numbers(one, given) for one in value])
    if kind not in PLAIN and isinstance(value, (Tensor, torch.Generator)):
        given.append(value)
    return value


def _in_place(done: Any, given: dict[int, Tensor], there: bool) -> Any:
    """Results of an operation where they are; what it changed in place stays the same tensor."""
    if isinstance(done, Tensor):
        same = given.get(id(done))
        return same if same is not None else OnGpu(done) if there else done
    kind = type(done)
    return kind([_in_place(one, given, there) for one in done]) if kind is tuple or kind is list else done
