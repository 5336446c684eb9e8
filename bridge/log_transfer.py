"""LogServer: the vehicle's side of MAVLink's log protocol, as PX4 speaks it.

- LOG_REQUEST_LIST is answered by one LOG_ENTRY for each log of the range, and by silence if there is none.
- LOG_REQUEST_DATA needs a list first. It is answered by LOG_DATA of 90 bytes each until the bytes asked for are
  covered, so the last one may carry more than was asked; only the end of the file makes one shorter. An offset beyond
  the end or an unknown log is silence, and ends what was being sent.
- A log that grows is served up to the size it had in the list.
- Data is paced, and a whole log asked for at once comes more slowly than pieces that a client waits for. A PX4 sends as
  fast as its line takes it, which overflows the socket of MAVProxy, and of the twenty pieces MAVProxy then asks for
  together PX4 sends the last.
- LOG_ERASE deletes all logs but the one being written. LOG_REQUEST_END stops.

Source: PX4 src/modules/mavlink/mavlink_log_handler.cpp and answers recorded from a PX4 SITL of May 2026.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeAlias

from bridge.log_store import StoredLog, find_logs, remove_log
from bridge.messages import Message

Outgoing: TypeAlias = tuple[str, dict[str, Any]]

DATA_BYTES: Final = 90
PERIOD_US: Final = 4_000
"""Least time between two bursts on one link, us."""

WINDOW_BYTES: Final = 512 * DATA_BYTES
"""Most that a client asks for at once that then waits for it: QGroundControl and MAVSDK."""
PACED_BURST: Final = 5
"""Most messages in a burst of more than that: MAVProxy on a busy computer reads 1250 in a second, and not 2000."""

LIST_TO_END: Final = 0xFFFF
_UINT32_MAX = 0xFFFFFFFF
_OPEN_FLAGS: Final = (
    os.O_RDONLY
    | getattr(os, "O_NOFOLLOW", 0)
    | getattr(os, "O_NONBLOCK", 0)  # should a FIFO have taken its place
    | getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_BINARY", 0)
)
_RESCAN_US = 100_000


class _LinkState:
    """What one link is told and still owed."""

    __slots__ = (
        "burst", "due_us", "end", "file", "last", "log_id", "logs", "next_entry", "offset", "pace", "size", "top"
    )  # fmt: skip

    def __init__(self, burst: int) -> None:
        self.burst = burst
        self.due_us = 0
        self.logs: list[StoredLog] | None = None  # the list it was given
        self.next_entry: int | None = None  # of the list being sent
        self.last = 0  # entry of the list being sent
        self.top = 0  # last_log_num in its entries
        self.file: int | None = None  # descriptor of the log `log_id`
        self.log_id = -1
        self.size = 0
        self.offset: int | None = None  # of the next LOG_DATA
        self.end = 0
        self.pace = burst  # of the data being sent

    def stop(self) -> None:
        """Send nothing more."""
        self.next_entry = self.offset = None

    def close(self) -> None:
        """Let go of the file."""
        if self.file is not None:
            os.close(self.file)
        self.file, self.log_id = None, -1


class LogServer:
    """Serves the logs below one directory to any number of links.

    Args:
        directory: where the logs are; need not exist yet.
        system_id: own system; requests to it or to system 0 are answered, whatever the component, as PX4 does, but a
            deletion must name this component or 0.
        component_id: own component.
        writing: the log being written, None if there is none; it is listed, and never deleted.

    Attributes:
        refused: requests for what there is not.
        erased: logs deleted so far.
    """

    HANDLES: Final = ("LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_ERASE", "LOG_REQUEST_END")

    def __init__(
        self,
        directory: Path,
        *,
        system_id: int = 1,
        component_id: int = 1,
        writing: Callable[[], Path | None] = lambda: None,
    ) -> None:
        self.directory = Path(directory)
        self.system_id = system_id
        self.component_id = component_id
        self.refused = 0
        self.erased = 0
        self._writing = writing
        self._links: dict[int, _LinkState] = {}
        self._scanned: list[StoredLog] = []
        self._scan_us: int | None = None

    def add_link(self, link_id: int, *, burst: int = 20) -> None:
        """Make a link known; `handle` does it by itself. burst: most messages in 4 ms, fewer on a slow line."""
        self.forget(link_id)
        self._links[link_id] = _LinkState(burst)

    def forget(self, link_id: int) -> None:
        """The link's peer is gone, and what it was owed with it."""
        link = self._links.pop(link_id, None)
        if link is not None:
            link.close()

    def handle(self, msg: Message, link_id: int, now_us: int) -> list[Outgoing]:
        """Take one message; the answers come from `poll`.

        Args:
            msg: the message. link_id: link it came from. now_us: vehicle time, us.
        """
        if msg.name not in self.HANDLES or msg.target_system not in (self.system_id, 0):
            return []
        if link_id not in self._links:
            self.add_link(link_id)
        link = self._links[link_id]
        if msg.name == "LOG_REQUEST_LIST":
            self._list(msg, link, now_us)
        elif msg.name == "LOG_REQUEST_DATA":
            self._data(msg, link)
        elif msg.name == "LOG_REQUEST_END":
            link.stop()
            link.close()
        elif msg.target_component in (self.component_id, 0):
            self._erase()
        return []

    def poll(self, link_id: int, now_us: int) -> list[Outgoing]:
        """Messages due now on a link: the next entries of a list or the next bytes of a log.

        Args:
            link_id: the link. now_us: vehicle time, us.
        """
        link = self._links.get(link_id)
        if link is None or (link.next_entry is None and link.offset is None) or now_us < link.due_us:
            return []
        link.due_us = now_us + PERIOD_US
        return self._entries(link) if link.next_entry is not None else self._bytes(link)

    def _list(self, msg: Message, link: _LinkState, now_us: int) -> None:
        # a peer that asks without end must not make us read the disk without end
        if self._scan_us is None or not 0 <= now_us - self._scan_us < _RESCAN_US:
            self._scanned, self._scan_us = find_logs(self.directory), now_us
        link.stop()
        link.close()
        link.logs = self._scanned
        count = len(link.logs)
        if msg.start >= count or msg.end < msg.start:
            self.refused += bool(count)
            return
        link.next_entry = msg.start
        link.last = min(msg.end, count - 1)
        link.top = count if msg.end == LIST_TO_END else msg.end

    def _entries(self, link: _LinkState) -> list[Outgoing]:
        logs, first = link.logs or [], link.next_entry or 0
        stop = min(first + link.burst, link.last + 1)
        link.next_entry = stop if stop <= link.last else None
        return [
            (
                "LOG_ENTRY",
                {
                    "id": number,
                    "num_logs": len(logs),
                    "last_log_num": link.top,
                    "time_utc": min(logs[number].utc_s, _UINT32_MAX),
                    "size": min(logs[number].size, _UINT32_MAX),
                },
            )
            for number in range(first, stop)
        ]

    def _data(self, msg: Message, link: _LinkState) -> None:
        number, offset = msg["id"], msg.ofs
        link.stop()
        if link.logs is None or number >= len(link.logs):
            self.refused += 1
            return
        if number != link.log_id:
            link.close()
            log = link.logs[number]
            try:
                link.file = os.open(log.path, _OPEN_FLAGS)
            except OSError:
                self.refused += 1  # deleted meanwhile
                return
            link.log_id, link.size = number, min(log.size, _UINT32_MAX)
        if offset >= link.size + DATA_BYTES:
            self.refused += 1
            return
        link.offset = offset
        link.end = min(offset + msg["count"], link.size)
        link.pace = link.burst if link.end - offset <= WINDOW_BYTES else min(link.burst, PACED_BURST)

    def _bytes(self, link: _LinkState) -> list[Outgoing]:
        offset, file = link.offset, link.file
        if offset is None or file is None:
            link.stop()
            return []
        if offset >= link.size:
            # Just behind the end: an empty packet says that there is no more, which some readers wait for.
            link.stop()
            return [("LOG_DATA", {"id": link.log_id, "ofs": offset, "count": 0})]
        packets = min(link.pace, -(-max(link.end - offset, 1) // DATA_BYTES))
        wanted = min(packets * DATA_BYTES, link.size - offset)
        try:
            os.lseek(file, offset, os.SEEK_SET)
            data = os.read(file, wanted)
        except OSError:
            data = b""
        if len(data) < wanted:  # it was cut meanwhile
            link.stop()
        else:
            link.offset = offset + wanted if offset + wanted < link.end else None
        return [
            (
                "LOG_DATA",
                {
                    "id": link.log_id,
                    "ofs": offset + start,
                    "count": min(DATA_BYTES, len(data) - start),
                    "data": data[start : start + DATA_BYTES],
                },
            )
            for start in range(0, len(data), DATA_BYTES)
        ]

    def _erase(self) -> None:
        for link in self._links.values():
            link.stop()
            link.close()
            link.logs = None
        kept = self._writing()
        for log in find_logs(self.directory):
            if not _same(log.path, kept) and remove_log(log.path):
                self.erased += 1
        self._scan_us = None


def _same(path: Path, kept: Path | None) -> bool:
    try:
        return kept is not None and path.samefile(kept)
    except OSError:
        return False
