"""What a vehicle keeps and serves, through its server: parameters and logs on disk, metadata, signing."""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pyulog import ULog

from bridge.connection import Connection
from bridge.event_list import events_json
from bridge.key_file import load_key, save_key
from bridge.link import MemoryLink
from bridge.services import VehicleFiles
from bridge.signing import Signer, SigningKey
from bridge.sitl_server import SitlOptions, build_vehicle, close_links, close_vehicle
from bridge.vehicle_server import ServerLink, VehicleServer
from sitl.errors import FileError
from sitl.modes import Severity
from sitl.profile import get_profile
from sitl.vehicle import Vehicle
from sitl.vehicle_spec import resolve_vehicle

US = {"target_system": 1, "target_component": 1}
UTC_US = 1_795_387_540_000_000
SECRET = bytes(range(32))
OPEN, READ, CRC, TERMINATE, ACK, NAK = 4, 5, 14, 1, 128, 129


@pytest.fixture
def boot(flight: Any) -> Callable[..., Any]:
    """A vehicle that keeps files, some seconds after it started."""

    def start(seconds: float = 2.2, *modes: str, utc_boot_us: int = 0, **files: Path) -> Any:
        one = flight(*modes, files=VehicleFiles(**files), utc_boot_us=utc_boot_us)
        one.run(seconds)
        return one

    return start


def set_parameter(one: Any, name: str, value: float) -> None:
    answers = one.ask("PARAM_SET", only=("PARAM_VALUE",), **US, param_id=name, param_value=value, param_type=9)
    assert {answer.param_value for answer in answers} == {value}  # at once, and as everybody is told


class Ftp:
    """A ground station that reads files, one request after the other."""

    def __init__(self, one: Any) -> None:
        self.one = one
        self.seq = 0

    def ask(self, opcode: int, data: bytes = b"", *, size: int | None = None, offset: int = 0) -> tuple[int, bytes]:
        self.seq += 1
        header = struct.pack("<HBBBBBBI", self.seq, 0, opcode, len(data) if size is None else size, 0, 0, 0, offset)
        (answer,) = self.one.ask(
            "FILE_TRANSFER_PROTOCOL", only=("FILE_TRANSFER_PROTOCOL",), wait_s=0.012, **US, payload=header + data
        )
        code, length = answer.payload[3], answer.payload[4]
        return code, answer.payload[12 : 12 + length]

    def fetch(self, path: str) -> tuple[bytes, int]:
        """Content of a file, and what the vehicle says its CRC is."""
        code, data = self.ask(OPEN, path.encode())
        assert code == ACK, path
        size, content = struct.unpack("<I", data)[0], b""
        while len(content) < size:
            code, data = self.ask(READ, size=239, offset=len(content))
            assert code == ACK
            content += data
        assert self.ask(TERMINATE)[0] == ACK
        code, data = self.ask(CRC, path.encode())
        assert code == ACK
        return content, struct.unpack("<I", data)[0]


def crc(data: bytes) -> int:
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


