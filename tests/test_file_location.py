"""Logs in object stores: read by ranges, written whole or not at all, and nothing secret said."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.in_process import run_command

import imutool as api
from imutool.debiasing import debias
from imutool.errors import ConfigError, LogError, redact
from imutool.file_location import BLOCK_BYTES, reason, refuse_twins, same_location, to_location
from imutool.log_info.inspection import inspect
from imutool.mcap_io.log import Log
from imutool.mcap_io.rewrite import rewrite
from imutool.mcap_io.storage import upload
from imutool.mcap_io.storage.source import Source, sha256
from imutool.mcap_io.storage.target import Target
from imutool.mcap_io.write import write
from imutool.recording import Frames, Imu, Recording

MIB = 1 << 20
MIN_PART = 5 * MIB  # S3 takes no smaller ones, but for the last

# ── what a user names ──


@pytest.mark.parametrize("text", ["log.mcap", "/data/log.mcap", "s3/log.mcap", "a:b.mcap"])
def test_a_name_without_a_store_is_a_file(text: str) -> None:
    assert to_location(text) == Path(text)
    assert to_location(f"file://{text}") == Path(text)


@pytest.mark.parametrize("text", ["/data/a b.mcap", "/data/50 %/ä#1.mcap"])
def test_a_file_of_a_url_is_the_one_that_it_quotes(text: str) -> None:
    assert to_location(Path(text).as_uri()) == Path(text)
    assert to_location(Path(text).as_uri().replace("///", "//localhost/")) == Path(text)


def test_a_stream_is_no_location() -> None:
    with pytest.raises(ConfigError, match=r"-: is a stream.*\./-"):
        to_location("-")
    assert to_location("./-") == Path("-")


def test_a_url_is_an_object_in_a_store(store: Any) -> None:
    found = to_location("s3://fleet/robot 7/log#1.mcap")
    assert not isinstance(found, Path)
    assert (str(found), found.name, found.stem) == ("s3://fleet/robot 7/log#1.mcap", "log#1.mcap", "log#1")
    assert store.requests == []


def test_an_unknown_store_is_refused_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"ftp://host/log.mcap: unknown kind of store; expected s3://, gs://, az://"):
        to_location("ftp://host/log.mcap")


@pytest.mark.parametrize(("url", "package"), [("gs://bucket/log.mcap", "gcsfs"), ("az://container/log.mcap", "adlfs")])
def test_a_store_without_its_package_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, url: str, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf"needs a package .* pip install 'imutool\[cloud\]' {package}"):
        to_location(url)


def test_without_fsspec_the_message_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "upath", None)
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[cloud\]'"):
        to_location("s3://bucket/log.mcap")


@pytest.mark.parametrize(
    "url",
    [
        "s3://AKIA:hush@bucket/log.mcap",
        "https://me:hush@host/log.mcap",
        "az://me:hush@account/log.mcap",
        "ftp://me:hush@host/log.mcap",
        "https://host/log.mcap?X-Amz-Signature=hush&X-Amz-Credential=hush",
    ],
)
def test_a_url_with_something_secret_in_it_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(ConfigError) as raised:
        to_location(url)
    assert "hush" not in str(raised.value)


def test_a_place_is_itself_and_no_other(tmp_path: Path, store: Any) -> None:
    (tmp_path / "a").touch()
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert same_location(tmp_path / "a", tmp_path / "b")
    assert same_location(to_location("s3://fleet/a"), to_location("s3://fleet/a"))
    assert not same_location(to_location("s3://fleet/a"), to_location("s3://fleet/b"))
    assert not same_location(to_location("s3://fleet/a"), Path("/fleet/a"))


# ── a log in a store ──


@pytest.fixture
def flight(logs: Path) -> bytes:
    return (logs / "flight_1.mcap").read_bytes()


def test_debias_from_store_to_store_is_byte_for_byte_the_local_result(
    store: Any, logs: Path, tmp_path: Path, flight: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, model = store.put("in/flight_1.mcap", flight), logs / "linear.safetensors"
    opened: list[str] = []
    original = Source.__init__

    def open_source(source: Source, path: Any, *words: Any) -> None:
        opened.append(str(path))
        original(source, path, *words)

    monkeypatch.setattr(Source, "__init__", open_source)
    debias(to_location(url), to_location("s3://fleet/out/log.mcap"), model=model)
    assert opened.count(url) == 2  # once to read, once more for its checksum
    debias(logs / "flight_1.mcap", tmp_path / "log.mcap", model=model)
    assert store.get("out/log.mcap") == (tmp_path / "log.mcap").read_bytes()
    assert store.keys() == ["in/flight_1.mcap", "out/log.mcap"]
    assert store.uploads() == []
    assert store.get("in/flight_1.mcap") == flight


def test_the_command_debiases_and_describes_logs_in_a_store_and_says_nothing_secret(
    store: Any, imutool: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path, flight: bytes
) -> None:
    store.put("in.mcap", flight)
    done = imutool(
        "debias", "s3://fleet/in.mcap", "s3://fleet/out.mcap", "--model", "static", "--json", "report.json", "-v", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    told = imutool("info", "s3://fleet/out.mcap", "--json", "info.json", cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    written = [(tmp_path / name).read_bytes() for name in ("report.json", "info.json")] + [store.get("out.mcap")]
    assert b"s3://fleet/out.mcap" in written[0]
    assert b"/imu0/debiased" in written[1]
    said = [text.encode() for run in (done, told) for text in (run.stdout, run.stderr)]
    for secret in (store.key_id, store.secret):
        assert not [text for text in [*said, *written] if secret.encode() in text]


def test_a_key_that_is_taken_is_refused_without_overwrite(store: Any, flight: bytes) -> None:
    source, taken = to_location(store.put("in.mcap", flight)), to_location(store.put("out.mcap", b"precious"))
    with pytest.raises(ConfigError, match=r"s3://fleet/out.mcap: the target exists.*`overwrite=True`"):
        rewrite(source, taken, [], metadata={})
    assert store.get("out.mcap") == b"precious"
    with pytest.raises(ConfigError, match="the target is the source"):
        rewrite(source, source, [], metadata={}, overwrite=True)
    report = rewrite(source, taken, [], metadata={}, overwrite=True)
    assert len(store.get("out.mcap")) == report.target_bytes
    assert store.keys() == ["in.mcap", "out.mcap"]


def test_a_large_object_goes_up_in_parts_and_comes_back(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    data = bytes(range(256)) * (11 * MIB // 256)
    monkeypatch.setattr(upload, "PART_BYTES", MIN_PART)
    with Target(to_location("s3://fleet/large")) as target:
        for at in range(0, len(data), MIB):
            target.write(data[at : at + MIB])
        assert store.uploads() == [target.temporary.name]
        assert store.keys() == []
        target.flush()
        assert (store.uploads(), store.keys()) == ([], [target.temporary.name])
    assert (store.uploads(), store.keys()) == ([], ["large"])
    assert store.get("large") == data
    assert sum("partNumber" in request.query for request in store.requests) == 3


def test_parts_grow_so_that_there_are_never_too_many_of_them(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(upload, "PART_BYTES", MIN_PART)
    monkeypatch.setattr(upload, "LARGE_AFTER", MIN_PART)
    monkeypatch.setattr(upload, "LARGE_PART_BYTES", 8 * MIB)
    filled("s3://fleet/large", 22, MIB)
    assert sum("partNumber" in request.query for request in store.requests) == 4  # of 5, 8, 8 and 1 MiB
    assert len(store.get("large")) == 22 * MIB
    assert upload.LARGE_AFTER / upload.PART_BYTES < 10_000


def filled(url: str, pieces: int = 1, size: int = 4, then: Callable[[Target], object] = lambda _: None) -> None:
    """Writes an object of some pieces, and does something to it before it is put in its place."""
    with Target(to_location(url)) as target:
        for _ in range(pieces):
            target.write(bytes(size))
        then(target)


@pytest.mark.parametrize("error", [ValueError("a bug"), KeyboardInterrupt()])
@pytest.mark.parametrize("complete", [False, True])
def test_an_upload_that_is_given_up_leaves_neither_parts_nor_objects(
    store: Any, monkeypatch: pytest.MonkeyPatch, error: BaseException, complete: bool
) -> None:
    def give_up(target: Target) -> None:
        if complete:
            target.flush()
        assert (store.keys() if complete else store.uploads()) == [target.temporary.name]
        raise error

    monkeypatch.setattr(upload, "PART_BYTES", MIN_PART)
    with pytest.raises(type(error)):
        filled("s3://fleet/out", 1, 6 * MIB, give_up)
    assert (store.uploads(), store.keys()) == ([], [])


def test_a_target_that_is_forgotten_leaves_nothing(store: Any) -> None:
    target = Target(to_location("s3://fleet/out"))
    target.write(b"ours")
    del target
    assert (store.uploads(), store.keys()) == ([], [])


def test_an_object_that_appears_meanwhile_is_not_replaced(store: Any) -> None:
    with pytest.raises(ConfigError, match=r"s3://fleet/out: the target exists"):
        filled("s3://fleet/out", then=lambda _: store.put("out", b"theirs"))
    assert store.keys() == ["out"]
    assert store.get("out") == b"theirs"


def test_a_temporary_object_that_somebody_changed_is_not_published(store: Any) -> None:
    def change(target: Target) -> None:
        target.flush()
        store.put(target.temporary.name, b"not!")

    with pytest.raises(ConfigError, match="was changed while"):
        filled("s3://fleet/out", then=change)
    assert store.keys() == []


def test_a_large_object_that_cannot_be_copied_to_its_key_leaves_no_parts(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s3fs.core.MANAGED_COPY_THRESHOLD", 1)  # from where s3fs copies in parts; else 150 MiB
    filled("s3://fleet/large", 2, 6 * MIB)
    assert (store.uploads(), store.keys()) == ([], ["large"])
    store.fault = failing(of("PUT", "larger", "partNumber"), "500")
    with pytest.raises(ConfigError, match=r"s3://fleet/larger: cannot be written"):
        filled("s3://fleet/larger", 2, 6 * MIB)
    assert (store.uploads(), store.keys()) == ([], ["large"])


def test_any_store_of_fsspec_serves(logs: Path, tmp_path: Path) -> None:
    fs = to_location("memory://").fs
    fs.store.clear()
    fs.pipe_file("/in/log.mcap", (logs / "flight_1.mcap").read_bytes())
    rewrite(to_location("memory://in/log.mcap"), to_location("memory://out/log.mcap"), [], metadata={})
    rewrite(logs / "flight_1.mcap", tmp_path / "log.mcap", [], metadata={})
    assert fs.cat_file("/out/log.mcap") == (tmp_path / "log.mcap").read_bytes()
    assert sorted(fs.store) == ["/in/log.mcap", "/out/log.mcap"]
    with pytest.raises(ZeroDivisionError):
        filled("memory://out/other.mcap", then=lambda _: 1 // 0)
    assert sorted(fs.store) == ["/in/log.mcap", "/out/log.mcap"]


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None: ...


def test_a_web_server_s_log_is_debiased_as_the_file_is_under_its_own_name(logs: Path, tmp_path: Path) -> None:
    model, file = logs / "linear.safetensors", tmp_path / "two words.mcap"
    file.write_bytes((logs / "flight_1.mcap").read_bytes())
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        log = to_location(f"http://127.0.0.1:{server.server_port}/two%20words.mcap")
        assert inspect(log).log == "two words"
        report = debias(log, tmp_path / "out.mcap", model=model)
        server.shutdown()
    assert report.rewrite.added == debias(file, tmp_path / "b.mcap", model=model).rewrite.added


def test_a_web_server_that_sends_no_parts_is_named(tmp_path: Path) -> None:
    """The message advised an argument of the library."""
    (tmp_path / "large.mcap").write_bytes(bytes(9 * MIB))  # of more than two blocks
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(LogError, match="sends files as a whole and no part of one: fetch it first"):
            Source(to_location(f"http://127.0.0.1:{server.server_port}/large.mcap")).at(8 * MIB, 100)
        server.shutdown()


def test_a_web_server_that_is_away_is_no_missing_object() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"http://127.0.0.1:{free.getsockname()[1]}/log.mcap"
    with pytest.raises(ConfigError, match="Connect call failed"), Log(to_location(url)):
        pass


@pytest.mark.parametrize("words", [["train", "-o", "m.safetensors"], ["diagnose"]])
def test_a_log_that_is_given_twice_is_refused(imutool: Any, tmp_path: Path, logs: Path, words: list[str]) -> None:
    """Its samples counted twice: deviations became too small, and a left-out log was trained on."""
    (tmp_path / "a.mcap").symlink_to(logs / "flight_1.mcap")
    (tmp_path / "b.mcap").symlink_to(tmp_path / "a.mcap")
    done = imutool(words[0], "a.mcap", "b.mcap", *words[1:], cwd=tmp_path)
    assert done.returncode == ConfigError.exit_code
    assert "a.mcap and b.mcap are one log; expected each log once" in done.stderr
    run = api.diagnose if words == ["diagnose"] else partial(api.train, out=tmp_path / "m.safetensors")
    with pytest.raises(ConfigError, match="is given twice"):
        run([tmp_path / "a.mcap", str(tmp_path / "a.mcap")])
    with pytest.raises(ConfigError, match="are given twice"):
        run([api.read(tmp_path / "a.mcap"), api.read(tmp_path / "a.mcap")])


def test_a_file_is_asked_for_once_to_find_logs_that_are_given_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three thousand logs took half a minute of pairs."""
    logs = [tmp_path / f"{number}.mcap" for number in range(20)]
    for log in logs:
        log.touch()
    asked, stat = [], Path.stat
    monkeypatch.setattr(Path, "stat", lambda path, **how: asked.append(path) or stat(path, **how))
    refuse_twins([*logs, tmp_path / "missing", tmp_path / "missing"], "logs")
    assert len(asked) == len(logs) + 2
    with pytest.raises(ConfigError, match="is given twice"):
        refuse_twins([*logs, logs[3]], "logs")


