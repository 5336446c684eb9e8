"""Signing: MAVLink 2 frames that only the holder of a key can have made, each accepted once. Sans-IO.

    timestamps = Timestamps(key.timestamp, utc_us)        # one for all links of a vehicle
    connection.signer = Signer(key, link_id, require=True, timestamps=timestamps)

A signed frame has incompatibility flag 0x01 and ends in 13 bytes: link id, timestamp (48 bits, 10 us since 2015)
and the first 48 bits of SHA-256 over key, frame (from its magic to its checksum), link id and timestamp. It shows
who sent the frame and that it is new; it hides nothing. Sources: MAVLink's page on message signing, the C library's
mavlink_helpers.h, PX4's mavlink_sign_control.cpp.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto
from hmac import compare_digest

from bridge.messages import SIGNATURE, SIGNED
from sitl.errors import UsageError

SECRET_BYTES = 32
EPOCH_US = 1_420_070_400_000_000
"""UTC of timestamp 0 in microseconds since 1970: 1 January 2015."""

LATEST = 2**48 - 1
"""The last timestamp there is (in the year 2104)."""

NEW_STREAM_AGE = 6_000_000
"""How far behind the newest timestamp the first of a stream may be: a minute in 10 us."""

MOST_STREAMS = 64
"""Streams remembered (the C library: 16). Never one is dropped: who comes later is refused."""

ALWAYS_UNSIGNED = frozenset((109, 246, 247))
"""RADIO_STATUS, ADSB_VEHICLE and COLLISION come from devices that cannot sign (PX4's list)."""

_UNITS_US = 10
_DIGEST = 6


@dataclass(frozen=True)
class SigningKey:
    """A key and the last timestamp used with it.

    Attributes:
        secret: 32 bytes, never shown.
        timestamp: 10 us since 2015; what is signed next is later.

    Raises:
        UsageError: a secret of another length, or a timestamp that does not fit 48 bits.
    """

    secret: bytes = field(repr=False)
    timestamp: int = 0

    def __post_init__(self) -> None:
        if len(self.secret) != SECRET_BYTES:
            raise UsageError(f"a signing key of {len(self.secret)} bytes: give {SECRET_BYTES}")
        if not 0 <= self.timestamp <= LATEST:
            raise UsageError(f"signing timestamp {self.timestamp}: it does not fit 48 bits; give 0 to {LATEST}")

    @property
    def initialised(self) -> bool:
        """Whether this is a key at all: all zeros with timestamp 0 means that none has been set (PX4)."""
        return self.timestamp != 0 or any(self.secret)

    def same_secret(self, other: SigningKey) -> bool:
        """Whether both sign alike; takes as long whatever the answer."""
        return compare_digest(self.secret, other.secret)

    def made(self, frame: bytes) -> bool:
        """Whether this key signed a frame, its last 13 bytes the signature; when is not looked at."""
        digest = hashlib.sha256(self.secret + frame[:-_DIGEST]).digest()[:_DIGEST]
        return compare_digest(digest, frame[-_DIGEST:])


NO_KEY = SigningKey(bytes(SECRET_BYTES))
"""What a vehicle has before its first key."""


def to_timestamp(utc_us: int) -> int:
    """Return UTC (microseconds since 1970) in 10 us since 2015; 0 for what is before that, or unknown (0)."""
    return min(max(0, utc_us - EPOCH_US) // _UNITS_US, LATEST)


class Timestamps:
    """The newest timestamp of one key and of every stream signed with it.

    All links of a vehicle share one, so that a frame heard on one link cannot be played back on another.

    Args:
        newest: 10 us since 2015, what the key file says.
        utc_us: tells microseconds since 1970 UTC, 0 while unknown: then time goes on by one with each frame and
            follows what the other side signs.

    Attributes:
        newest: the latest timestamp sent or accepted, 10 us since 2015. It belongs into the key file.
    """

    __slots__ = ("_streams", "_utc_us", "newest")

    def __init__(self, newest: int = 0, utc_us: Callable[[], int] | None = None) -> None:
        self.newest = newest
        self._utc_us = utc_us
        self._streams: dict[bytes, int] = {}

    @property
    def streams(self) -> int:
        """How many streams are known; never more than MOST_STREAMS."""
        return len(self._streams)

    def next(self) -> int:
        """Return the timestamp of the next frame to send: now, but later than all before."""
        now = 0 if self._utc_us is None else to_timestamp(self._utc_us())
        # At the end of time it stands still, and the other side refuses what is repeated.
        self.newest = newest = min(max(self.newest + 1, now), LATEST)
        return newest

    def admit(self, stream: bytes, timestamp: int) -> bool:
        """Take note of a genuine frame's timestamp; False if the frame is not to be believed again.

        Args:
            stream: the sender's system id, component id and link id.
            timestamp: 10 us since 2015.
        """
        last = self._streams.get(stream)
        if last is not None:
            if timestamp <= last:
                return False
        else:
            now = 0 if self._utc_us is None else to_timestamp(self._utc_us())
            if timestamp + NEW_STREAM_AGE < max(self.newest, now) or len(self._streams) >= MOST_STREAMS:
                return False
        self._streams[stream] = timestamp
        if timestamp > self.newest:
            self.newest = timestamp
        return True


class Verdict(Enum):
    """What a signature says about its frame."""

    GENUINE = auto()
    FORGED = auto()  # made with another key, or damaged
    REPLAYED = auto()  # genuine once: its timestamp is not new, too old for a new stream, or of one stream too many


class Signer:
    """Signs and verifies the frames of one link.

    A key that is not initialised signs nothing and accepts everything.

    Args:
        key: the key; its timestamp counts only where no `timestamps` are given.
        link_id: 0 to 255, different for each link of a vehicle (PX4: the number of the MAVLink instance).
        require: refuse frames without a signature. A wrong signature is refused always.
        utc_us: as for `Timestamps`.
        timestamps: those of the vehicle's other links, where there are others.

    Attributes:
        flags: incompatibility flags of what we send.

    Raises:
        UsageError: a link id that does not fit a byte.
    """

    __slots__ = ("_key", "_link", "_require", "flags", "timestamps")

    def __init__(
        self,
        key: SigningKey,
        link_id: int,
        *,
        require: bool = True,
        utc_us: Callable[[], int] | None = None,
        timestamps: Timestamps | None = None,
    ) -> None:
        if not 0 <= link_id <= 255:
            raise UsageError(f"signing link id {link_id}: choose one from 0 to 255")
        self.timestamps = Timestamps(key.timestamp, utc_us) if timestamps is None else timestamps
        self.flags = SIGNED if key.initialised else 0
        self._key = key
        self._link = bytes([link_id])
        self._require = require and key.initialised

    @property
    def timestamp(self) -> int:
        """The newest timestamp sent or accepted, 10 us since 2015."""
        return self.timestamps.newest

    @property
    def key(self) -> SigningKey:
        """The key as it belongs into its file now."""
        return SigningKey(self._key.secret, self.timestamps.newest) if self.flags else self._key

    def signature(self, frame: bytes) -> bytes:
        """Return the 13 bytes that follow a frame.

        Args:
            frame: from its magic to its checksum, `flags` set in its header.
        """
        tail = self._link + self.timestamps.next().to_bytes(_DIGEST, "little")
        return tail + hashlib.sha256(self._key.secret + frame + tail).digest()[:_DIGEST]

    def verify(self, frame: bytes) -> Verdict:
        """Judge a signed frame whose checksum is right, and take note of it: the same frame is not genuine again."""
        if not self.flags:
            return Verdict.GENUINE
        if not self._key.made(frame):
            return Verdict.FORGED
        stream = frame[5:7] + frame[-SIGNATURE : 1 - SIGNATURE]
        timestamp = int.from_bytes(frame[1 - SIGNATURE : -_DIGEST], "little")
        return Verdict.GENUINE if self.timestamps.admit(stream, timestamp) else Verdict.REPLAYED

    def accepts_unsigned(self, message_id: int) -> bool:
        """Whether a message may come without a signature."""
        return not self._require or message_id in ALWAYS_UNSIGNED