class TestParameters:
    def test_survive_a_restart(self, boot: Any, tmp_path: Path) -> None:
        path = tmp_path / "vehicle.params"
        one = boot(parameters=path)
        set_parameter(one, "MC_ROLL_P", 7.25)
        one.run(1.0)
        assert "MC_ROLL_P\t7.25" in path.read_text()  # before the end: it may never come
        one.server.close()
        again = boot(0.1, parameters=path)
        assert again.vehicle.parameters.get("MC_ROLL_P") == 7.25
        assert again.autopilot.parameters.get("MC_ROLL_P") == 7.25

    def test_the_last_change_is_written_at_the_end(self, boot: Any, tmp_path: Path) -> None:
        path = tmp_path / "vehicle.params"
        one = boot(parameters=path)
        set_parameter(one, "MC_ROLL_P", 7.25)
        assert not path.exists()
        one.server.close()
        assert "MC_ROLL_P\t7.25" in path.read_text()

    def test_nothing_changed_nothing_written(self, boot: Any, tmp_path: Path) -> None:
        boot(parameters=tmp_path / "vehicle.params").server.close()
        assert list(tmp_path.iterdir()) == []

    def test_a_system_id_is_the_instance_s_and_not_the_file_s(self, tmp_path: Path) -> None:
        path = tmp_path / "vehicle.params"
        path.write_text("7\t1\tMAV_SYS_ID\t7\t6\n7\t1\tMC_ROLL_P\t7.25\t9\n")
        for instance in (0, 1):
            links = (f"udpout://127.0.0.1:{19_000 + instance}",)
            server = build_vehicle("ant-x", instance, SitlOptions(state=path, links=links))
            try:
                assert server.sysid == instance + 1
                assert server.vehicle.parameters.get("MAV_SYS_ID") == instance + 1
                assert server.vehicle.parameters.get("MC_ROLL_P") == 7.25
                server.vehicle.parameters.set("MC_PITCH_P", 7.0 + instance)
            finally:
                close_vehicle(server)
                close_links(server.links)
            assert "MAV_SYS_ID" not in path.read_text()
            assert {"MC_ROLL_P", "MC_PITCH_P"} <= set(path.read_text().split())

    def test_a_damaged_file_is_refused_before_the_vehicle_is_there(self, boot: Any, tmp_path: Path) -> None:
        path = tmp_path / "vehicle.params"
        path.write_text("MC_ROLL_P = 7.25\n")
        with pytest.raises(FileError, match="line 1"):
            boot(parameters=path)
        assert path.read_text() == "MC_ROLL_P = 7.25\n"

    def test_what_the_vehicle_does_not_have_is_told_and_kept(self, boot: Any, tmp_path: Path) -> None:
        path = tmp_path / "vehicle.params"
        path.write_text("1\t1\tFW_THR_TRIM\t0.5\t9\n")
        one = boot(0.3, parameters=path)
        assert any("FW_THR_TRIM is no parameter of this vehicle" in text for text in one.ground.texts())
        one.vehicle.parameters.set("MC_ROLL_P", 7.25)
        one.server.close()
        assert {"FW_THR_TRIM", "MC_ROLL_P"} <= set(path.read_text().split())

    def test_values_that_contradict_each_other_are_corrected_and_kept(self, boot: Any, tmp_path: Path) -> None:
        path = tmp_path / "vehicle.params"
        one = boot(parameters=path)
        set_parameter(one, "MPC_XY_CRUISE", 50.0)
        one.run(1.5)
        assert one.vehicle.parameters.get("MPC_XY_CRUISE") == one.vehicle.parameters.get("MPC_XY_VEL_MAX")
        assert "Cruise speed has been constrained by max speed\t" in one.ground.texts()
        one.server.close()
        assert "MPC_XY_CRUISE\t12\t" in path.read_text()


