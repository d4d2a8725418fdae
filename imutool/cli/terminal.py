"""Terminal output: tables, JSON, lines and a progress bar; stdout holds only results."""

from __future__ import annotations

import logging
import math
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from typing import TYPE_CHECKING, Any

from rich.console import Console

from imutool.cli.parameters import with_flags
from imutool.errors import ConfigError, ImutoolError, redact
from imutool.file_location import to_location
from imutool.mcap_io.recovery.losses import describe
from imutool.mcap_io.storage.target import Target
from imutool.report import NamedProgress, Report, json_text, silent

if TYPE_CHECKING:
    from imutool.training.fit import Epoch

LONGEST_LINE, LONGEST = 2000, 20_000  # letters of an error message: one with a map to complete has many lines
LONGEST_ROW = 10_000  # letters of a table's row where nobody looks at a terminal
NUMBER = re.compile(r"[-+]?[0-9.]+|[–?]")
LINE_EVERY_S = 60.0
MISSING = "–"  # in the place of a figure
STDOUT = "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"

logger = logging.getLogger("imutool")


class _Console(Console):
    """Console that raises BrokenPipeError; Rich's own would exit with the code of a bug."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


_width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else LONGEST_ROW  # without a terminal no line is folded
out, err = _Console(width=_width, emoji=False), _Console(stderr=True, emoji=False)


def plain(text: str) -> str:
    """Text without markup and without control characters, for a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text).replace("[", r"\[")


def say(line: str, word: str = "", color: str = "yellow", *, to: Console = out) -> None:
    """Print a line of results, behind a coloured word if one is given; never folded."""
    marked = f"[{color}]{word}:[/] " if word else ""
    to.print(f"{marked}{plain(line)}", highlight=False, soft_wrap=True)


def stdout_for_one(outputs: Mapping[str, Any]) -> AbstractContextManager[Any]:
    """Lines of results on stderr while an output is written to stdout, by its name as a device.

    Raises:
        ConfigError: two outputs go there.
    """
    named = [name for name, place in outputs.items() if str(place) in STDOUT or (name, place) == ("json_to", "-")]
    if len(named) > 1:
        what = f"`{named[0]}` and `{named[1]}` both go to stdout"
        raise ConfigError(what, where=outputs[named[0]], fix="Give one of them a file")
    return redirect_stdout(sys.stderr) if named and outputs[named[0]] != "-" else nullcontext()


def tell_error(message: str) -> None:
    """Print a line that begins with "error:" on stderr, and cut very long lines."""
    message = "\n".join(_cut(line, LONGEST_LINE) for line in message.split("\n"))
    say(redact(_cut(message, LONGEST)), "error", "bold red", to=err)


def tell_end(how: str, end: BaseException) -> None:
    """Print how a command ended too early; notes of the exception say how to go on."""
    is_second = end.__cause__ is None and isinstance(end.__context__, KeyboardInterrupt | SystemExit)  # ended the clean-up
    left = "A file of the name *.partial may be left; the next command with this output removes it"
    notes = with_flags(" ".join(getattr(end, "__notes__", ())))
    tell_error(f"{how}. {left if is_second else notes or 'Nothing half-written is left'}.")


def _cut(text: str, longest: int) -> str:
    """Text without its middle, if it is longer."""
    return text if len(text) <= longest else f"{text[: longest // 2]} … {text[-longest // 2 :]}"


def tell_warning(message: str, word: str = "warning") -> None:
    """Print a line that begins with "warning:" or another word on stderr."""
    say(message, word, to=err)


def tell_losses(losses: Mapping[str, Any]) -> None:
    """Print a log's losses (`mcap_io.recovery.losses.Losses.plain`), one line a stretch."""
    for line in describe(losses):
        kind, _, rest = with_flags(line).partition(": ")
        say(rest, kind)


