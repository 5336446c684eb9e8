"""Telemetry logs (.tlog): every frame of both directions with the time it passed.

Per frame eight bytes, big-endian: microseconds since 1 January 1970 UTC; then the frame as it was on the
wire. No header. MAVProxy, QGroundControl and pymavlink write and read the same.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
from collections.abc import Iterator
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import Self

from bridge.behind_file import BehindFile
from bridge.messages import MAGIC_1, MAGIC_2
from sitl.errors import FileError

# 1 January 2020 UTC. Simulated flights start here, on whatever day they are flown: same seed, same file.
SIMULATED_EPOCH_US = 1_577_836_800_000_000

_STAMP = struct.Struct(">Q")
_SIGNED = 0x01
_MOST_WAITING = 512


def whole_frames(data: bytes | mmap.mmap) -> Iterator[tuple[int, int, int]]:
    """Where the frames of a .tlog are, whose end may be missing: up to the first that is not whole.

    Args:
        data: the file.

    Yields:
        (time in us from 1970, where the frame begins, where it ends).
    """
    at = 0
    while at + 20 <= len(data):
        begin = at + _STAMP.size
        magic, payload = data[begin], data[begin + 1]
        if magic == MAGIC_2:
            size = 12 + payload + (13 if data[begin + 2] & _SIGNED else 0)
        elif magic == MAGIC_1:
            size = 8 + payload
        else:
            break
        if begin + size > len(data):
            break
        yield _STAMP.unpack_from(data, at)[0], begin, begin + size
        at = begin + size


class TlogWriter:
    """Writes a .tlog file; use it as a context manager, or close it.

    Args:
        path: the file, overwritten if it exists.
        epoch_us: added to every time: SIMULATED_EPOCH_US where times are vehicle time, 0 where they are UTC.
        waits_s: how long a frame may wait for others, s: with the next one after that, all are written, by a thread:
            who flies by the clock does not wait for a disk.

    Raises:
        FileError: the file cannot be written (from `write` and `close` too, on a full disk).
    """

    def __init__(self, path: str | Path, *, epoch_us: int = SIMULATED_EPOCH_US, waits_s: float = math.inf) -> None:
        self.path = Path(path)
        self.epoch_us = epoch_us
        self._waits_us = waits_s * 1e6
        self._written = 0
        self._times_us: list[int] = []
        self._frames: list[bytes] = []
        self._file: BehindFile | BufferedWriter
        try:
            if math.isfinite(waits_s):
                how = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
                self._file = BehindFile(os.open(self.path, how, 0o666))
            else:
                self._file = self.path.open("wb")
        except OSError as error:
            raise self._unwritable(error) from None

    def write(self, time_us: int, frame: bytes) -> None:
        """Append one frame.

        Args:
            time_us: when it passed, in microseconds from the epoch; never negative.
            frame: the whole frame.
        """
        # stamped when it is written: this runs at every frame of a flight
        times_us = self._times_us
        times_us.append(time_us)
        frames = self._frames
        frames.append(frame)
        if len(frames) >= _MOST_WAITING or time_us - times_us[0] >= self._waits_us:
            self.flush()

    @property
    def frames(self) -> int:
        """Frames appended so far."""
        return self._written + len(self._frames)

    def flush(self) -> None:
        """Hand what waits to the operating system: from here on a killed process loses nothing of it."""
        times_us, frames = self._times_us, self._frames
        self._times_us, self._frames = [], []
        self._written += len(frames)
        stamp, epoch_us = _STAMP.pack, self.epoch_us
        stamps = [stamp(epoch_us + time_us) for time_us in times_us]
        data = b"".join([part for pair in zip(stamps, frames, strict=True) for part in pair])
        try:
            self._file.write(data)
            if not isinstance(self._file, BehindFile):
                self._file.flush()
        except OSError as error:
            raise self._unwritable(error) from None

    def close(self) -> None:
        """Write what waits and release the file; may be repeated."""
        if self._file.closed:
            return
        try:
            self.flush()
        finally:
            self._release()

    def _release(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            if not isinstance(self._file, BehindFile):
                self._file.raw.close()  # a full disk fails the flush, and the file would stay open
            raise self._unwritable(error) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _unwritable(self, error: OSError) -> FileError:
        return FileError(
            self.path,
            f"the telemetry log cannot be written ({error.strerror or error})",
            "Check the folder, its permissions and the space left on the disk",
        )
