"""A vehicle of ours with the two stations that the recorded cases of a PX4 were asked by, in vehicle time.

Nobody waits for a clock: three seconds are 750 ticks. The `gcs` station (255/190) sits on a link in mode "gcs",
`api` (245/190) on one in mode "onboard"; both send a ground station's HEARTBEAT twice a second. Messages travel in the
form of the recordings, `{"name": ..., "fields": {...}}`; `to_wire` and `from_wire` say what that means for values.
"""

from __future__ import annotations

import math
import shutil
import struct
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from bridge.connection import Connection, Message
from bridge.link import MemoryLink
from bridge.messages import BY_NAME
from bridge.services import VehicleFiles
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

Json = dict[str, Any]

UTC_BOOT_US = 1_800_000_000_000_000
HOLD, OFFBOARD = 4 << 16 | 3 << 24, 6 << 16
"""custom_mode numbers."""

HEARTBEAT_ID, AUTOPILOT = 0, 1
ARMED = 128
IN_AIR = 2
READY = 0x10000000  # SYS_STATUS health: MAV_SYS_STATUS_PREARM_CHECK

_HEARTBEAT: Json = {"name": "HEARTBEAT", "fields": {"type": 6, "autopilot": 8, "system_status": 4}}
_DEFAULTS = {"q": (1.0, 0.0, 0.0, 0.0), "mavlink_version": 3}
_SPECIAL = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}

_FTP = struct.Struct("<HBBBBBBI")
_FTP_KEYS = ("seq", "session", "opcode", "size", "req_opcode", "burst_complete", "padding", "offset")
_FTP_ACK, _FTP_NAK = 128, 129
_FTP_NUMBER_OPS = (4, 6, 11, 14)  # open for reading, create, open for writing, checksum


def to_wire(message: Json, named: dict[str, bytes]) -> Json:
    """Fields to encode for a recorded request; `named` holds what {"$": name} stands for."""
    fields = {key: value for key, value in _DEFAULTS.items() if key in _names(message["name"])}
    for key, value in message.get("fields", {}).items():
        fields[key] = _ftp_bytes(value) if key == "payload" else _value(value, named, message["name"], key)
    return fields


def from_wire(message: Message) -> Json:
    """A received message in the form of the recordings: 7 digits, NaN as text, trailing zeros of lists cut off."""
    fields = message.fields()
    if message.name in ("PARAM_VALUE", "PARAM_SET") and message.param_type in (1, 2, 3, 4, 5, 6):
        signed = message.param_type != 5
        number = int.from_bytes(message.raw("param_value"), "little", signed=signed)
        fields["param_value"] = {"i32" if signed else "u32": number}
    elif message.name == "FILE_TRANSFER_PROTOCOL":
        fields["payload"] = _ftp_fields(message.payload)
    elif message.name == "LOG_DATA":
        fields["data"] = "hex:" + bytes(message.data[: message.count]).hex()
    return {key: _plain(value) for key, value in fields.items()}


def _names(message: str) -> set[str]:
    return {field.name for field in BY_NAME[message].fields}


def _value(value: Any, named: dict[str, bytes], message: str, key: str) -> Any:
    if isinstance(value, dict):
        ((kind, content),) = value.items()
        return named[content] if kind == "$" else struct.pack("<i" if kind == "i32" else "<I", content)
    kind = next(field for field in BY_NAME[message].fields if field.name == key)
    if isinstance(value, str):
        return value.encode("latin1")[: kind.size] if kind.type == "char" else _SPECIAL[value]
    return [_SPECIAL.get(one, one) for one in value] if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        if math.isfinite(value):
            return float(f"{value:.7g}")
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, (tuple, bytes)):
        whole = [_plain(one) for one in value]
        while len(value) > 4 and whole and whole[-1] == 0 and isinstance(whole[-1], int):
            whole.pop()
        return whole
    return value


def _ftp_bytes(fields: Json) -> bytes:
    text = fields.get("data", "")
    data = bytes.fromhex(text[4:]) if text.startswith("hex:") else text.encode("latin1")
    header = {**dict.fromkeys(_FTP_KEYS, 0), "size": len(data), **{k: fields[k] for k in _FTP_KEYS if k in fields}}
    return _FTP.pack(*(header[key] for key in _FTP_KEYS)) + data[:239]


def _ftp_fields(payload: bytes) -> Json:
    fields: Json = dict(zip(_FTP_KEYS, _FTP.unpack(payload[:12]), strict=True))
    del fields["padding"]
    data = payload[12 : 12 + min(fields["size"], 239)]
    if fields["opcode"] == _FTP_ACK and fields["req_opcode"] in _FTP_NUMBER_OPS and fields["size"] == 4:
        fields["data_u32"] = int.from_bytes(data, "little")
    elif fields["opcode"] == _FTP_NAK:
        fields["error"], fields["errno"] = (data[k] if len(data) > k else None for k in (0, 1))
    else:
        printable = all(32 <= byte < 127 or byte in b"\0\t\n" for byte in data)
        fields["data"] = data.decode("latin1") if printable else "hex:" + data.hex()
    return fields