def table(rows: Sequence[Sequence[str]], *, keys: int) -> None:
    """Print rows of text as a table, the first row as its header.

    Columns that do not fit go below, with the first `keys` columns repeated.
    """
    columns = [[plain(cell) for cell in column] for column in zip(*rows, strict=True)]
    widths = [2 + max(len(line) for cell in column for line in cell.split("\n")) for column in columns]
    room = out.width - sum(widths[:keys])
    fewest = len(_split(widths[keys:], room))
    even = next(w for w in range(room + 1) if len(_split(widths[keys:], w)) == fewest) if room > 0 else 0
    first = keys
    for count in _split(widths[keys:], even):
        chosen = [*range(keys), *range(first, first + count)]
        _print([columns[i] for i in chosen], sum(widths[i] for i in chosen))
        first += count


def _split(widths: Sequence[int], room: int) -> list[int]:
    """Numbers of columns side by side, at least one each."""
    counts, used = [0], 0
    for width in widths:
        if counts[-1] and used + width > room:
            counts.append(0)
            used = 0
        counts[-1] += 1
        used += width
    return counts


def _print(columns: Sequence[Sequence[str]], width: int) -> None:
    from rich import box
    from rich.table import Table

    grid = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    folds = out.is_terminal and width > out.width
    tall = folds or any(
        "\n" in cell for _, *cells in columns for cell in cells
    )  # what a row begins with stands in its first line
    for header, *cells in columns:
        numbers = all(NUMBER.fullmatch(cell) for cell in cells)
        grid.add_column(header, overflow="fold", justify="right" if numbers else "left", vertical="top" if tall else "bottom")
    for row in zip(*(column[1:] for column in columns), strict=True):
        grid.add_row(*row)
    # a terminal folds what does not fit; where nobody looks at a terminal, nothing may be folded
    console = out if out.is_terminal else _Console(width=max(width, out.width))
    console.print(grid)
    console.print()


def write_json(report: Report | Mapping[str, Any], where: str | None, *, overwrite: bool = False) -> bool:
    """Write the report where `--json` says; True if stdout holds it.

    Raises:
        ConfigError: the file exists (without `overwrite`), or cannot be written.
    """
    if where is None:
        return False
    text = json_text(report)
    if where == "-":
        sys.stdout.flush()
        sys.stdout.buffer.write(text.encode())  # JSON is UTF-8, whatever the terminal is
        return True
    with Target(to_location(where), overwrite=overwrite) as target:
        target.write(text.encode())
    return False


@contextmanager
def kept_for_end(errors: list[ImutoolError]) -> Iterator[None]:
    """Keep the error of one log for `raise_kept`, not that of a wrong command line."""
    try:
        yield
    except ConfigError:
        raise
    except ImutoolError as error:
        errors.append(error)


def raise_kept(errors: Sequence[ImutoolError]) -> None:
    """Raise the first error, if there is one, and print the others as warnings."""
    for error in errors[1:]:
        logger.warning("%s", error)
    if errors:
        raise errors[0]


class _Lines(logging.Handler):
    """Handler that prints log records on stderr, a warning once; what logs in a row have alike in one line more."""

    def __init__(self) -> None:
        super().__init__()
        self._level, self._text, self._logs = "", "", list[str]()
        self._warnings = set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        message, level = record.getMessage(), record.levelname.lower()
        if record.levelno >= logging.WARNING:
            if message in self._warnings:  # a command may read a log twice
                return
            self._warnings.add(message)
        log, colon, text = message.partition(": ")
        if colon and (level, text) == (self._level, self._text):
            self._logs.append(log)
            return
        self.flush()
        self._level, self._text, self._logs = level, text, [log]
        say(with_flags(f"{level}: {message}"), to=err)

    def flush(self) -> None:
        """Name the other logs of the last text."""
        if others := self._logs[1:]:
            more = len(others) - 1
            say(f"{self._level}: {others[0]}{f' and {more} other' if more else ''}{'s' * (more > 1)}: the same", to=err)
        self._level, self._text, self._logs = "", "", []


def log_to_stderr(verbose: bool, quiet: bool) -> None:
    """Send log records to stderr: warnings, with `verbose` more, with `quiet` errors only."""
    logging.basicConfig(level=logging.ERROR if quiet else logging.WARNING, handlers=[_Lines()], force=True)
    logger.setLevel(logging.INFO if verbose else logging.NOTSET)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of a cache where there is no home


