"""MAVProxy and pymavlink against a vehicle with a signing key."""

from __future__ import annotations

import hashlib
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mavproxy_console import Console
from mavutil_script import INT32, REAL32, Script, open_station
from vehicle_process import VehicleProcess

pytestmark = pytest.mark.client

PASSPHRASE = "tell-nobody"
KEY = hashlib.sha256(PASSPHRASE.encode()).digest()
SIGNED = 0x01


def key_file(path: Path, secret: bytes) -> str:
    """Write a key file for its owner's eyes only and return its name."""
    path.touch(mode=0o600)
    path.write_bytes(secret)
    return str(path)


def timestamp() -> int:
    """Now, as signatures count it: 10 us since 2015."""
    return int((time.time_ns() / 1e9 - 1_420_070_400) * 1e5)


@pytest.fixture
def guarded(sitl: Callable[..., VehicleProcess], tmp_path: Path) -> VehicleProcess:
    return sitl("--signing-key", key_file(tmp_path / "signing.key", KEY), mode="gcs")


def signed(message: Any) -> bool:
    return bool(message.get_header().incompat_flags & SIGNED)


def test_pymavlink_with_and_without_the_key(guarded: VehicleProcess) -> None:
    station = open_station(guarded.port)
    try:
        one = Script(station)
        # What the vehicle sends is signed; whoever has no key can read it all the same.
        assert signed(one.until(lambda m: m.get_srcComponent() == 1, "HEARTBEAT"))
        station.setup_signing(KEY, sign_outgoing=True, initial_timestamp=timestamp())
        assert one.command(511, 30, 20_000) == 0
        assert one.parameter("MC_ROLL_P").param_value > 0
        station.param_set_send("MAV_SIGN_CFG", _as_float(2), parm_type=INT32)
        one.until(lambda m: m.param_id == "MAV_SIGN_CFG", "PARAM_VALUE")

        # Now only signed messages are obeyed: with another key, or none, nothing is.
        station.disable_signing()
        _send_gain(station, 9.0)
        station.setup_signing(b"\x01" * 32, sign_outgoing=True, initial_timestamp=timestamp())
        _send_gain(station, 9.5)
        station.setup_signing(KEY, sign_outgoing=True, initial_timestamp=timestamp())
        assert one.parameter("MC_ROLL_P").param_value < 9.0
        _send_gain(station, 7.0)
        one.until(lambda m: m.param_id == "MC_ROLL_P" and m.param_value == 7.0, "PARAM_VALUE")
    finally:
        station.close()
    guarded.stop()


def _send_gain(station: Any, value: float) -> None:
    station.param_set_send("MC_ROLL_P", value, parm_type=REAL32)


def _as_float(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def test_mavproxy_with_the_key(guarded: VehicleProcess, tmp_path: Path) -> None:
    (tmp_path / ".mavproxy").mkdir()
    (tmp_path / ".mavproxy" / "signing.keys").write_text(f"udpin:127.0.0.1:{guarded.port} {PASSPHRASE}\n")
    with Console(guarded.port, tmp_path) as mavproxy:
        mavproxy.parameters()
        mavproxy.say("set allow_unsigned False")
        mavproxy.say("param fetch MC_ROLL_P")
        mavproxy.until(r"MC_ROLL_P = ")
    guarded.stop()


def test_mavproxy_gives_the_vehicle_a_key(sitl: Callable[..., VehicleProcess], tmp_path: Path) -> None:
    path = tmp_path / "signing.key"
    vehicle = sitl("--signing-key", key_file(path, b""), mode="gcs")
    with Console(vehicle.port, tmp_path) as mavproxy:
        mavproxy.parameters()
        mavproxy.say(f"signing setup {PASSPHRASE}")
        mavproxy.until(r"Sent secret_key")
        mavproxy.until(r"Setup signing key")
        mavproxy.say("set allow_unsigned False")
        mavproxy.say("param set MC_ROLL_P 7.5")
        assert mavproxy.fetched("MC_ROLL_P", "7.5")
        mavproxy.say("signing remove")
        mavproxy.until(r"Removed signing")
        mavproxy.say("set allow_unsigned True")
        mavproxy.say("param set MC_ROLL_P 6.5")
        assert mavproxy.fetched("MC_ROLL_P", "6.5")
    vehicle.stop()
