"""One of a vehicle's links: its frames, its stream rates, who is there, the texts that wait for a ground station."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from bridge.connection import Connection, Message
from bridge.errors import FieldError
from bridge.link import Link
from bridge.streams import LinkMode, Schedule
from bridge.telemetry import Fields
from sitl.modes import Severity

GCS_TIMEOUT_US = 2_500_000
"""A link without a ground station's HEARTBEAT for this long gets no STATUSTEXT (PX4 HEARTBEAT_TIMEOUT_US)."""

_TEXT_BYTES = 50
_TEXT_LIFE_US = 5_000_000
_TEXTS_KEPT = 32
_LARGEST_FLOAT32 = 3.4028234663852886e38


class ServerLink:
    """One link of the vehicle, with stream rates and a ground station of its own.

    Args:
        link: carries the bytes.
        connection: frames them; its sysid and compid are the vehicle's.
        link_id: a number of its own among the vehicle's links.
        mode: whose default rates.

    Attributes:
        schedule: when each message is due here.
        peers: (sysid, compid) of everybody heard here.
        heard_us: vehicle time of the last bytes.
        gcs_seen_us: vehicle time of a ground station's last HEARTBEAT, None before the first.
        waiting: messages that came and are not handled yet; those of one datagram, or one piece of a stream.
    """

    def __init__(self, link: Link, connection: Connection, link_id: int, mode: LinkMode) -> None:
        self.link = link
        self.connection = connection
        self.link_id = link_id
        self.mode = mode
        self.schedule = Schedule(mode)
        self.peers: set[tuple[int, int]] = set()
        self.waiting: deque[Message] = deque()
        self.gcs_seen_us: int | None = None
        self.heard_us = 0
        self.resting_until_us = 0
        self.texts: deque[tuple[int, Severity, str]] = deque(maxlen=_TEXTS_KEPT)
        self._text_id = 0

    def send(self, name: str, fields: Fields) -> None:
        """Send one message now; what a diverging vehicle drives beyond float32 is sent as infinity."""
        try:
            frame = self.connection.encode_fields(name, fields)
        except FieldError:
            fields = {key: _float32(value) for key, value in fields.items()}
            frame = self.connection.encode_fields(name, fields)
        self.link.send(frame)

    def hears_gcs(self, now_us: int) -> bool:
        """Return whether a ground station is there."""
        return self.gcs_seen_us is not None and now_us - self.gcs_seen_us <= GCS_TIMEOUT_US

    def send_texts(self, now_us: int) -> None:
        """Send the texts that wait, to a ground station only; what is older than 5 s is no longer news."""
        while self.texts:
            said_us, severity, text = self.texts[0]
            if now_us - said_us <= _TEXT_LIFE_US:
                if not self.hears_gcs(now_us):
                    return
                self._send_text(severity, text)
            self.texts.popleft()

    def _send_text(self, severity: Severity, text: str) -> None:
        """Send a text in chunks of 50 bytes; one that ends at a full chunk is closed by an empty one."""
        data = text.encode()
        self._text_id = self._text_id % 65535 + 1  # 0 would mean: not in chunks
        for chunk in range(len(data) // _TEXT_BYTES + 1):
            part = data[chunk * _TEXT_BYTES : (chunk + 1) * _TEXT_BYTES]
            self.send(
                "STATUSTEXT",
                {"severity": int(severity), "text": part, "id": self._text_id, "chunk_seq": chunk & 0xFF},
            )


def _float32(value: Any) -> Any:
    """Return floats that float32 cannot hold as infinities, alone or in a sequence; anything else as it is."""
    if isinstance(value, float) and abs(value) > _LARGEST_FLOAT32:
        return math.copysign(math.inf, value)
    if isinstance(value, (tuple, list)):
        return [_float32(one) for one in value]
    return value
