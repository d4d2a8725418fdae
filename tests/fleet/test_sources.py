"""Logs are found and named: never outside OUT, never two alike, whatever they are called."""

from __future__ import annotations

import errno
import os
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from imutool.errors import ConfigError
from imutool.file_location import identity, to_location
from imutool.fleet.sources import Found, find, with_simulations
from imutool.fleet.targets import LONGEST
from imutool.fleet.task import Settings, with_model_hash

NOWHERE = Path("/nowhere")


def tree(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return folder


def names(text: str | Path, out: Path = NOWHERE) -> list[str]:
    return [one.name for one in find(str(text), out).logs]


def test_logs_of_the_same_name_keep_their_folders(tmp_path: Path) -> None:
    tree(tmp_path, "a/log.mcap", "b/log.mcap", "b/c/log.mcap", "b/readme.txt")
    assert names(tmp_path) == ["a/log.mcap", "b/c/log.mcap", "b/log.mcap"]
    assert names(tmp_path / "a" / "log.mcap") == ["log.mcap"]
    assert names(tmp_path / "*" / "log.mcap") == ["a/log.mcap", "b/log.mcap"]
    assert names(tmp_path / "b" / "**" / "*.mcap") == ["c/log.mcap", "log.mcap"]


def test_logs_and_a_model_are_the_same_from_another_folder(tmp_path: Path, logs: Path) -> None:
    """Else `resume` does all logs again, or refuses its own model."""
    tree(tmp_path, "a/log.mcap", "b/c/log.mcap")
    for place in ("a", "a/log.mcap", "b/.."):
        assert find(str(tmp_path / "b" / ".." / place), NOWHERE).logs == find(str(tmp_path / place), NOWHERE).logs
    (tmp_path / "b" / "latest.safetensors").symlink_to(logs / "linear.safetensors")
    models = (tmp_path / "b" / way / "latest.safetensors" for way in (".", "c/.."))
    first, second = (with_model_hash(Settings(command="debias", model=str(model))) for model in models)
    assert first == second


def test_endings_in_capital_letters_are_endings(tmp_path: Path) -> None:
    tree(tmp_path, "A.MCAP", "b.mcap", "c/D.Mcap", "e.BAG")
    assert names(tmp_path) == ["A.MCAP", "b.mcap", "c/D.Mcap"]
    assert [one.name for one in find(f"{tmp_path}/**/*", NOWHERE, bags=True).logs] == ["A.MCAP", "b.mcap", "c/D.Mcap", "e.BAG"]


def test_bags_are_taken_where_asked_for_and_keep_their_names(tmp_path: Path) -> None:
    tree(tmp_path, "a/log.mcap", "a/log.bag", "b.bag")
    assert names(tmp_path) == ["a/log.mcap"]
    for every in (tmp_path, tmp_path / "**" / "*"):
        assert [one.name for one in find(str(every), NOWHERE, bags=True).logs] == ["a/log.bag", "a/log.mcap", "b.bag"]
    with pytest.raises(ConfigError, match=r"no \.mcap or \.bag log"):
        find(str(tree(tmp_path / "none", "x.txt")), NOWHERE, bags=True)


def test_other_recordings_are_passed_over_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tree(tmp_path, "a/log.mcap", "a/log.bag", "b.BAG", "t.csv", "u.tar.gz", "readme.txt")
    assert names(tmp_path) == ["a/log.mcap"]
    assert "passed over (2 .bag, 1 .csv, 1 .tar.gz); imutool convert" in caplog.text
    (tmp_path / "a" / "log.mcap").unlink()
    with pytest.raises(ConfigError, match=r"no \.mcap log.*imutool convert makes logs"):
        find(str(tmp_path), NOWHERE)


def test_what_lies_in_out_is_no_source(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tree(tmp_path, "a.mcap", "out/a.mcap", "outer/a.mcap")
    assert names(tmp_path, tmp_path / "out") == ["a.mcap", "outer/a.mcap"]
    assert "of its logs 1 are left out, for they lie below OUT" in caplog.text
    caplog.clear()
    (tmp_path / "out" / "fleet.journal").touch()  # then they are the results of an earlier run
    assert names(tmp_path, tmp_path / "out") == ["a.mcap", "outer/a.mcap"]
    assert not caplog.text


def test_what_lies_in_out_is_no_source_whatever_link_leads_there(tmp_path: Path) -> None:
    tree(tmp_path / "disk", "a.mcap", "out/a.mcap")
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    assert names(tmp_path / "link", tmp_path / "disk" / "out") == ["a.mcap"]
    assert names(tmp_path / "disk", tmp_path / "link" / "out") == ["a.mcap"]
    (tmp_path / "disk" / "to_out.mcap").symlink_to("out/a.mcap")  # another log's result would replace it
    assert names(tmp_path / "disk", tmp_path / "disk" / "out") == ["a.mcap"]


@pytest.mark.parametrize("out", [".", "logs"])
def test_logs_that_all_lie_in_out_are_told_as_such(tmp_path: Path, out: str) -> None:
    tree(tmp_path, "logs/a.mcap", "logs/b.mcap")
    with pytest.raises(ConfigError, match=r"its 2 logs lie below OUT .*Choose an OUT outside the folder of the logs"):
        find(str(tmp_path / "logs"), tmp_path / out)


@pytest.mark.parametrize("pattern", ["", "**/*.mcap"])
def test_a_folder_that_cannot_be_read_is_told_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pattern: str
) -> None:
    tree(tmp_path, "good.mcap", "lost+found/a.mcap")
    (tmp_path / "circle.mcap").symlink_to("circle.mcap")
    listed = os.scandir

    def scandir(folder: Path) -> Any:
        if Path(folder).name == "lost+found":  # chmod does not stop root
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return listed(folder)

    monkeypatch.setattr(os, "scandir", scandir)
    found = find(str(tmp_path / pattern), NOWHERE)
    assert [log.name for log in found.logs] == ["good.mcap"]
    assert [Path(where).name for where, _ in found.refused] == ["circle.mcap", "lost+found"]
    assert "cannot be read (Permission denied)" in found.refused[1][1]


def test_a_log_in_a_folder_that_may_be_listed_only_is_told_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree(tmp_path, "good.mcap", "listed/a.mcap")
    asked = Path.stat

    def stat(path: Path, **options: Any) -> os.stat_result:
        if path.name == "a.mcap":  # chmod does not stop root
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return asked(path, **options)

    monkeypatch.setattr(Path, "stat", stat)
    found = find(str(tmp_path), NOWHERE)
    assert [log.name for log in found.logs] == ["good.mcap"]
    assert [Path(where).name for where, _ in found.refused] == ["a.mcap"]


def test_a_link_to_another_log_counts_once_where_logs_are_compared(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fleet = tree(tmp_path, "robot/monday.mcap", "robot/tuesday.mcap")
    (fleet / "robot" / "latest.mcap").symlink_to("tuesday.mcap")
    (fleet / "again").symlink_to("robot")
    every = [log.name for log in find(str(fleet), NOWHERE).logs]
    assert len(every) == 6
    kept = [log.name for log in find(str(fleet), NOWHERE, once=True).logs]
    assert kept == ["robot/monday.mcap", "robot/tuesday.mcap"]
    assert "4 logs are links to others" in caplog.text


def test_links_to_logs_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    tree(tmp_path / "disk", "x/log.mcap")
    fleet = tree(tmp_path / "fleet", "own.mcap")
    (fleet / "robot").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "x" / "back").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "x" / "again").symlink_to(tmp_path / "disk")  # two circles: a pattern took 2^40 ways
    for each in (fleet, fleet / "**", fleet / "**" / "*.mcap"):
        assert names(each) == ["own.mcap", "robot/x/log.mcap"]


