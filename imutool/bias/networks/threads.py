"""Threads for tensors: pieces of work side by side, each on one thread.

The pieces, and the order in which their results are added, do not depend on how many threads there are, and so the results do
not either. Threads inside one operation would bring little here: operations are short, and most of the time would be spent
on starting and ending them.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")
_pool: ContextVar[ThreadPoolExecutor | None] = ContextVar("_pool", default=None)
_training = threading.RLock()  # PyTorch's random numbers and default type belong to the whole process
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: _pool.set(None))  # a forked process has none of the threads


@contextmanager
def settings_of_a_new_process() -> Iterator[None]:
    """Use PyTorch's settings of a new process, and give the caller's back.

    So with its random numbers. A training of one seed would otherwise depend on what a script set before, and set what the
    script draws after.
    """
    with _training:
        dtype, device = torch.get_default_dtype(), torch.get_default_device()
        gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()  # type: ignore[no-untyped-call]
        with (
            torch.random.fork_rng(gpus),
            torch.inference_mode(False),
            torch.enable_grad(),
            nullcontext() if device.type == "cpu" else torch.device("cpu"),
        ):
            torch.set_default_dtype(torch.float32)
            try:
                yield
            finally:
                torch.set_default_dtype(dtype)


@contextmanager
def side_by_side() -> Iterator[None]:
    """Let `of_each` take as many threads as PyTorch would, and PyTorch one for each."""
    threads = torch.get_num_threads()
    if threads == 1:
        yield
        return
    pool = ThreadPoolExecutor(threads, "imutool")
    before = _pool.set(pool)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _pool.reset(before)
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)


def of_each(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Function of each item, in order; side by side within `side_by_side`."""
    some, pool, graph = list(items), _pool.get(), torch.is_grad_enabled()

    def one(item: T) -> R:
        with torch.set_grad_enabled(graph):  # each thread has a setting of its own
            return function(item)

    return [one(item) for item in some] if pool is None or len(some) < 2 else list(pool.map(one, some))
