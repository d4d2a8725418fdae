"""Threads of BLAS, which numpy and scipy share with all else in the process."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_lock = threading.Lock()
_users: list[Any] = []  # the first holds the limits of all


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread of the process, until the last of several users ends.

    For small matrices: their threads wait for one another longer than they work, most of all on a busy machine.
    """
    import scipy.linalg  # noqa: F401  its BLAS is another one than numpy's, and is limited only if it is loaded
    from threadpoolctl import threadpool_limits

    with _lock:
        _users.append(None if _users else threadpool_limits(1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            if (limits := _users.pop(1 if len(_users) > 1 else 0)) is not None:
                limits.restore_original_limits()
