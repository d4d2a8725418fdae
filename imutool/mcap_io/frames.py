"""Images of a log, which stay in it until somebody reads them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial

from imutool.errors import LogError
from imutool.file_location import Location
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_image
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import ENCODINGS
from imutool.recording import Frames

logger = logging.getLogger(__name__)


def read_frames(log: Log, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, Frames]:
    """Image topics, opened again when somebody reads them; none whose first message is no image."""
    found, first, last = {}, start_ns or 0, 2**63 - 1 if end_ns is None else end_ns
    for topic in (t.name for t in log.with_schema((schemas.IMAGE,)) if t.message_encoding in ENCODINGS):
        if (form := _format(log, topic)) is not None:
            count = sum(int(((t >= first) & (t <= last)).sum()) for t in log.stamps(topic))
            found[topic] = Frames(form, count, partial(_images, log.path, topic, start_ns, end_ns))
    return found


def _format(log: Log, topic: str) -> str | None:
    """Image format, from the first image; None where it is no image."""
    payload = dict(log.firsts([topic])).get(topic)
    try:
        return "" if payload is None else decode_image(payload, log.topics[topic].message_encoding)[1]
    except LogError as error:
        logger.warning("%s %s is left out: %s", log.path, topic, error.what)
        return None


def _images(path: Location, topic: str, start_ns: int | None, end_ns: int | None) -> Iterator[tuple[int, bytes]]:
    with Log(path) as log:
        encoding = log.topic(topic, (schemas.IMAGE,)).message_encoding
        for _, rows in log.rows([topic], start_ns, end_ns):
            with log.named(topic):
                yield from (decode_image(payload.tobytes(), encoding)[::2] for payload in rows.payload)