def test_a_name_with_a_zero_byte_is_said() -> None:
    with pytest.raises(ConfigError, match=r"cannot be opened .no name of a file holds a zero byte"):
        Source(to_location("a\0b.mcap"))


def test_a_temporary_object_that_cannot_be_removed_spoils_nothing(store: Any, caplog: pytest.LogCaptureFixture) -> None:
    store.fault = failing(of("DELETE", "partial"), "403")
    filled("s3://fleet/out")
    assert store.get("out") == bytes(4)
    assert "could not be removed: the store refuses access" in caplog.text


# ── a store that fails ──


def of(method: str, key: str, query: str = "") -> Callable[[Any], bool]:
    """Whether a request is of a kind."""
    return lambda request: request.method == method and key in request.path and query in request.query


def failing(wanted: Callable[[Any], bool], how: str, times: int = 10**9) -> Callable[[Any], str | None]:
    """The first so many requests of a kind go wrong."""
    left = [times]

    def fault(request: Any) -> str | None:
        if not wanted(request) or not left[0]:
            return None
        left[0] -= 1
        return how

    return fault


@pytest.mark.parametrize("how", ["500", "503", "cut"])
@pytest.mark.parametrize("wanted", [of("GET", "in.mcap"), of("PUT", "partial"), of("PUT", "out.mcap"), of("HEAD", "out.mcap")])
def test_a_store_that_fails_once_is_asked_again(store: Any, flight: bytes, wanted: Any, how: str) -> None:
    source = to_location(store.put("in.mcap", flight))
    store.fault = failing(wanted, how, times=1)
    report = rewrite(source, to_location("s3://fleet/out.mcap"), [], metadata={})
    assert len(store.get("out.mcap")) == report.target_bytes
    assert (store.keys(), store.uploads()) == (["in.mcap", "out.mcap"], [])