@contextmanager
def progress(what: str, verbose: bool, quiet: bool) -> Iterator[NamedProgress]:
    """Progress bar on stderr; the callback takes steps done, steps in all, and a word.

    With --verbose the words stay as lines. Where stderr is no terminal, as in a cluster's log, a line comes each minute.
    """
    log_to_stderr(verbose, quiet)
    if quiet:
        yield silent
        return
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=16), TextColumn("{task.percentage:>3.0f} %"))
    shown = err.is_terminal or err.is_jupyter  # elsewhere the library would print an empty line
    room = max(err.width - len(what) - 26, 8)  # a longer word would take it from the bar
    with Progress(*columns, TextColumn("{task.fields[word]}"), console=err, transient=True, disable=not shown) as bar:
        task = bar.add_task(what, total=None, word="")

        before, told_s = "", time.monotonic()

        def tell(done: int, total: int, word: str) -> None:
            nonlocal before, told_s
            short = plain(word) if len(word) <= room else f"{plain(word)[: room - 1]}…"
            bar.update(task, completed=done, total=total, word=short)
            if word not in ("", before):
                logger.info("%s %s", what, word)
            before = word or before
            if not (shown or verbose) and time.monotonic() - told_s >= LINE_EVERY_S:
                told_s = time.monotonic()
                say(f"{what}: {100.0 * done / max(total, 1):.0f} %{f', {word}' if word else ''}", to=err)

        try:
            yield tell
        finally:
            for handler in logging.getLogger().handlers:
                handler.flush()


def epoch_line(epoch: Epoch) -> tuple[int, int, str]:
    """Progress of training: steps done, steps in all, and the scores as text."""
    if epoch.note:
        return 0, 1, epoch.note
    scale, unit = (180.0 / math.pi, "°") if epoch.sensor == "gyro" else (1.0, " m/s")
    held_out, before = epoch.held_out * scale, epoch.before * scale
    minutes, seconds = divmod(round(epoch.left_s), 60)
    loss = "" if math.isnan(epoch.loss) else f"loss {epoch.loss:.3f}, "  # before the first step there is none
    text = f"{epoch.sensor} {epoch.step}/{epoch.steps}: {loss}held out {held_out:.3f}{unit} (closed form {before:.3f})"
    return epoch.step, max(epoch.steps, 1), f"{text}, {minutes}:{seconds:02d} left" if epoch.step else text


def figures(results: Sequence[dict[str, Any]], *, aligned: bool = False) -> None:
    """Print evaluation results as tables: of the whole path, of windows, and by distances.

    With `aligned` also the attitude after an alignment of the positions.
    """
    window = f"{results[0]['drift_window_s']:g} s"
    whole = {"AOE\n°": "aoe_deg", "aligned\n°": "aoe_aligned_deg", "APE\nm": "ape_m", "aligned\nm": "ape_aligned_m"}
    whole["velocity\nm/s"] = "velocity_rmse_m_s"
    drift = {f"{window}\n°": "drift_orientation_deg", "expected\n°": "drift_orientation_std_deg"}
    drift |= {f"{window}\nm/s": "drift_velocity_m_s", "expected\nm/s": "drift_velocity_std_m_s"}
    without_aids = [each for each in results if each.get("estimate") != "aided"]  # as the windows are
    named = [(results, {title: name for title, name in whole.items() if aligned or name != "aoe_aligned_deg"})]
    named.append((without_aids, drift))
    shown = [
        (scores, [(title, [each.get(name) for each in scores]) for title, name in cells.items()]) for scores, cells in named
    ]
    for title, by in (("ROE °", "roe_deg"), ("RPE m", "rpe_m")):
        shown.append((results, [(f"{title}\n{metres} m", [each[by][metres] for each in results]) for metres in results[0][by]]))
    for scores, columns in shown:
        if any(value is not None for _, values in columns for value in values):  # a path without positions has no distances
            values = zip(*([MISSING if x is None else f"{x:.2f}" for x in column] for _, column in columns), strict=True)
            rows = [(each["log"], each["model"], *row) for each, row in zip(scores, values, strict=True)]
            table([("log", "model", *(title for title, _ in columns)), *rows], keys=2)