class Station:
    """Who asks, on one link.

    Attributes:
        heard: (vehicle time in us, step, message) of the messages in `keep`.
        counts: how many of every message came, by message id.
        first_us: vehicle time of the first of every message, by message id.
        step: a number that goes with what is heard from now on.
    """

    def __init__(self, end: MemoryLink, sysid: int) -> None:
        self._end = end
        self._connection = Connection(sysid, 190, datagram=True)
        self._last: dict[int, tuple[int, bytes]] = {}
        self._keep: frozenset[int] = frozenset()
        self.heard: list[tuple[int, int, Message]] = []
        self.counts: Counter[int] = Counter()
        self.first_us: dict[int, int] = {}
        self.step = 0

    def keep(self, names: Iterable[str]) -> None:
        """Forget what was heard; from now on these messages are kept, of all others the last one."""
        self._keep = frozenset(BY_NAME[name].id for name in names if name in BY_NAME)
        self.heard = []

    def send(self, message: Json, named: dict[str, bytes]) -> None:
        self._end.send(self._connection.encode_fields(message["name"], to_wire(message, named)))

    def listen(self, now_us: int) -> None:
        """Read what the vehicle sent; only what is kept is decoded, which is what makes this quick."""
        while (data := self._end.recv()) is not None:
            while data:
                frame, data = data[: data[1] + 12], data[data[1] + 12 :]
                number = int.from_bytes(frame[7:10], "little")
                if number == HEARTBEAT_ID and frame[6] != AUTOPILOT:
                    continue  # the other station's, passed on
                self.counts[number] += 1
                self.first_us.setdefault(number, now_us)
                self._last[number] = (now_us, frame)
                if number in self._keep:
                    self.heard += [(now_us, self.step, one) for one in self._connection.receive(frame)]

    def last(self, name: str) -> tuple[int, Message] | None:
        """The last message of a name and the vehicle time it came, us."""
        at = self._last.get(BY_NAME[name].id)
        if at is None:
            return None
        (message,) = self._connection.receive(at[1])
        return at[0], message

    def last_field(self, name: str, field: str) -> Any:
        """A field of the last message of a name, None if there was none."""
        found = self.last(name)
        return None if found is None else found[1].get(field)


class NotReached(AssertionError):
    """The vehicle does not come into the state that a case begins in."""