@pytest.mark.parametrize("empty", ["", "*.mcap", "none", "none/*.mcap"])
def test_no_logs_is_an_error_that_says_so(tmp_path: Path, empty: str) -> None:
    with pytest.raises(ConfigError, match=r"no \.mcap log|is not there"):
        find(str(tmp_path / empty), NOWHERE)


HOSTILE = [
    "bell\a.mcap",
    "line\nbreak.mcap",
    "fleet.mcap",
    "back\\slash.mcap",
    f"{'x' * LONGEST}.mcap",
    b"\xff.mcap",
]


@pytest.mark.parametrize("name", HOSTILE, ids=repr)
def test_a_hostile_name_is_refused_and_the_others_go_on(tmp_path: Path, name: str | bytes) -> None:
    tree(tmp_path, "good.mcap")
    (tmp_path / os.fsdecode(name)).write_bytes(b"")
    found = find(str(tmp_path), NOWHERE)
    assert [one.name for one in found.logs] == ["good.mcap"]
    ((where, why),) = found.refused
    assert where.encode()  # it can be written down
    assert "name" in why


def test_hidden_files_are_no_logs(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """macOS writes a ._NAME next to each file on foreign disks; its trash is a folder that nobody may list."""
    hidden = ("._log.mcap", "a/._log.mcap", "a/__MACOSX/a/._log.mcap", "._t.csv", ".Trashes/501/old.mcap")
    tree(tmp_path, "log.mcap", "a/log.mcap", *hidden)
    found = find(str(tmp_path), NOWHERE)
    assert ([log.name for log in found.logs], found.refused) == (["a/log.mcap", "log.mcap"], [])
    assert caplog.messages == [f"{tmp_path}: files that are no MCAP logs are passed over (4 hidden)"]
    assert names(tmp_path / "**") == ["a/log.mcap", "log.mcap"]
    with pytest.raises(ConfigError, match=r"no \.mcap log.*Rename its 1 hidden files"):
        find(str(tmp_path / "._log.mcap"), NOWHERE)


@pytest.mark.parametrize("twins", [("Log.mcap", "log.mcap"), ("k\u00fche.mcap", "ku\u0308he.mcap")])
def test_names_that_differ_in_case_or_unicode_form_alone_are_one_on_some_systems(
    tmp_path: Path, twins: tuple[str, str]
) -> None:
    tree(tmp_path, *twins)
    found = find(str(tmp_path), NOWHERE)
    assert len(found.logs) == 1
    ((_, why),) = found.refused
    assert "would be called" in why


def test_another_simulation_is_another_key(tmp_path: Path) -> None:
    """The result of a log was skipped once although what it is compared with had changed."""
    logs, sims = tree(tmp_path / "logs", "a.mcap", "b.mcap"), tree(tmp_path / "sims", "a.mcap")
    settings = Settings(command="diagnose", sim=str(sims))

    def keys(sim: str | None) -> list[str]:
        return [log.key(settings) for log in with_simulations(find(str(logs), NOWHERE), sim).logs]

    before = keys(str(sims))
    assert keys(str(sims)) == before
    assert keys(None)[1] == before[1], "b has no simulation"
    (sims / "a.mcap").write_bytes(b"another one")
    assert keys(str(sims))[0] != before[0]
    assert keys(str(sims))[1] == before[1]
    assert keys(str(sims / "a.mcap"))[1] != before[1], "one for all"
    with pytest.raises(ConfigError, match="is not there"):
        keys(str(tmp_path / "none"))


def test_another_content_is_another_identity(tmp_path: Path) -> None:
    path = tree(tmp_path, "a.mcap") / "a.mcap"
    before = identity(path)
    os.utime(path, ns=(1, 1))
    assert identity(path) == (before[0], "1")
    path.write_bytes(b"more than there was")
    assert identity(path)[0] != before[0]


def test_a_pipe_a_socket_and_a_device_are_told_and_not_opened(tmp_path: Path) -> None:
    tree(tmp_path, "good.mcap")
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "device.mcap").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket.mcap"))
        found = find(str(tmp_path), NOWHERE)
    assert [log.name for log in found.logs] == ["good.mcap"]
    assert [Path(where).name for where, _ in found.refused] == ["device.mcap", "pipe.mcap", "socket.mcap"]
    assert all("is a pipe, a socket or a device" in why for _, why in found.refused)
    assert "is a pipe" in find(str(tmp_path / "pipe.mcap"), NOWHERE).refused[0][1]


