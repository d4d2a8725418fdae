"""The number of threads of BLAS is one while somebody asks for it, and what it was afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest
import scipy.linalg  # noqa: F401  its BLAS counts, too
from threadpoolctl import threadpool_info, threadpool_limits

import imutool
from imutool.processes.blas_threads import one_blas_thread


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.mark.parametrize("first_ends", [0, 1])
def test_the_last_of_several_users_gives_the_threads_back(first_ends: int) -> None:
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        users = [one_blas_thread(), one_blas_thread()]
        for user in users:
            user.__enter__()
            assert threads() == {1}
        users[first_ends].__exit__(None, None, None)
        assert threads() == {1}
        users[1 - first_ends].__exit__(None, None, None)
        assert threads() == before


def test_an_error_gives_the_threads_back() -> None:
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with pytest.raises(RuntimeError), one_blas_thread():
            raise RuntimeError
        assert threads() == before


def test_a_diagnosis_from_python_takes_one(tmp_path: Path) -> None:
    """The command sets the environment; who imports numpy first cannot."""
    imutool.write(tmp_path / "real.mcap", imutool.example_recording(1, duration_s=10.0))
    seen = set[int]()
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        imutool.diagnose(tmp_path / "real.mcap", progress=lambda *_: seen.update(threads()))
        assert threads() == before
    assert seen == {1}
