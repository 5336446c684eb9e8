"""What a vehicle without missions, files and logs answers, so that no ground station waits for them.

Lists are empty, uploads are refused, files are not found: MAVLink's mission, FTP and log services, each with
the shortest honest answer. A service that comes to exist takes its message names from here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bridge.vehicle_server import ServerLink, VehicleServer

_MISSION_ACCEPTED, _MISSION_ERROR, _MISSION_UNSUPPORTED = 0, 1, 3
_MISSION_PLANNER = 190  # MAV_COMP_ID_MISSIONPLANNER: PX4's mission service answers to it too
_PLAN_KINDS = 3  # mission, geofence, rally points

_FTP_HEADER = struct.Struct("<HBBBBBBI")
_FTP_TERMINATE, _FTP_RESET, _FTP_LAST = 1, 2, 15
_FTP_ACK, _FTP_NAK = 128, 129
_FTP_NO_SESSION, _FTP_UNKNOWN, _FTP_NOT_FOUND = 4, 7, 10


class AbsentServices:
    """Answers for the services this vehicle does not have.

    Args:
        server: the vehicle's face.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server

    def handlers(self) -> dict[str, Callable[[ServerLink, Any], None]]:
        """Return the handler of each message these services answer."""
        return {
            "MISSION_REQUEST_LIST": self._mission_list,
            "MISSION_CLEAR_ALL": self._mission_clear,
            "MISSION_COUNT": self._mission_upload,
            "MISSION_REQUEST": self._mission_item,
            "MISSION_REQUEST_INT": self._mission_item,
            "MISSION_ITEM": self._mission_item,
            "MISSION_ITEM_INT": self._mission_item,
            "FILE_TRANSFER_PROTOCOL": self._file,
            "LOG_REQUEST_LIST": self._log_list,
        }

    def _mission_list(self, link: ServerLink, msg: Any) -> None:
        """An empty plan of the kind asked for."""
        if self._plans_for_us(msg):
            self._answer(link, msg, "MISSION_COUNT", count=0, mission_type=msg.mission_type)

    def _mission_clear(self, link: ServerLink, msg: Any) -> None:
        """It is empty already."""
        self._acknowledge(link, msg, _MISSION_ACCEPTED)

    def _mission_upload(self, link: ServerLink, msg: Any) -> None:
        """An empty plan can be kept; one with items cannot."""
        self._acknowledge(link, msg, _MISSION_UNSUPPORTED if msg.count else _MISSION_ACCEPTED)

    def _mission_item(self, link: ServerLink, msg: Any) -> None:
        """There is no transfer an item could belong to."""
        self._acknowledge(link, msg, _MISSION_ERROR)

    def _acknowledge(self, link: ServerLink, msg: Any, kind: int) -> None:
        if self._plans_for_us(msg):
            self._answer(link, msg, "MISSION_ACK", type=kind, mission_type=msg.mission_type)

    def _plans_for_us(self, msg: Any) -> bool:
        server = self._server
        return msg.target_system in (0, server.sysid) and msg.target_component in (
            0,
            server.compid,
            _MISSION_PLANNER,
        )

    def _file(self, link: ServerLink, msg: Any) -> None:
        """NAK "not found" at once: who looks for a parameter file here then asks for the list at once."""
        if not self._server.is_for_us(msg):
            return
        seq, session, opcode, _, _, _, _, offset = _FTP_HEADER.unpack(bytes(msg.payload)[: _FTP_HEADER.size])
        if opcode == _FTP_RESET:
            reply, error = _FTP_ACK, b""
        elif opcode == _FTP_TERMINATE:
            reply, error = _FTP_NAK, bytes([_FTP_NO_SESSION])
        else:
            known = 0 < opcode <= _FTP_LAST
            reply, error = _FTP_NAK, bytes([_FTP_NOT_FOUND if known else _FTP_UNKNOWN])
        header = _FTP_HEADER.pack(seq + 1 & 0xFFFF, session, reply, len(error), opcode, 0, 0, offset)
        self._answer(link, msg, "FILE_TRANSFER_PROTOCOL", payload=header + error)

    def _log_list(self, link: ServerLink, msg: Any) -> None:
        """One entry that says there are none; a PX4 stays silent and ground stations wait for a time-out."""
        if msg.target_system in (0, self._server.sysid):
            link.send("LOG_ENTRY", {"num_logs": 0, "last_log_num": 0})

    def _answer(self, link: ServerLink, msg: Any, name: str, **fields: Any) -> None:
        link.send(name, {"target_system": msg.sysid, "target_component": msg.compid, **fields})
