"""Numbers of one topic over a log, collected message by message."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import LogError, did_you_mean
from imutool.mcap_io.codec.messages import Rows
from imutool.mcap_io.fields.decoders import decoder_of
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import UNIT_KEY, StampCheck, Topic, topics_of

LISTED = 60  # fields named in a message


@dataclass(frozen=True, eq=False)
class Fields:
    """One number of a log over time, at the stamps of the headers or else at log times."""

    t_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, " n"]
    unit: str = ""
    left_out: int = 0  # rows without a number, or with the stamp of the row before

    def __len__(self) -> int:
        return len(self.t_ns)


class PlainLog(Log):
    """Log whose messages all come as recorded, also IMUs and poses in types of their own."""

    def _read_topics(self) -> None:
        self.topics = MappingProxyType(topics_of(self.index))


@dataclass(eq=False)
class Reader:
    """Collects some fields of one topic; without `strict`, missing fields become NaN."""

    log: Log
    topic: Topic
    paths: tuple[str, ...]
    strict: bool = True
    log_times: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    stamps: list[Int64[np.ndarray, " n"]] = field(default_factory=list)  # of headers; zero without one
    values: list[Float64[np.ndarray, "n k"]] = field(default_factory=list)
    sequences: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.decoder = decoder_of(self.log, self.topic)

    def take(self, rows: Rows) -> None:
        """Takes in the next messages, all of one size."""
        for found in self.decoder.columns(rows.payload, self.paths):
            if found.lacks is not None and self.strict:
                path, row = found.lacks
                raise self._unknown(path, rows.payload[row].tobytes())
            self.log_times.append(rows.log_time[found.rows])
            self.stamps.append(found.stamps)
            self.values.append(found.values)
            self.sequences.append(rows.sequence[found.rows])

    def _unknown(self, path: str, raw: bytes) -> LogError:
        known = self.decoder.paths(raw, long=True)
        return LogError(
            f"there is no number {path} in {self.topic.schema_name or 'a message'}",
            expected=listed(known),
            fix=did_you_mean(path, known, f"{self.topic.name}.{{}}"),
        )

    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """Header stamps; log times where there is no header or all stamps are zero."""
        stamp_ns, log_ns = (np.concatenate([np.zeros(0, np.int64), *parts]) for parts in (self.stamps, self.log_times))
        return stamp_ns if stamp_ns.any() else log_ns

    def whole(self, path: str) -> Fields:
        """A field over the whole log.

        Raises:
            LogError: no messages, NaN or infinity, stamps that do not increase.
        """
        if not self.log_times:
            raise LogError("there are no messages", expected="at least one")
        t_ns, sequence = self.t_ns(), np.concatenate(self.sequences)
        values = np.concatenate(self.values)[:, self.paths.index(path)]
        if not (finite := np.isfinite(values)).all():
            row = int(np.argmin(finite))
            raise LogError(
                f"message {row} (sequence {sequence[row]}) has {path} = {values[row]}",
                expected="finite numbers",
                fix="Choose another field, or cut the log before or after it",
            )
        StampCheck().check(t_ns, sequence)
        return Fields(t_ns, values, self.topic.metadata.get(UNIT_KEY, ""))

    def usable(self, path: str, gaps: bool = False) -> Fields | None:
        """A field over the whole log if it varies and can be a channel."""
        if not self.log_times:
            return None
        t_ns, values = self.t_ns(), np.concatenate(self.values)[:, self.paths.index(path)]
        sound = np.isfinite(values) & (np.diff(t_ns, prepend=t_ns[0] - 1) != 0)
        t_ns, values = t_ns[sound], values[sound]
        if not (gaps or (sound.all() and (np.diff(t_ns) > 0).all())) or len(values) < 2 or np.ptp(values) == 0.0:
            return None
        return Fields(t_ns, values, self.topic.metadata.get(UNIT_KEY, ""), int((~sound).sum()))


def listed(names: Collection[str]) -> str:
    """Names for a message, the first `LISTED`."""
    shown = list(names)[:LISTED]
    return ", ".join(shown) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "") if shown else "no number"
