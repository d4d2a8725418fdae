"""Locations of logs: a file on this machine, or an object in a store by its URL.

A store is read and written through fsspec, which is imported only when a URL is given. What opens it comes from the store's
own usual chain (environment, profile, instance role; its endpoint from AWS_ENDPOINT_URL) and never from the URL, because a
URL is written into reports, metadata and journals.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, ForwardRef, NamedTuple, TypeAlias
from urllib.parse import unquote, urlsplit

from imutool.errors import ConfigError, redact

if TYPE_CHECKING:
    from upath import UPath

    Location: TypeAlias = Path | UPath
else:
    Location = Path | ForwardRef("upath.UPath")  # beartype looks the name up, and imports upath, at the first URL it meets

LogPath: TypeAlias = str | Location
QUERY = re.compile(r"[?#][\w.-]+=[^/]*$")  # in other places ? is a wildcard, and # a letter of a key
CLOUD = "pip install 'imutool[cloud]'"
STORES = {
    "s3": CLOUD,
    "gs": f"{CLOUD} gcsfs",
    "az": f"{CLOUD} adlfs",
    "abfs": f"{CLOUD} adlfs",
    "http": CLOUD,
    "https": CLOUD,
    "memory": CLOUD,
}
WEB = "http://", "https://"  # URLs whose names are percent-encoded; those of stores are not
ACCOUNTS = ("az", "abfs")  # their URLs say CONTAINER@ACCOUNT, which is not secret
BLOCK_BYTES = 4 << 20
COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"\x04\x22\x4d\x18": "lz4"}
# A scan, the message indexes behind its chunk and the summary each have their block: 7 requests where 6 are the fewest, and
# the library's own reading ahead made 13 (tests/bench/store.py)
CACHE, CACHE_OPTIONS = "blockcache", {"maxblocks": 4}


def first_bytes(path: Location, count: int) -> bytes:
    """First bytes of a file; none of one that cannot be read."""
    try:
        with path.open("rb") as file:
            raw: bytes = file.read(count)
            return raw
    except OSError:
        return b""


class OpenFile(NamedTuple):
    """An open file or object, its size, and its `identity` when it was opened."""

    file: BinaryIO
    size: int
    identity: tuple[int, str]


def to_location(text: str) -> Location:
    """File or object that a user names.

    Raises:
        ConfigError: an unknown kind of store, one whose package is not installed, a URL with a password or signature in it, or
            `-`, which is elsewhere a stream.
    """
    if text == "-":
        what = "is a stream: a log is read by its indexes, and what is written is complete before it gets its name"
        raise ConfigError(what, where="-", expected="a file or a URL", fix="Name a file; one called - is ./-")
    scheme, colon, rest = text.partition("://")
    if not colon:
        return Path(text)
    if scheme == "file":
        return Path(unquote(re.sub("^localhost(?=/)", "", rest)))  # as `Path.as_uri` quotes (RFC 8089)
    if scheme not in STORES:
        raise ConfigError("unknown kind of store", where=redact(text), expected=", ".join(f"{name}://" for name in STORES))
    _refuse_secrets(scheme, text)
    try:
        from upath import UPath

        place = UPath(text, use_listings_cache=False)  # a cached listing would hide what others write
        place.fs  # noqa: B018  imports the store's package
    except ImportError as error:
        raise ConfigError(
            f"needs a package that is not installed ({error})", where=text, fix=f"Install it with: {STORES[scheme]}"
        ) from error
    except Exception as error:  # any error of the store's set-up
        raise ConfigError(f"cannot be opened ({reason(error)})", where=text) from error
    return place


def location(path: object) -> Location:
    """File or object of a path or URL.

    Raises:
        ConfigError: no path, an unknown store, a missing package for it, or a password in the URL.
    """
    if isinstance(path, str):
        return to_location(path)
    if isinstance(path, Path) or hasattr(type(path), "fs"):  # a URL's path; its package stays unimported
        return path  # type: ignore[return-value]
    what = f"an argument is of type {type(path).__name__}"
    raise ConfigError(what, expected="a path or a URL", fix="`imutool.write` makes a log of arrays")


def absolute(path: Path) -> Path:
    """Absolute path without `..`, the same from every folder; a link keeps its name."""
    if ".." not in path.parts:
        return path.absolute()
    return path.resolve() if path.name == ".." else path.parent.resolve() / path.name


def log_name(where: Location) -> str:
    """Name of a log: that of its file without the suffix."""
    return unquote(where.stem) if str(where).startswith(WEB) else where.stem


def local(path: object, parameter: str) -> Path:
    """File on this machine.

    Raises:
        ConfigError: `path` is a URL, or no path.
    """
    place = location(path)
    if not isinstance(place, Path):
        raise ConfigError(f"{path} is in an object store", where=parameter, expected="a file on this machine")
    return place


def several(given: Any) -> list[Any]:
    """Items of a list or another iterable; a text, a path or any other value is one item."""
    return [given] if isinstance(given, str) or not isinstance(given, Iterable) else list(given)


def _refuse_secrets(scheme: str, text: str) -> None:
    login, at, _ = urlsplit(text).netloc.rpartition("@")
    if at and (scheme not in ACCOUNTS or ":" in login):
        raise ConfigError(
            "a user name or password stands in the URL",
            where=redact(text),
            expected="none: URLs are written into reports and logs",
            fix="Give it by the store's environment variables or profile",
        )
    if QUERY.search(text) or (scheme.startswith("http") and (urlsplit(text).query or urlsplit(text).fragment)):
        raise ConfigError(
            "a query stands in the URL, which may be a signature",
            where=re.split("[?#]", text)[0],
            expected="none: URLs are written into reports and logs",
            fix="Give the object by its store's own URL, such as s3://, or fetch it first",
        )


def io_errors(where: Location) -> type[Exception]:
    """Exception class of reading and writing a location: OSError, or any of a store."""
    return OSError if isinstance(where, Path) else Exception


def reason(error: Exception) -> str:
    """The system's or store's reason of an error, without secrets."""
    if isinstance(error, OSError) and error.strerror:
        return redact(error.strerror)
    if isinstance(error, FileNotFoundError):
        cause = error.__cause__  # fsspec says that of a web server which is away or refuses, too
        is_away = isinstance(cause, OSError) or getattr(cause, "status", 404) != 404
        return reason(cause) if isinstance(cause, Exception) and is_away else "no such object, or no such bucket"
    if isinstance(error, NotImplementedError):
        return "files of this kind of URL can only be read"
    if isinstance(error, PermissionError):
        return redact(f"the store refuses access: {error}")
    if "range requests" in str(error):  # what else the library says is for programs
        return "the server sends files as a whole and no part of one: fetch it first"
    return redact(str(error)) or type(error).__name__


def open_location(where: Location) -> OpenFile:
    """Opens a file or object for reading; a store is read by blocks, of which a few are kept.

    Raises:
        The classes that `io_errors` names.
    """
    if isinstance(where, Path):
        if "\0" in str(where):
            raise OSError(errno.EINVAL, "no name of a file holds a zero byte", str(where))
        if where.exists() and not where.is_file() and not where.is_dir():
            raise OSError(errno.EINVAL, "it is a pipe, a socket or a device, not a file", str(where))  # opening it might wait
        file = where.open("rb", buffering=0)
        status = os.fstat(file.fileno())
        return OpenFile(file, status.st_size, (status.st_size, str(status.st_mtime_ns)))
    remote = where.fs.open(where.path, "rb", block_size=BLOCK_BYTES, cache_type=CACHE, cache_options=dict(CACHE_OPTIONS))
    if remote.size is None:
        raise OSError("the server does not say how long it is, so no part of it can be asked for")
    details = getattr(remote, "details", None)  # as opening it has learnt them, without another request: of http only the size
    found = size_and_etag(details) if isinstance(details, dict) else (0, "")
    return OpenFile(remote, remote.size, found if found[1] else size_and_etag(where.fs.info(where.path)))


def compression(start: bytes) -> str:
    """Name of the program that compressed a file that begins like this; empty for any other."""
    return next((name for magic, name in COMPRESSED.items() if start.startswith(magic)), "")


def same_location(a: Location, b: Location) -> bool:
    """Whether two locations are one existing file or object; a link to a file is that file."""
    if isinstance(a, Path) and isinstance(b, Path):
        return a.exists() and b.exists() and a.samefile(b)
    return a == b


def refuse_twins(logs: Sequence[Location], parameter: str) -> None:
    """Refuse a log that is given twice, also through a link: it would count as two.

    Raises:
        ConfigError: with both names.
    """
    seen: dict[object, Location] = {}
    for log in logs:
        try:
            file = log.stat() if isinstance(log, Path) else None
        except (OSError, ValueError):  # whoever reads it says so
            continue
        key = str(log) if file is None else (file.st_dev, file.st_ino)
        if (first := seen.get(key)) is not None:
            what = f"{first} and {log} are one log" if first != log else f"{log} is given twice"
            raise ConfigError(what, where=parameter, expected="each log once")
        seen[key] = log


def identity(where: Location) -> tuple[int, str]:
    """Size, and the etag of a store or the time of the last change.

    Raises:
        ConfigError: it cannot be asked for.
    """
    with _asked(where):
        if isinstance(where, Path):
            status = where.stat()
            return status.st_size, str(status.st_mtime_ns)
        return size_and_etag(where.fs.info(where.path))


def exists(where: Location) -> bool:
    """Whether a file, folder or object is there.

    Raises:
        ConfigError: it cannot be asked for: no permission, no credentials, or no answer of the store.
    """
    with _asked(where):
        return where.exists()


def is_folder(where: Location) -> bool:
    """Whether a folder is there.

    Raises:
        ConfigError: it cannot be asked for.
    """
    with _asked(where):
        return where.is_dir()


def is_file(where: Location) -> bool:
    """Whether a file or object is there.

    Raises:
        ConfigError: it cannot be asked for.
    """
    with _asked(where):
        return where.is_file()


@contextmanager
def _asked(where: Location) -> Iterator[None]:
    try:
        yield
    except io_errors(where) as error:
        fix = "See who may read it" if isinstance(where, Path) else "Check the address, and your access to the store"
        fix = "" if isinstance(error, FileNotFoundError) else fix
        raise ConfigError(f"cannot be read ({reason(error)})", where=where, fix=fix) from error


def size_and_etag(about: Mapping[str, Any]) -> tuple[int, str]:
    """Size and etag from a store's description, whatever names it uses."""
    names = ("ETag", "etag", "md5Hash", "content_md5", "LastModified", "last_modified", "Last-Modified", "mtime", "created")
    stamp = next((str(about[name]) for name in names if about.get(name)), "")
    return int(about["size"]), stamp.strip('"')