class TestLogs:
    def test_begin_at_boot_and_are_complete_at_the_end(self, boot: Any, tmp_path: Path) -> None:
        one = boot(logs=tmp_path, utc_boot_us=UTC_US)
        (path,) = tmp_path.rglob("*.ulg")
        assert path.relative_to(tmp_path).as_posix() == "2026-11-22/22_45_40.ulg"
        one.server.say(Severity.INFO, "Takeoff detected\t")
        one.server.close()
        log = ULog(str(path))
        assert not log.file_corruption
        assert log.last_timestamp >= 2_190_000
        texts = [message.message for message in log.logged_messages]
        assert "Preflight Fail: heading estimate invalid" in texts
        assert "Takeoff detected" in texts
        assert one.server.services.log.path is None

    def test_from_arming_on_with_sdlog_mode_0(self, boot: Any, tmp_path: Path) -> None:
        state, logs = tmp_path / "vehicle.params", tmp_path / "logs"
        state.write_text("1\t1\tSDLOG_MODE\t0\t6\n")
        one = boot(logs=logs, parameters=state)
        assert not logs.exists()
        assert one.result(400, 1) == 0
        assert len(list(logs.rglob("*.ulg"))) == 1
        assert one.server.services.log.path is not None

    def test_are_listed_and_downloaded_bit_by_bit(self, boot: Any, tmp_path: Path) -> None:
        folder = tmp_path / "sess001"
        folder.mkdir()
        content = bytes(k * 7 & 0xFF for k in range(4321))
        (folder / "log100.ulg").write_bytes(content)
        one = boot(logs=tmp_path)
        entries = one.ask("LOG_REQUEST_LIST", only=("LOG_ENTRY",), **US, end=0xFFFF)
        assert [(entry["id"], entry.num_logs) for entry in entries] == [(0, 2), (1, 2)]
        assert entries[0].size == len(content)
        assert entries[1].size > 1000
        one.forget()
        one.ground.send("LOG_REQUEST_DATA", **US, id=0, ofs=0, count=0xFFFFFFFF)
        one.run(0.2)
        loaded = b"".join(part.data[: part.count] for part in one.ground.named("LOG_DATA"))
        assert loaded == content
        fetched, said = Ftp(one).fetch("/fs/microsd/log/sess001/log100.ulg")
        assert (fetched, said) == (content, crc(content))

    def test_the_one_being_written_outlives_an_erasure(self, boot: Any, tmp_path: Path) -> None:
        one = boot(logs=tmp_path)
        one.server.close()
        again = boot(logs=tmp_path)
        assert len(list(tmp_path.rglob("*.ulg"))) == 2
        again.ask("LOG_ERASE", **US)
        assert list(tmp_path.rglob("*.ulg")) == [again.server.services.log.path]
        again.server.close()
        assert not ULog(str(next(tmp_path.rglob("*.ulg")))).file_corruption

    def test_the_sticks_are_in_it(self, boot: Any, tmp_path: Path) -> None:
        one = boot(logs=tmp_path)
        one.run(0.5, one.at_20_hz(lambda: one.ground.send("MANUAL_CONTROL", target=1, y=500, z=750)))
        one.server.close()
        log = ULog(str(next(tmp_path.rglob("*.ulg"))))
        sticks = log.get_dataset("manual_control_setpoint").data
        assert sticks["roll"].max() == pytest.approx(0.5)
        assert sticks["throttle"].max() == pytest.approx(0.5)

    def test_without_a_folder_there_are_none(self, on_ground: Any) -> None:
        assert on_ground.server.services.log is None
        on_ground.server.close()


class TestMetadata:
    @pytest.mark.parametrize(("message_id", "name"), [(397, "COMPONENT_METADATA"), (395, "COMPONENT_INFORMATION")])
    def test_is_found_and_fetched(self, on_ground: Any, message_id: int, name: str) -> None:
        (where,) = [one for one in on_ground.command(512, message_id) if one.name == name]
        if message_id == 397:
            uri, checksum = where.uri, where.file_crc
        else:
            uri, checksum = where.general_metadata_uri, where.general_metadata_file_crc
        ftp = Ftp(on_ground)
        general, said = ftp.fetch(uri.removeprefix("mftp://"))
        assert crc(general) == said == checksum
        types = {one["type"]: one for one in json.loads(lzma.decompress(general))["metadataTypes"]}
        assert set(types) == {1, 4}
        for kind in types.values():
            path = kind["uri"].removeprefix("mftp://")
            code, data = ftp.ask(CRC, path.encode())
            assert (code, struct.unpack("<I", data)[0]) == (ACK, kind["fileCrc"])
        events, said = ftp.fetch(types[4]["uri"].removeprefix("mftp://"))
        assert crc(events) == said == types[4]["fileCrc"]
        assert lzma.decompress(events) == events_json()

    def test_of_two_vehicles_is_the_same(self, flight: Any) -> None:
        assert flight().server.services.metadata.general_crc == flight().server.services.metadata.general_crc


