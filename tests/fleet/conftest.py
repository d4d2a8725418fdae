"""Workers for the tests of a fleet; logs that robots of one kind would record."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from support import planted

from imutool.fleet.engine import ProcessEngine
from imutool.mcap_io.write import write
from imutool.processes.worker_pool import ONE_THREAD

LOG_S = 10.0  # below eight nothing is told
Robot = Callable[[Path, int, Mapping[str, Sequence[float]]], None]


@pytest.fixture(scope="package")
def ray_started() -> Iterator[None]:
    """A cluster of this machine alone, on loopback: two cores. Every RayEngine uses it, so it ends with this folder's tests."""
    before = dict(os.environ)
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", **ONE_THREAD}
    import ray  # not before it is said how

    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=80 << 20)
    yield
    node = ray._private.worker._global_node
    started = [info.process for several in node.all_processes.values() for info in several]
    ray.shutdown()
    for process in started:
        process.wait(timeout=10)  # Ray itself does not, and a Popen that nobody waited for warns when it goes
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def engine() -> Callable[[], ProcessEngine]:
    """Two workers."""
    return lambda: ProcessEngine(workers=2, memory_bytes=1 << 28)


@pytest.fixture
def fleet(tmp_path: Path, logs: Path) -> Path:
    """Two robots whose logs have the same name."""
    folder = tmp_path / "fleet"
    for robot, flight in (("robot_a", "flight_1"), ("robot_b", "flight_2")):
        (folder / robot).mkdir(parents=True)
        shutil.copy(logs / f"{flight}.mcap", folder / robot / "log.mcap")
    return folder


@pytest.fixture(scope="session")
def robot() -> Robot:
    """Writes a robot's log: a motion of its own, effects, noise, a bias, and its true poses."""

    def make(path: Path, seed: int, effects: Mapping[str, Sequence[float]]) -> None:
        felt, motion = planted.rich(seed, LOG_S), planted.moving(seed, LOG_S)
        samples = planted.ideal(felt, planted.acting(effects)) + planted.noise(len(felt.t_s), seed) + planted.BIAS
        poses = planted.poses(motion, planted.clock(LOG_S, rate_hz=200.0))
        path.parent.mkdir(parents=True, exist_ok=True)
        write(planted.recording(path.stem, felt.t_s, samples, poses=poses), path)

    return make
