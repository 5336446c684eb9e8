"""What a process and those that it started have opened to the network, as the kernel tells it."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import NamedTuple

TABLES = ("tcp", "tcp6", "udp", "udp6")
_LISTENS, _UNCONNECTED = "0A", "07"


class Opened(NamedTuple):
    """A socket that others can speak to.

    Attributes:
        kind: tcp or udp. host, port: where.
    """

    kind: str
    host: str
    port: int

    @property
    def loopback(self) -> bool:
        return ipaddress.ip_address(self.host).is_loopback


def family(pid: int) -> list[int]:
    """A process and its descendants, those that live."""
    parents: dict[int, list[int]] = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(words[1]), []).append(int(place.name))
    found = [pid]
    for one in found:
        found += parents.get(one, [])
    return found


def opened(pid: int) -> set[Opened]:
    """TCP sockets that listen and UDP sockets that are bound, of a process and its descendants."""
    found = set()
    for one in family(pid):
        inodes = _inodes(one)
        for table in TABLES if inodes else ():
            try:
                lines = Path(f"/proc/{one}/net/{table}").read_text().splitlines()[1:]
            except OSError:
                continue
            for line in lines:
                words = line.split()
                if words[9] in inodes and words[3] == (_LISTENS if table.startswith("tcp") else _UNCONNECTED):
                    host, _, port = words[1].rpartition(":")
                    if int(port, 16):
                        found.add(Opened(table[:3], _address(host), int(port, 16)))
    return found


def _inodes(pid: int) -> set[str]:
    found = set()
    try:
        for one in Path(f"/proc/{pid}/fd").iterdir():
            try:
                target = str(one.readlink())
            except OSError:
                continue
            if target.startswith("socket:["):
                found.add(target[8:-1])
    except OSError:
        return set()
    return found


def _address(text: str) -> str:
    """The kernel writes addresses in words of four bytes, each the wrong way round."""
    raw = bytes.fromhex(text)
    packed = b"".join(raw[start : start + 4][::-1] for start in range(0, len(raw), 4))
    address = ipaddress.ip_address(packed)
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)