@pytest.mark.parametrize("how", ["500", "cut"])
def test_a_store_that_fails_for_good_while_a_log_is_read_is_said_and_nothing_is_left(
    store: Any, flight: bytes, how: str
) -> None:
    url = store.put("in.mcap", flight + bytes(2 * BLOCK_BYTES))
    source = Source(to_location(url))
    assert source.at(0, 8) == flight[:8]
    store.fault = failing(of("GET", "in.mcap"), how)
    with pytest.raises(LogError, match=r"cannot be read at byte 5000000 \(.+\)") as raised:
        source.at(5_000_000, 10)
    source.file.close()
    assert store.secret not in str(raised.value)
    with pytest.raises(LogError, match=r"s3://fleet/in.mcap: cannot be read at byte"):
        rewrite(to_location(url), to_location("s3://fleet/out.mcap"), [], metadata={})
    assert (store.keys(), store.uploads()) == (["in.mcap"], [])


@pytest.mark.parametrize("how", ["500", "cut"])
@pytest.mark.parametrize(
    "wanted", [of("PUT", "partial", "partNumber=2"), of("POST", "partial", "uploadId"), of("PUT", "large")]
)
def test_a_store_that_fails_for_good_while_a_log_is_written_is_said_and_nothing_is_left(
    store: Any, monkeypatch: pytest.MonkeyPatch, wanted: Any, how: str
) -> None:
    monkeypatch.setattr(upload, "PART_BYTES", MIN_PART)
    store.fault = failing(wanted, how)
    with pytest.raises(ConfigError, match=r"s3://fleet/large: cannot be written \(.+\)") as raised:
        filled("s3://fleet/large", 2, 6 * MIB)
    assert store.secret not in str(raised.value)
    assert (store.uploads(), store.keys()) == ([], [])