def test_a_store_is_listed_in_one_request(store: Any) -> None:
    for key in ("robots/a/log.mcap", "robots/b/log.mcap", "robots/b/notes.txt", "out/a/log.mcap"):
        store.put(key, b"12345")
    store.requests.clear()
    found = find("s3://fleet/robots", to_location("s3://fleet/robots/out")).logs
    assert [(one.place, one.name, one.size) for one in found] == [
        ("s3://fleet/robots/a/log.mcap", "a/log.mcap", 5),
        ("s3://fleet/robots/b/log.mcap", "b/log.mcap", 5),
    ]
    assert len(store.requests) <= 2
    assert identity(to_location("s3://fleet/robots/a/log.mcap")) == (5, found[0].stamp)
    assert [one.name for one in find("s3://fleet/*/b/*.mcap", NOWHERE).logs] == ["robots/b/log.mcap"]
    assert [one.name for one in find("s3://fleet/robots/b/log.mcap", NOWHERE).logs] == ["log.mcap"]
    with pytest.raises(ConfigError, match=r"no \.mcap log"):
        find("s3://fleet/none", NOWHERE)


class _WebServer(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextmanager
def _web(folder: Path, handler: type[SimpleHTTPRequestHandler] = _WebServer) -> Iterator[str]:
    """Address of a web server that shows a folder."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def test_a_web_server_is_listed_although_it_tells_no_sizes(tmp_path: Path) -> None:
    tree(tmp_path, "robots/a/log.mcap", "robots/b/notes.txt", "robots/b/other.mcap", "robots/c/run 1 (é).mcap")
    (tmp_path / "robots" / "latest.mcap").symlink_to("removed.mcap")
    with _web(tmp_path) as server:
        root = f"{server}/robots"
        found, refused = find(root, NOWHERE)
        compared = with_simulations(Found(found, []), root)
        (alone,) = find(f"{root}/b/other.mcap", NOWHERE).logs
        assert identity(to_location(alone.place)) == (alone.size, alone.stamp)
    assert [(log.place, log.name, log.size) for log in found] == [
        (f"{root}/a/log.mcap", "a/log.mcap", len("robots/a/log.mcap")),
        (f"{root}/b/other.mcap", "b/other.mcap", len("robots/b/other.mcap")),
        (f"{root}/c/run%201%20%28%C3%A9%29.mcap", "c/run 1 (é).mcap", len("robots/c/run 1 (é).mcap".encode())),
    ]
    assert compared.refused == []
    assert [log.simulation for log in compared.logs] == [f"{log.size} {log.stamp}" for log in found]
    assert [where for where, _ in refused] == [f"{root}/latest.mcap"]
    assert alone.name == "other.mcap"
    assert alone.stamp  # of the last change: a log of the same size is another one


class _PartlySilent(_WebServer):
    def do_GET(self) -> None:
        """Answer, but for a folder reset the connection, or say that it is not there."""
        if self.path.rstrip("/").endswith("/reset"):
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.close_connection = True
        elif self.path.rstrip("/").endswith("/missing"):
            self.send_error(404)
        else:
            super().do_GET()


@pytest.mark.parametrize("pattern", ["", "/**/*.mcap", "/*/*.mcap"])
def test_a_folder_for_which_a_web_server_does_not_answer_is_no_empty_one(tmp_path: Path, pattern: str) -> None:
    tree(tmp_path, "robots/a/log.mcap", "robots/missing/log.mcap", "robots/reset/log.mcap")
    with _web(tmp_path, _PartlySilent) as server:
        found, refused = find(f"{server}/robots{pattern}", NOWHERE)
    assert [log.name for log in found] == ["a/log.mcap"]
    assert [where for where, _ in refused] == [f"{server}/robots/missing", f"{server}/robots/reset"]


def test_a_web_server_that_is_away_is_named() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        root = f"http://127.0.0.1:{free.getsockname()[1]}/robots"
    found, ((where, why),) = find(root, NOWHERE)
    assert (found, where) == ([], root)
    assert "Connect" in why
