"""A file is there whole or not at all, whatever goes wrong; and what goes wrong is said."""

from __future__ import annotations

import errno
import os
import resource
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from imutool.errors import ConfigError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.passthrough.added_topics import DerivedBatch, NewTopic
from imutool.mcap_io.rewrite import rewrite
from imutool.mcap_io.storage.target import Target, writing
from imutool.mcap_io.write import write
from imutool.recording import Frames, Recording


class Failing:
    """A derived channel that fails in the middle of the log."""

    source_topic = "/imu0"
    topics = (NewTopic("/imu0/debiased", schemas.IMU),)

    def __init__(self, error: BaseException) -> None:
        self.error, self.seen = error, 0

    def __call__(self, batch: ImuBatch) -> DerivedBatch:
        self.seen += 1
        if self.seen == 2:
            raise self.error
        return DerivedBatch(batch, [encode_imu(batch.stamp_ns, batch.gyro, batch.accel, batch.frame_id)])


@pytest.fixture
def source(recording: Recording, tmp_path: Path) -> Path:
    path = tmp_path / "in.mcap"
    write(recording, path)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "out"
    path.mkdir()
    return path


@pytest.mark.parametrize("error", [ValueError("a bug"), KeyboardInterrupt(), SystemExit(3)])
def test_a_failure_half_way_leaves_nothing(source: Path, folder: Path, error: BaseException) -> None:
    before, make = source.read_bytes(), Failing(error)
    with pytest.raises(type(error)):
        rewrite(source, folder / "out.mcap", [make], metadata={})
    assert make.seen == 2
    assert list(folder.iterdir()) == []
    assert source.read_bytes() == before


def test_a_failure_keeps_the_file_that_was_to_be_replaced(source: Path, folder: Path) -> None:
    target = folder / "out.mcap"
    target.write_text("precious")
    with pytest.raises(KeyboardInterrupt):
        rewrite(source, target, [Failing(KeyboardInterrupt())], metadata={}, overwrite=True)
    with pytest.raises(ConfigError, match=r"the target exists.*`overwrite=True`"):
        rewrite(source, target, [], metadata={})
    assert [path.read_text() for path in folder.iterdir()] == ["precious"]


def test_a_failing_image_source_leaves_nothing(recording: Recording, folder: Path) -> None:
    def each() -> Iterator[tuple[int, bytes]]:
        yield 1, b"x" * 2_000_000
        raise KeyboardInterrupt

    frames = {"/cam0/image_raw/compressed": Frames("png", 2, each)}
    with pytest.raises(KeyboardInterrupt):
        write(Recording("x", recording.imu, frames=frames), folder / "out.mcap")
    assert list(folder.iterdir()) == []


class FullDisk:
    """A file that takes some bytes and then says what a full disk says."""

    def __init__(self, file: Any, room: int) -> None:
        self.file, self.room = file, room

    def write(self, data: bytes | memoryview) -> int:
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return int(self.file.write(data))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


@pytest.mark.parametrize("room", [0, 5000, 300_000])
@pytest.mark.parametrize("how", ["write", "rewrite"])
def test_a_full_disk_is_said_and_leaves_nothing(
    recording: Recording, source: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, room: int, how: str
) -> None:
    real = Path.open

    def full(self: Path, mode: str = "r", *rest: Any, **options: Any) -> Any:
        file = real(self, mode, *rest, **options)
        return FullDisk(file, room) if mode == "xb" else file

    monkeypatch.setattr(Path, "open", full)
    target = folder / "out.mcap"
    run = partial(write, recording, target) if how == "write" else partial(rewrite, source, target, [], metadata={})
    with pytest.raises(ConfigError, match=r"out.mcap: cannot be written \(No space left on device\)"):
        run()
    assert list(folder.iterdir()) == []


@pytest.fixture
def small_files() -> Iterator[None]:
    """The system itself refuses files beyond 300 kB, as it does when a quota is reached."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_file_the_system_refuses_to_grow_is_said_and_leaves_nothing(
    recording: Recording, folder: Path, small_files: None
) -> None:
    with pytest.raises(ConfigError, match=r"cannot be written \(File too large\)"):
        write(recording, folder / "out.mcap")
    assert list(folder.iterdir()) == []


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere/out.mcap: cannot be written \(No such file or directory\)"):
        Target(tmp_path / "nowhere" / "out.mcap")
    with pytest.raises(ConfigError, match="the target is a folder"):
        Target(tmp_path, overwrite=True)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"cannot be written \(Not a directory\)"):
        Target(tmp_path / "file" / "out.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_a_read_only_folder_is_said(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o555)
    try:
        if os.access(folder, os.W_OK):
            pytest.skip("this user may write anywhere (root)")
        with pytest.raises(ConfigError, match=r"cannot be written \(Permission denied\)"):
            Target(folder / "out.mcap")
    finally:
        folder.chmod(0o755)


@pytest.mark.parametrize("reason", [errno.EACCES, errno.EROFS])
def test_a_refusal_by_the_system_is_said_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: int) -> None:
    def refuse(self: Path, *_: Any, **__: Any) -> Any:
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ConfigError, match=os.strerror(reason)):
        Target(tmp_path / "out.mcap")


def test_a_target_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    target = Target(path)
    target.write(b"ours")
    path.write_text("theirs")
    with pytest.raises(ConfigError, match="the target exists"):
        target.commit()
    assert [p.read_text() for p in tmp_path.iterdir()] == ["theirs"]


def test_a_rename_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, _: Path) -> Path:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(ConfigError, match="Input/output error"), Target(tmp_path / "out.mcap", overwrite=True) as target:
        target.write(b"ours")
    assert list(tmp_path.iterdir()) == []


def test_position_and_crc_are_those_of_the_bytes(tmp_path: Path) -> None:
    with Target(tmp_path / "out") as target:
        target.write(b"123456")
        target.write(memoryview(b"789"))
        assert (target.position, target.crc) == (9, 0xCBF43926)  # the check value of CRC-32
        assert list(tmp_path.iterdir()) == [target.temporary]
    assert (tmp_path / "out").read_bytes() == b"123456789"
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]


def test_a_file_in_the_place_of_a_folder_is_told_as_one(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"precious")
    with pytest.raises(ConfigError, match=r"log\.mcap: is a file; expected a folder"), writing(tmp_path / "log.mcap"):
        (tmp_path / "log.mcap").mkdir(parents=True, exist_ok=True)
    assert (tmp_path / "log.mcap").read_bytes() == b"precious"