def test_what_the_store_refuses_is_said(store: Any, flight: bytes) -> None:
    with pytest.raises(ConfigError, match=r"s3://fleet/none.mcap: cannot be opened \(no such object, or no such bucket\)"):
        Log(to_location("s3://fleet/none.mcap"))
    with pytest.raises(ConfigError, match=r"s3://none/in.mcap: cannot be opened \(no such object, or no such bucket\)"):
        Log(to_location("s3://none/in.mcap"))
    with pytest.raises(ConfigError, match=r"s3://none/out: cannot be written \(no such object, or no such bucket\)"):
        filled("s3://none/out")
    store.fault = failing(of("HEAD", "in.mcap"), "403")
    url = store.put("in.mcap", flight)
    with pytest.raises(ConfigError, match=r"s3://fleet/in.mcap: cannot be opened \(the store refuses access: Forbidden\)"):
        Log(to_location(url))
    store.fault = failing(of("PUT", "partial"), "403")
    with pytest.raises(ConfigError, match=r"s3://fleet/out: cannot be written \(the store refuses access"):
        filled("s3://fleet/out")
    assert store.keys() == ["in.mcap"]


def test_without_credentials_the_message_says_so(store: Any, imutool: Any, tmp_path: Path, flight: bytes) -> None:
    store.put("in.mcap", flight)
    env = {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": "", "AWS_EC2_METADATA_DISABLED": "true", "HOME": str(tmp_path)}
    done = imutool("info", "s3://fleet/in.mcap", cwd=tmp_path, apart=True, env=env)
    assert done.returncode == ConfigError.exit_code
    assert "cannot be opened (Unable to locate credentials)" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", [["repair", "in.mcap", "s3://fleet/out.mcap"], ["fleet", "info", ".", "s3://fleet/out"]])
def test_without_credentials_an_output_is_refused_with_a_message(
    store: Any, imutool: Any, tmp_path: Path, flight: bytes, words: list[str]
) -> None:
    (tmp_path / "in.mcap").write_bytes(flight)
    env = {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": "", "AWS_EC2_METADATA_DISABLED": "true", "HOME": str(tmp_path)}
    done = imutool(*words, cwd=tmp_path, apart=True, env=env)
    assert done.returncode == ConfigError.exit_code
    assert "Unable to locate credentials" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_a_command_that_takes_files_alone_says_so_of_a_url(imutool: Any, tmp_path: Path, logs: Path) -> None:
    refused = imutool("evaluate", "s3://fleet/in.mcap", cwd=tmp_path)
    assert refused.returncode == ConfigError.exit_code
    assert "s3://fleet/in.mcap: is in an object store" in " ".join(refused.stderr.split())
    taken = imutool("clean", f"file://{logs / 'flight_1.mcap'}", f"file://{tmp_path / 'out.mcap'}", cwd=tmp_path)
    assert (taken.returncode, (tmp_path / "out.mcap").is_file()) == (0, True), taken.stderr


@pytest.mark.parametrize("words", [["view", "memory://a/b.mcap"], ["diagnose", "r.mcap", "--sim", "memory://a/b.mcap"]])
def test_what_is_looked_at_may_be_in_a_store(imutool: Any, tmp_path: Path, logs: Path, words: list[str]) -> None:
    (tmp_path / "r.mcap").write_bytes((logs / "flight_1.mcap").read_bytes())
    refused = imutool(*words, cwd=tmp_path)
    assert "memory://a/b.mcap: cannot be opened (no such object" in " ".join(refused.stderr.split())


def test_an_object_that_changes_while_it_is_read_is_said(store: Any, flight: bytes) -> None:
    source = Source(to_location(store.put("in.mcap", flight + bytes(2 * BLOCK_BYTES))))
    store.put("in.mcap", flight[::-1] + bytes(2 * BLOCK_BYTES))
    with pytest.raises(LogError, match="cannot be read at byte 5000000"):
        source.at(5_000_000, 10)
    source.file.close()


def test_the_hash_of_an_object_is_that_of_its_bytes(store: Any, logs: Path, flight: bytes) -> None:
    assert sha256(to_location(store.put("in.mcap", flight))) == sha256(logs / "flight_1.mcap")


def test_a_log_is_described_as_the_file_is(store: Any, logs: Path, flight: bytes) -> None:
    there, here = inspect(to_location(store.put("flight_1.mcap", flight))), inspect(logs / "flight_1.mcap")
    assert there.path == "s3://fleet/flight_1.mcap"
    assert msgspec.structs.replace(there, path=here.path) == here


def test_a_debias_that_is_terminated_in_the_middle_of_its_upload_leaves_nothing(
    store: Any, command: str, tmp_path: Path
) -> None:
    t_ns = 10**18 + np.arange(400) * 5_000_000
    images = Frames("png", 100, lambda: iter([(int(t_ns[4 * n]), bytes([n]) * 200_000) for n in range(100)]))
    write(
        Recording("r", Imu(t_ns, np.zeros((400, 3)), np.tile([0, 0, 9.81], (400, 1))), frames={"/cam0": images}),
        tmp_path / "in.mcap",
    )
    url, half_way = store.put("in.mcap", (tmp_path / "in.mcap").read_bytes()), threading.Event()

    def slow(request: Any) -> None:
        if "partNumber=2" in request.query:
            half_way.set()
            time.sleep(2.0)

    store.fault = slow
    line = [command, "debias", url, "s3://fleet/out.mcap", "--model", "static", "-q"]
    with subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        assert half_way.wait(60)
        assert len(store.uploads()) == 1
        process.send_signal(signal.SIGTERM)
        _, stderr = process.communicate(timeout=60)
    assert (process.returncode, stderr) == (143, b"error: ended by SIGTERM. Nothing half-written is left.\n")
    assert (store.uploads(), store.keys()) == ([], ["in.mcap"])


@pytest.mark.parametrize(
    "text",
    [
        'Could not connect to the endpoint URL: "http://me:hush@host:9000/fleet"',
        "https://host/log?X-Amz-Credential=hush&X-Amz-Signature=hush failed",
        "https://account.blob.core.windows.net/c/log?sv=1&sig=hush",
    ],
)
def test_what_a_store_says_is_repeated_without_its_secrets(text: str) -> None:
    for error in (ValueError(text), PermissionError(text), OSError(5, text)):
        assert "hush" not in reason(error)
        assert "host" in reason(error) or "account" in reason(error)


SIGNED = [
    "https://host/log.mcap?X-Amz-Signature=hush",
    "https://host/log.mcap#token=hush",
    "https://host/log.mcap?hush",
    "s3://fleet/log.mcap?X-Amz-Signature=hush&more=hush",
    "s3://fleet/log.mcap#access_token=hush",
    "ftp://host/log.mcap?sig=hush",
]


@pytest.mark.parametrize("url", SIGNED)
def test_a_secret_in_a_query_or_fragment_is_not_echoed(url: str, tmp_path: Path, logs: Path) -> None:
    log = str(logs / "flight_1.mcap")
    commands = [
        ["info", url],
        ["debias", url, "out.mcap"],
        ["debias", log, "out.mcap", "--model", url],
        ["repair", log, url],
    ]
    fleets = [
        ["info", url, "out"],
        ["info", log, url],
        ["info", log, "out", "--report", url],
        ["info", log, "out", "--address", url],
    ]
    commands += [["fleet", *words] for words in fleets]
    for words in commands:
        done = run_command(words, tmp_path, os.environ)  # fleets too: they are refused before a worker starts
        assert done.returncode in (2, 3, 5, 6), (words, done.stderr)
        assert "hush" not in done.stdout + done.stderr, words
        assert "error" in done.stderr.lower(), done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and b"hush" in path.read_bytes()]


def test_wildcards_and_keys_are_no_queries() -> None:
    for url in ("s3://fleet/log_?.mcap", "s3://fleet/day=2024-0?/log.mcap", "s3://fleet/a#1.mcap"):
        assert str(to_location(url)) == url
        assert redact(url) == url


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_pipe_or_device_is_refused_before_it_is_opened(
    kind: str, imutool: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    odd = tmp_path / "odd.mcap"
    os.mkfifo(odd) if kind == "pipe" else odd.symlink_to("/dev/zero")
    for words in (
        ["info", odd],
        ["clean", odd],
        ["repair", odd, "out.mcap"],
        ["debias", odd, "out.mcap"],
        ["convert", tmp_path, "out"],
    ):
        done = imutool(*words, cwd=tmp_path)
        assert done.returncode in (3, 4, 5), (words, done.stderr)
        assert "error:" in done.stderr


def test_a_delete_that_fails_is_tried_again(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imutool.mcap_io.storage.upload.DELETE_PAUSES_S", (0.0, 0.0))
    refused: list[Any] = []

    def fault(request: Any) -> str | None:
        if request.method == "DELETE" and len(refused) < 2:
            refused.append(request)
            return "403"
        return None

    store.fault = fault
    with Target(to_location("s3://fleet/a.json")) as out:
        out.write(b"{}")
    assert len(refused) == 2
    assert store.keys() == ["a.json"]
