"""One peer floods its link; another flies on a second one, and gets what it gets without the flood."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile_vehicle import COMPONENT, US, Watched, weight

from bridge.connection import Connection
from bridge.services import VehicleFiles
from sitl.modes import Mode
from sitl.rotation import from_euler, to_euler

TARGET = {"target_system": US, "target_component": COMPONENT}
TICKS_PER_S = 250
FLOOD_PER_TICK = 20  # 5000 a second
SECONDS = 1
FLOODED, FLYING = 0, 1
STREAMS = ("ATTITUDE", "ATTITUDE_TARGET", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYS_STATUS", "HEARTBEAT")
AMPLITUDE_RAD = math.radians(5.0)

Flood = Callable[[int], bytes]


def ftp(opcode: int, data: bytes = b"", *, size: int | None = None, offset: int = 0) -> Flood:
    """MAVFTP requests, each with a number of its own: none is taken for a repeat."""

    def request(number: int) -> bytes:
        head = bytes(
            [number * 2 & 0xFF, number * 2 >> 8 & 0xFF, 0, opcode, len(data) if size is None else size, 0, 0, 0]
        )
        payload = (head + offset.to_bytes(4, "little") + data).ljust(251, b"\0")
        return STATION.encode("FILE_TRANSFER_PROTOCOL", payload=payload, **TARGET)

    return request


def asking(name: str, **fields: object) -> Flood:
    return lambda _: STATION.encode(name, **{**TARGET, **fields})


def commanding(*numbers: int, **fields: object) -> Flood:
    return lambda number: STATION.encode(
        "COMMAND_LONG", command=numbers[number % len(numbers)], confirmation=number & 0xFF, **fields, **TARGET
    )


def in_turn(*floods: Flood) -> Flood:
    return lambda number: floods[number % len(floods)](number // len(floods))


STATION = Connection(254, 190)
FLOODS: dict[str, Flood] = {
    "PARAM_REQUEST_LIST": asking("PARAM_REQUEST_LIST"),
    "PARAM_REQUEST_READ": asking("PARAM_REQUEST_READ", param_id="MC_ROLL_P", param_index=-1),
    "PARAM_SET": lambda number: STATION.encode(
        "PARAM_SET",
        param_id="SYS_AUTOSTART",
        param_value=(number & 0x7FFF).to_bytes(4, "little"),
        param_type=6,
        **TARGET,
    ),
    "MISSION_REQUEST_LIST": asking("MISSION_REQUEST_LIST"),
    "MISSION_COUNT 65535": asking("MISSION_COUNT", count=65535),
    "MISSION_ITEM_INT": asking("MISSION_ITEM_INT", seq=3),
    "MISSION_CLEAR_ALL": asking("MISSION_CLEAR_ALL", mission_type=255),
    "FTP bursts": in_turn(ftp(4, b"log/2026-01-01/00_00_00.ulg"), ftp(15), ftp(1)),
    "FTP lists": in_turn(ftp(3, b"log"), ftp(3, b"log/2026-01-01"), ftp(3, b"etc/extras")),
    "FTP checksums": ftp(14, b"log/2026-01-01/00_00_00.ulg"),
    "FTP files": in_turn(ftp(6, b"a"), ftp(7, bytes(239), offset=1000), ftp(1), ftp(8, b"a")),
    "all parameters as a file": in_turn(ftp(4, b"@PARAM/param.pck"), ftp(1)),
    "LOG_REQUEST_LIST": asking("LOG_REQUEST_LIST", start=0, end=0xFFFF),
    "LOG_REQUEST_DATA": in_turn(
        asking("LOG_REQUEST_LIST", start=0, end=0xFFFF), asking("LOG_REQUEST_DATA", id=0, ofs=0, count=0xFFFFFFFF)
    ),
    "unknown commands": lambda number: STATION.encode("COMMAND_LONG", command=number * 7 & 0xFFFF | 0x8000, **TARGET),
    "commands that are refused": commanding(400, 176, 300, 2501, param1=7.0),
    "message requests": commanding(512, param1=148.0),
    "all modes": commanding(512, param1=435.0),
    "all metadata": commanding(512, param1=397.0),
    "intervals": commanding(510, 511, param1=30.0, param2=4000.0),
    "TIMESYNC": asking("TIMESYNC", ts1=1),
    "PING": lambda number: STATION.encode("PING", time_usec=number, seq=number),
    "for others": lambda number: STATION.encode("COMMAND_LONG", command=400, target_system=9, param7=float(number)),
    "to everybody": lambda number: STATION.encode("STATUSTEXT", severity=0, text=f"flood {number}"),
}
GROUPS = [tuple(FLOODS)[start::5] for start in range(5)]


class Duet:
    """A vehicle in the air, flown in Offboard over the second of its links.

    Attributes:
        heard: what the vehicle said on the second link, by name. texts: of it.
        rolled: roll angle after every tick.
    """

    def __init__(self, logs: Path) -> None:
        day = logs / "2026-01-01"
        day.mkdir(parents=True)
        for number in range(60):
            (day / f"00_{number:02d}_00.ulg").write_bytes(bytes(200_000 if number == 0 else 10))
        self.watched = Watched(files=VehicleFiles(logs=logs)).hover()
        self.server, self.vehicle = self.watched.server, self.watched.vehicle
        self.thrust = float(self.vehicle.model.assumptions.hover_thrust)
        self.heard: Counter[str] = Counter()
        self.texts: list[str] = []
        self.rolled: list[float] = []
        self._floods = self._ticks = 0
        self.fly(0.5)
        self.watched.send("COMMAND_LONG", FLYING, command=176, param1=1.0, param2=6.0, **TARGET)
        self.fly(0.5)
        assert self.vehicle.autopilot.mode is Mode.OFFBOARD

    def fly(self, seconds: float, flood: Flood | None = None, *, setpoints: bool = True) -> Counter[str]:
        """Send set-points 50 times a second on the one link, and the flood on the other; what was heard meanwhile."""
        watched, before = self.watched, self.heard.copy()
        for _ in range(round(seconds * TICKS_PER_S)):
            if setpoints and self._ticks % 5 == 0:
                angle = AMPLITUDE_RAD * math.sin(2.0 * math.pi * 0.5 * self._ticks / TICKS_PER_S)
                aim = {"q": from_euler(angle, 0.0, 0.0), "thrust": self.thrust, "type_mask": 7, **TARGET}
                watched.send("SET_ATTITUDE_TARGET", FLYING, **aim)
            if self._ticks % TICKS_PER_S == 0:
                watched.send("HEARTBEAT", FLYING, type=6, autopilot=8)
                watched.ends[FLOODED].send(STATION.encode("HEARTBEAT", type=6, autopilot=8))
            if flood is not None:
                for _ in range(FLOOD_PER_TICK):
                    self._floods += 1
                    watched.ends[FLOODED].send(flood(self._floods))
            self.server.step()
            self._ticks += 1
            self.rolled.append(to_euler(self.vehicle.truth.quat())[0])
            self._listen()
        return self.heard - before

    def _listen(self) -> None:
        while self.watched.ends[FLOODED].recv() is not None:
            pass
        while (data := self.watched.ends[FLYING].recv()) is not None:
            for message in self.watched.stations[FLYING].receive(data):
                self.heard[message.name] += message.sysid == US
                if message.name == "STATUSTEXT" and message.sysid == US:
                    self.texts.append(message.text)


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Counter[str]], list[float]]:
    """What is heard in every stretch of a flight, and its roll angles, when nobody floods."""
    duet = Duet(tmp_path_factory.mktemp("quiet") / "logs")
    return [duet.fly(SECONDS) for _ in GROUPS[0]], duet.rolled


@pytest.mark.parametrize("group", GROUPS, ids=[", ".join(group) for group in GROUPS])
def test_a_flood_leaves_the_other_link_alone(
    group: tuple[str, ...], quiet: tuple[list[Counter[str]], list[float]], tmp_path: Path
) -> None:
    """5000 messages a second: the same set-points are flown at the same ticks, the same streams come at their rates."""
    duet = Duet(tmp_path / "logs")
    before = weight(duet.server)
    for kind, rates in zip(group, quiet[0], strict=False):
        heard = duet.fly(SECONDS, FLOODS[kind])
        assert duet.vehicle.autopilot.mode is Mode.OFFBOARD, kind
        for name in STREAMS:
            assert abs(heard[name] - rates[name]) <= max(1, 0.02 * rates[name]), (kind, name)
        assert duet.rolled == quiet[1][: len(duet.rolled)], kind
    while duet.watched.links[FLOODED].link._inbox:  # type: ignore[attr-defined]
        duet.fly(0.1)
    assert weight(duet.server) - before < 300_000
    assert duet.watched.answers(FLYING)
    assert not duet.server.defects


@pytest.mark.parametrize(
    "kind", ["MISSION_ITEM_INT", "MISSION_COUNT 65535", "commands that are refused", "senseless arming", "PARAM_SET"]
)
def test_a_flood_does_not_drown_what_the_vehicle_has_to_say(kind: str, tmp_path: Path) -> None:
    duet = Duet(tmp_path / "logs")
    flood = FLOODS.get(kind) or (lambda number: arming(1.5 + number))
    duet.fly(1.0, flood)
    said = len(duet.texts)
    assert said <= 160  # 50 at once and 20 a second of what peers and vehicle say, each
    duet.fly(2.0, flood, setpoints=False)
    assert any("Failsafe" in text or "failsafe" in text for text in duet.texts[said:]), duet.texts[said:]


def arming(param1: float) -> bytes:
    return STATION.encode("COMMAND_LONG", command=400, param1=param1, **TARGET)


def test_what_one_link_may_ask_for_in_a_tick_is_bounded() -> None:
    """However it comes: one datagram of as much as fits, or many."""
    watched = Watched()
    watched.run(1.0)
    ask = STATION.encode("COMMAND_LONG", command=512, param1=148.0, **TARGET)
    many = STATION.encode("COMMAND_LONG", command=512, param1=435.0, **TARGET)
    for data, pieces in ((ask * 80, 1), (ask, 80), (many * 80, 1), (b"\xfd" * 4096, 20)):
        for _ in range(pieces):
            watched.put(data, FLOODED)
        connection = watched.links[FLOODED].connection
        sent, bad = connection.sent, connection.counters.bad_bytes
        watched.server.listen()
        assert connection.sent - sent <= 128 + 32
        assert connection.counters.bad_bytes - bad <= 4096
        assert watched.answers(FLYING)
        watched.tick(60)


def test_a_defect_of_one_service_keeps_no_other_from_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched()
    watched.run(1.0)
    watched.server.strict = False

    def broken(link_id: int, now_us: int) -> list[object]:
        raise ZeroDivisionError

    monkeypatch.setattr(watched.server.services.events, "poll", broken)
    asked = watched.ask("PARAM_REQUEST_LIST", link=FLYING, ticks=20, **TARGET)
    assert sum(message.name == "PARAM_VALUE" for message in asked) > 20
    assert watched.server.defects
