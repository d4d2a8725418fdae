"""The three timelines of everything that is logged, exact to the nanosecond."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imutool.recording import Times
from imutool.viewing.model.run_data import RunData

if TYPE_CHECKING:
    import rerun as rr

# The last two are what Rerun's own MCAP reader calls header stamps and log times, so that the source log's topics line up.
ELAPSED, STAMP, LOG_TIME = TIMELINES = ("elapsed", "ros2_timestamp", "message_log_time")


def columns(stamp_ns: Times, log_ns: Times, start_ns: int) -> list[rr.TimeColumn]:
    """Time since the first IMU sample, header stamp, and when the log says that it was written."""
    import rerun as rr

    return [
        rr.TimeColumn(ELAPSED, duration=(stamp_ns - start_ns).astype("timedelta64[ns]")),
        rr.TimeColumn(STAMP, timestamp=stamp_ns.astype("datetime64[ns]")),
        rr.TimeColumn(LOG_TIME, timestamp=log_ns.astype("datetime64[ns]")),
    ]


def at(data: RunData, stamp_ns: Times) -> list[rr.TimeColumn]:
    """The columns of stamps of one log."""
    return columns(stamp_ns, data.log_ns(stamp_ns), data.start_ns)
