"""FlightLog: the vehicle writes its flights as PX4's ULog files.

By default a file lasts from arming to a second after disarming; SDLOG_MODE says otherwise as in PX4:

    -1 never   0 armed   1 from boot to disarming, then armed   2 from boot to shutdown   4 from arming to shutdown

The file is valid at any moment: what is in it stands in whole messages, and about a twelfth of a second of flight is
written at once, so a process that is killed loses at most that. A disk that is full ends the log and not the flight.

Source: PX4 src/modules/logger.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from bridge import ulog
from bridge.behind_file import BehindFile, DirectFile
from bridge.log_store import create_log, make_room, next_session
from bridge.ulog_preamble import TYPES, information, initial_parameters
from bridge.ulog_ring import Ring
from bridge.ulog_topics import Profile, StateTopics, Topic
from sitl.modes import Severity
from sitl.parameters import ParameterTable
from sitl.setpoints import Sticks
from sitl.vehicle import Vehicle

FLUSH_US: Final = 80_000
"""Flight that one write carries, us: what a killed program has not written yet is less than a tenth of a second."""
LINGER_US: Final = 1_000_000
"""Time a log goes on after it is not wanted any more, us."""
CHECK_US: Final = 10_000
"""Time between two looks at the slow topics, us."""
MOST_FLUSH_US: Final = 1_000_000
"""The same of a vehicle that flies faster than time: its tenth of a second holds more flight."""
MAX_TEXTS: Final = 64
"""Texts kept per second; further ones are dropped."""
TEXTS_US: Final = 1_000_000
MAX_TOTAL_BYTES: Final = 2**30
MIN_FILE_BYTES: Final = 2**20

_FROM_BOOT, _TO_SHUTDOWN, _ARMED_TO_SHUTDOWN, _NEVER = 1, 2, 4, -1


class _Due:
    """When a slow topic comes next, and what it was when it came last."""

    __slots__ = ("due_us", "key", "message_id", "topic")

    def __init__(self, topic: Topic, message_id: int) -> None:
        self.topic = topic
        self.message_id = message_id
        self.due_us = 0
        self.key: object = self  # like nothing that a topic gives


class FlightLog:
    """Writes the logs of one vehicle.

    Args:
        directory: where they go, `sess001/log100.ulg` or, with `utc_boot_us`, `2026-11-22/22_45_45.ulg`; made when the
            first log begins. One vehicle each.
        vehicle: what is logged.
        system_id: its MAVLink system.
        utc_boot_us: UTC at vehicle time 0, us; 0 for unknown. No other clock is asked.
        max_total_bytes: most bytes of logs below the directory; the oldest are deleted. A single file is ended and the
            next begun at a quarter of it.
        flush_us: flight that one write carries, us.
        behind: files are written by threads, and the vehicle waits for no disk.
        say: takes texts for people.
        sticks: the pilot's sticks, None while there are none.
        facts: further information for the file, such as the name of the airframe; texts by key.

    Attributes:
        path: the file being written, None for none.
        failures: logs that could not be written to their end.
        dropped_texts: texts that were too many.
    """

    def __init__(
        self,
        directory: Path,
        vehicle: Vehicle,
        *,
        system_id: int = 1,
        utc_boot_us: int = 0,
        max_total_bytes: int = MAX_TOTAL_BYTES,
        flush_us: int = FLUSH_US,
        behind: bool = False,
        say: Callable[[Severity, str], None] = lambda severity, text: None,
        sticks: Callable[[], Sticks | None] = lambda: None,
        facts: Mapping[str, str] | None = None,
    ) -> None:
        self.directory = Path(directory)
        self.path: Path | None = None
        self.failures = 0
        self.dropped_texts = 0
        self._vehicle = vehicle
        self._autopilot = vehicle.autopilot
        self._parameters: ParameterTable = vehicle.parameters
        self._system_id = system_id
        self._utc_boot_us = max(utc_boot_us, 0)
        self._flush_every_us = flush_us
        self._file_bytes = max(max_total_bytes // 4, MIN_FILE_BYTES)
        self._total_bytes = max(max_total_bytes - self._file_bytes, 0)
        self._say = say
        self._sticks = sticks
        self._facts = dict(facts or {})
        self._session = ""
        self._made = 0
        self._open_file: type[DirectFile] | type[BehindFile] = BehindFile if behind else DirectFile
        self._file: DirectFile | BehindFile | None = None
        self._ending: list[tuple[Path, DirectFile | BehindFile]] = []
        self._size = 0
        self._ring: Ring | None = None
        self._slow: list[_Due] = []
        self._waiting: list[bytes] = []
        self._texts = 0
        self._check_us = self._flush_us = self._texts_us = 0
        self._check_period_us = CHECK_US
        self._unwanted_us: int | None = None
        self._revision = -1
        self._seen = (-1, False)  # revision of the parameters and armed, when last decided
        self._was_armed = self._was_disarmed = self._blocked = False

    # -- every tick --------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Log the step the vehicle made just now; call it after each one."""
        ring = self._ring
        if self._ending:
            self._see_ended()
        if ring is None:
            autopilot = self._autopilot
            if autopilot.armed is self._seen[1] and self._parameters.revision == self._seen[0]:
                return
            if not self._wanted():
                return
            self._begin()
            ring = self._ring
            if ring is None:
                return
        now_us = self._vehicle.time_us
        ring.take(now_us)
        if now_us >= self._check_us or ring.full:
            self._check(now_us, ring)

    def text(self, severity: int, text: str) -> None:
        """Log a text for people (STATUSTEXT). severity: MAV_SEVERITY, 0..7."""
        if self._ring is None:
            return
        self._texts += 1
        if self._texts > MAX_TEXTS:
            self.dropped_texts += 1
            return
        self._waiting.append(ulog.logged_text(int(severity), self._vehicle.time_us, text.rstrip("\t")))

    def close(self) -> None:
        """Write what is left and end the log: the vehicle shuts down."""
        if self._ring is not None:
            self._flush(self._ring)
        self._end()
        self._see_ended(wait=True)

    # -- when to log -------------------------------------------------------------------------------------------

    def _wanted(self) -> bool:
        """Should a log be written now? Notes what it was decided on."""
        armed = bool(self._autopilot.armed)
        if armed is not self._seen[1]:
            self._blocked = False  # a disk that was full is tried again at the next arming
            self._was_armed |= armed
            self._was_disarmed |= not armed
        self._seen = (self._parameters.revision, armed)
        mode = self._parameter("SDLOG_MODE", 0)
        if mode == _NEVER or self._blocked:
            return False
        return (
            armed
            or mode == _TO_SHUTDOWN
            or (mode == _FROM_BOOT and not self._was_disarmed)
            or (mode == _ARMED_TO_SHUTDOWN and self._was_armed)
        )

    def _parameter(self, name: str, otherwise: int) -> int:
        return int(self._parameters.get(name)) if name in self._parameters else otherwise

    def _check(self, now_us: int, ring: Ring) -> None:
        self._check_us = now_us + self._check_period_us
        if self._parameters.revision != self._revision:
            self._write_changed(ring)
        for due in self._slow:
            topic = due.topic
            late = now_us >= due.due_us
            if topic.key is None:
                if not late:
                    continue
            else:
                key = topic.key()
                if key == due.key and not (late and topic.period_us):
                    continue
                due.key = key
            due.due_us = now_us + topic.period_us - now_us % (topic.period_us or 1)
            values = topic.sample(now_us)
            if values is not None:
                self._waiting.append(topic.layout.pack(due.message_id, values))
        if self._wanted():
            self._unwanted_us = None
        elif self._unwanted_us is None:
            self._unwanted_us = now_us
        ended = self._unwanted_us is not None and now_us - self._unwanted_us >= LINGER_US
        if ended or now_us >= self._flush_us or ring.full:
            self._flush_us = now_us + self._flush_every_us
            self._flush(ring)
            if now_us >= self._texts_us:
                self._texts, self._texts_us = 0, now_us + TEXTS_US
        if ended:
            self._end()
        elif self._size >= self._file_bytes and self._ring is not None:
            self._end()
            self._begin()

    # -- the file ----------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        vehicle = self._vehicle
        now_us = vehicle.time_us
        asked = self._parameter("SDLOG_PROFILE", 1) & 0xFFFF
        profile = Profile(asked & int(Profile.DEFAULT | Profile.HIGH_RATE | Profile.SYSTEM_IDENTIFICATION))
        profile = profile or Profile.DEFAULT
        most_folders = max(self._parameter("SDLOG_DIRS_MAX", 0), 0)
        try:
            make_room(self.directory, most_bytes=self._total_bytes, most_folders=most_folders)
            self._session = self._session or next_session(self.directory)
            utc_us = self._utc_boot_us + now_us if self._utc_boot_us else 0
            self.path, number = create_log(self.directory, self._session, utc_us, earlier=self._made)
        except OSError as error:
            self._fail(error)
            return
        self._file = self._open_file(number)
        self._made += 1
        ring = Ring(vehicle, profile, self._flush_every_us // vehicle.tick_us + 2)
        topics = StateTopics(
            vehicle,
            system_id=self._system_id,
            profile=profile,
            utc_boot_us=self._utc_boot_us,
            sticks=self._sticks,
        ).topics
        layouts = [topic.layout for topic, _ in ring.topics] + [topic.layout for topic in topics]
        first_slow = len(ring.topics)
        self._ring = ring
        self._revision = self._parameters.revision
        self._slow = [_Due(topic, number) for number, topic in enumerate(topics, start=first_slow)]
        self._size = self._texts = 0
        self._check_us, self._flush_us, self._texts_us = 0, now_us + self._flush_every_us, now_us + TEXTS_US
        self._check_period_us = 0 if profile & Profile.HIGH_RATE else CHECK_US
        self._unwanted_us = None
        self._waiting = [
            ulog.header(now_us),
            ulog.flag_bits(),
            *information(vehicle, self._system_id, utc_boot_us=self._utc_boot_us, facts=self._facts),
            *(layout.definition() for layout in layouts),
            *initial_parameters(self._parameters),
            *(ulog.subscription(number, layout.topic) for number, layout in enumerate(layouts)),
        ]
        self._write()

    def _write_changed(self, ring: Ring) -> None:
        """Parameters that were set meanwhile, after the samples that did not know them yet."""
        table = self._parameters
        changed, self._revision = table.changed_since(self._revision), table.revision
        if changed:
            self._waiting.append(ring.drain(0))
        for name in changed:
            self._waiting.append(ulog.parameter(TYPES[table.spec(name).type], name, table.raw(name)))

    def _flush(self, ring: Ring) -> None:
        self._waiting.append(ring.drain(0))
        self._waiting.append(ulog.sync())
        self._write()

    def _write(self) -> None:
        """Write all that waits; on failure what is in the file stays, to the last whole message."""
        data, self._waiting = b"".join(self._waiting), []
        if self._file is None:
            return
        try:
            self._file.write(data)
        except OSError as error:
            self._fail(error)
            return
        self._size += len(data)

    def _end(self) -> None:
        path, file = self.path, self._file
        self._file, self.path, self._ring = None, None, None
        self._slow, self._waiting = [], []
        if path is not None and file is not None:
            file.finish()
            self._ending.append((path, file))
            self._see_ended()

    def _see_ended(self, *, wait: bool = False) -> None:
        """Let go of files of which all is written, or wait until it is."""
        for path, file in self._ending[:]:
            if wait or file.finished:
                self._ending.remove((path, file))
                try:
                    file.close()
                except OSError as error:
                    self._fail(error, path)

    def _fail(self, error: OSError, path: Path | None = None) -> None:
        self.failures += 1
        self._blocked = True
        where = path or self.path or self.directory
        self._end()
        self._say(
            Severity.ERROR,
            f"Logging stopped: {where} cannot be written ({error.strerror or error}). "
            "Make it writable; the next arming tries again",
        )