class Rig:
    """A vehicle just started, its server and the two stations.

    Attributes:
        heartbeats: whether the stations send theirs.
        stream: what is sent again and again, as the recordings' `stream`; {"hold": True} keeps 20 m in Offboard.

    Args:
        logs: it writes logs. Most cases neither ask for them nor tell of them, and it takes a quarter of their time.
    """

    def __init__(self, *, logs: bool) -> None:
        self.vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
        near_gcs, far_gcs = MemoryLink.pair()
        near_api, far_api = MemoryLink.pair()
        links = [
            ServerLink(near_gcs, Connection(1, 1, datagram=True), 0, "gcs"),
            ServerLink(near_api, Connection(1, 1, datagram=True), 1, "onboard"),
        ]
        files = VehicleFiles()
        if logs:
            folder = tempfile.mkdtemp()
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            files = VehicleFiles(logs=Path(folder))
        self.server = VehicleServer(self.vehicle, links, utc_boot_us=UTC_BOOT_US, strict=True, files=files)
        self.gcs, self.api = Station(far_gcs, 255), Station(far_api, 245)
        self.heartbeats = True
        self.stream: Json | None = None
        self.hash = bytes(4)
        self._heartbeat_us = self._stream_us = 0

    @property
    def now_us(self) -> int:
        return self.vehicle.time_us

    def station(self, name: str | None) -> Station:
        return self.api if name == "api" else self.gcs

    def send(self, station: Station, message: Json) -> None:
        station.send(message, {"hash": self.hash, "now_us": (UTC_BOOT_US + self.now_us).to_bytes(8, "little")})

    def tick(self) -> None:
        """One tick of the vehicle, with what the stations send before it and hear after it."""
        now_us = self.now_us
        if self.heartbeats and now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + 500_000
            self.send(self.gcs, _HEARTBEAT)
            self.send(self.api, _HEARTBEAT)
        if self.stream is not None and now_us >= self._stream_us:
            self._stream_us = max(self._stream_us + round(1e6 / self.stream.get("hz", 20)), now_us)
            station = self.gcs if self.stream.get("link") == "gcs" else self.api
            for message in [self._hold()] if self.stream.get("hold") else self.stream["msgs"]:
                self.send(station, message)
        self.server.step()
        self.gcs.listen(self.now_us)
        self.api.listen(self.now_us)

    def run(self, seconds: float) -> None:
        end_us = self.now_us + round(seconds * 1e6)
        while self.now_us < end_us:
            self.tick()

    def run_until(self, reached: Callable[[], object], timeout_s: float, what: str) -> None:
        end_us = self.now_us + round(timeout_s * 1e6)
        while not reached():
            if self.now_us >= end_us:
                raise NotReached(f"not within {timeout_s} s: {what}")
            self.tick()

    def command(self, number: int, *params: float | str) -> None:
        """Send a COMMAND_LONG from the ground station; it must be accepted."""
        fields = {f"param{index}": value for index, value in enumerate(params, start=1)}
        fields |= {"target_system": 1, "target_component": 1, "command": number}
        self.gcs.keep(["COMMAND_ACK"])
        self.send(self.gcs, {"name": "COMMAND_LONG", "fields": fields})
        self.run_until(lambda: self.gcs.heard, 1.5, f"COMMAND_ACK {number}")
        ack = self.gcs.heard[-1][2]
        if ack.command != number or ack.result != 0:
            raise NotReached(f"command {number}: acknowledged {ack.command} with result {ack.result}")

    def state(self) -> Json:
        """base_mode, custom_mode and system_status of the last HEARTBEAT on the ground station's link."""
        return {key: self.gcs.last_field("HEARTBEAT", key) for key in ("base_mode", "custom_mode", "system_status")}

    def prepare(self, state: str) -> None:
        """Come from just started into the state a case begins in.

        Raises:
            NotReached: the vehicle does not get there.
        """
        self.run_until(lambda: self.gcs.last("HEARTBEAT"), 5.0, "the first HEARTBEAT")
        if state == "boot":
            return
        self.run(4.0)
        self.run_until(self._ready, 20.0, "ready to arm in Hold")
        if state in ("ground", "nolog"):
            return
        self.command(400, 1)
        if state == "logged":
            self.run(1.5)
            self.command(400, 0)
            self.run(2.0)
            return
        self.run_until(self._armed, 2.5, "armed")
        if state == "armed":
            return
        self.command(22, 0, 0, 0, "NaN", "NaN", "NaN", self.vehicle.origin[2] + 12.0)
        self.run_until(self._hovers, 40.0, "hovering in Hold above 11 m")
        self.run(1.5)
        if state == "offboard":
            self.stream = {"hold": True}
            self.run(0.5)
            self.command(176, 1, 6)
            self.run_until(lambda: self.state()["custom_mode"] == OFFBOARD, 2.5, "Offboard")
            self.run_until(lambda: abs(self._height_m() - 20.0) < 3.0, 15.0, "a height of 20 m")

    def learn_hash(self) -> None:
        """Ask for the hash of all parameters."""
        self.gcs.keep(["PARAM_VALUE"])
        fields = {"target_system": 1, "target_component": 1, "param_id": "_HASH_CHECK", "param_index": -1}
        self.send(self.gcs, {"name": "PARAM_REQUEST_READ", "fields": fields})
        self.run_until(lambda: self.gcs.heard, 1.0, "_HASH_CHECK")
        self.hash = self.gcs.heard[-1][2].raw("param_value")

    def _ready(self) -> bool:
        health = self.gcs.last_field("SYS_STATUS", "onboard_control_sensors_health") or 0
        return bool(health & READY) and self.state() == {"base_mode": 29, "custom_mode": HOLD, "system_status": 3}

    def _armed(self) -> bool:
        return bool(self.state()["base_mode"] & ARMED)

    def _hovers(self) -> bool:
        in_air = self.gcs.last_field("EXTENDED_SYS_STATE", "landed_state") == IN_AIR
        return in_air and self._height_m() > 11.0 and self.state()["custom_mode"] == HOLD

    def _height_m(self) -> float:
        return -float(self.gcs.last_field("LOCAL_POSITION_NED", "z") or 0.0)

    def _hold(self) -> Json:
        """The set-point that keeps the vehicle level and near 20 m."""
        down, speed = (self.gcs.last_field("LOCAL_POSITION_NED", key) or 0.0 for key in ("z", "vz"))
        lift = min(0.12, max(-0.12, 0.03 * (down + 20.0) + 0.08 * speed))
        thrust = self.vehicle.model.assumptions.hover_thrust + lift
        fields = {"target_system": 1, "target_component": 1, "type_mask": 7, "thrust": thrust}
        return {"name": "SET_ATTITUDE_TARGET", "fields": fields}
