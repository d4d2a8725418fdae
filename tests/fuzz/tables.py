"""Tables of samples and poses: numbers, stamps, lines and letters that no data set would write."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

from fuzz import command, outside_contract
from fuzz._inputs import damaged, finite_log, listing, only_below, put, sequence


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Converts a sequence with damaged tables: a finite log, or an error with file and line."""
    files = sequence(rng)
    for name in rng.sample(sorted(files), rng.choice((1, 1, 2))):
        files[name] = damaged(rng, files[name])
    put(folder / "seq", files)
    with only_below(folder, "out.mcap") as wrong:
        done = command(folder, "convert", "seq", "out.mcap", "-q")
    yield from wrong
    yield from outside_contract(done, (0, 3, 4))
    log = folder / "out.mcap"
    if done.returncode == 0 and log.exists():
        if not any(word in b"".join(files.values()).lower() for word in (b"nan", b"inf", b"1e309", b"1e99999", b"9" * 400)):
            yield from finite_log(log)
        yield from outside_contract(command(folder, "info", "out.mcap", "--json", "-"), (0, 3))
    elif log.exists() and "warning: out.mcap: " not in done.stderr:
        yield f"exit code {done.returncode}, a log, and no word of a loss: {done.stderr!r}"
    if "error:" not in done.stderr and done.returncode not in (0, 3):
        yield f"no message: {done.stderr!r}"
    if len(done.stderr) > 4000:
        yield f"a message of {len(done.stderr)} letters"
    if any(not letter.isprintable() and letter != "\n" for letter in done.stderr):
        yield f"control characters in a message: {done.stderr!r}"
    assert listing(folder), "the source is there"