class TestSigning:
    @pytest.fixture
    def key_file(self, tmp_path: Path) -> Path:
        path = tmp_path / "key"
        save_key(path, SigningKey(SECRET, 1000))
        return path

    def test_with_a_key_only_signed_messages_count(self, boot: Any, key_file: Path) -> None:
        one = boot(0.5, signing_key=key_file)
        assert one.vehicle.parameters.get("MAV_SIGN_CFG") == 2
        assert not one.server.hears_gcs()
        assert one.command(512, 300) == []
        assert all(message.signed for _, message in one.ground.heard)
        one.ground.connection.signer = Signer(SigningKey(SECRET, 10**12), 3)
        assert [answer.name for answer in one.command(512, 300)] == ["PROTOCOL_VERSION", "COMMAND_ACK"]
        one.run(1.0)
        assert one.server.hears_gcs()

    def test_a_key_set_over_the_wire_is_kept_for_the_next_time(self, boot: Any, tmp_path: Path) -> None:
        path = tmp_path / "key"
        one = boot(signing_key=path)
        assert one.ask("SETUP_SIGNING", **US, secret_key=SECRET, initial_timestamp=10**12) == []
        assert "MAVLink signing key set" in one.ground.texts()
        assert load_key(path).secret == SECRET
        one.server.close()
        again = boot(0.5, signing_key=path)
        assert again.command(512, 300) == []

    def test_time_goes_on_where_it_ended(self, boot: Any, key_file: Path) -> None:
        before = load_key(key_file).timestamp
        one = boot(signing_key=key_file)
        one.server.close()
        assert load_key(key_file).timestamp > before

    def test_the_user_s_choice_of_what_is_refused_counts(self, boot: Any, key_file: Path, tmp_path: Path) -> None:
        state = tmp_path / "vehicle.params"
        state.write_text("1\t1\tMAV_SIGN_CFG\t1\t6\n")
        one = boot(0.1, signing_key=key_file, parameters=state)
        assert one.vehicle.parameters.get("MAV_SIGN_CFG") == 1

    def test_without_a_key_nothing_is_signed(self, on_ground: Any) -> None:
        on_ground.run(1.0)
        assert on_ground.ground.named("HEARTBEAT")
        assert not any(message.signed for _, message in on_ground.ground.heard)


class TestAll:
    def test_what_is_on_disk_in_the_end(self, boot: Any, tmp_path: Path) -> None:
        files = {"logs": tmp_path / "logs", "parameters": tmp_path / "vehicle.params", "signing_key": tmp_path / "key"}
        save_key(files["signing_key"], SigningKey(SECRET, 1000))
        one = boot(signing_key=files["signing_key"], logs=files["logs"], parameters=files["parameters"])
        one.vehicle.parameters.set("MC_ROLL_P", 7.25)
        one.server.close()
        found = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
        assert found == {"key", "vehicle.params", "logs/sess001/log100.ulg"}
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        one.server.close()  # twice does no harm
        assert {path: path.read_bytes() for path in before} == before

    def test_refusals_of_services_count(self, on_ground: Any) -> None:
        before = on_ground.server.refused
        on_ground.ask("REQUEST_EVENT", **US, first_sequence=5, last_sequence=4)
        assert on_ground.server.refused == before + 1

    def test_a_link_whose_peer_is_gone_is_forgotten_by_all(self, monkeypatch: pytest.MonkeyPatch) -> None:
        near, far = MemoryLink.pair()
        vehicle = Vehicle(resolve_vehicle("ant-x"), get_profile("sitl"))
        server = VehicleServer(vehicle, [ServerLink(near, Connection(1, 1, datagram=True), 5, "gcs")], strict=True)
        forgotten: list[int] = []
        for service in server.services.all:
            monkeypatch.setattr(service, "forget", forgotten.append)
        far.close()
        for _ in range(5):
            server.step()
        assert forgotten == [5] * len(server.services.all)
