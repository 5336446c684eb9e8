"""Where simulated vehicles are reached: PX4's ports, a user's own addresses, and who else can reach them.

    urls = link_urls(instance=2, bind="127.0.0.1", given=())
    links = open_links(urls, instance=2)

Instance i is system i + 1 and speaks from PX4's ports: to the ground station at 127.0.0.1:14550 from
18570 + i and to programs (MAVSDK) at 127.0.0.1:14540 + i (14549 at most) from 14580 + i.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from typing import get_args

from bridge.connection import Connection
from bridge.errors import LinkUrlError, PortBusy
from bridge.link import LOOPBACK, open_link
from bridge.streams import LinkMode
from bridge.vehicle_server import ServerLink
from sitl.errors import UsageError

LAST_INSTANCE = 254
"""System ids end at 255."""

_GCS_PORT, _GCS_LOCAL = 14550, 18570
_API_PORT, _API_LOCAL, _LAST_API_PORT = 14540, 14580, 14549

# A number of an address that differs from vehicle to vehicle: 14560+i.
_PER_INSTANCE = re.compile(r"(\d+)\+i\b")


def check_instances(first: int, count: int) -> None:
    """Refuse vehicles that MAVLink has no system ids for.

    Raises:
        UsageError: an instance below 0 or above LAST_INSTANCE.
    """
    if not 0 <= first <= LAST_INSTANCE:
        raise UsageError(f"--instance {first}: choose one from 0 to {LAST_INSTANCE}")
    if first + count - 1 > LAST_INSTANCE:
        most = LAST_INSTANCE + 1 - first
        raise UsageError(
            f"{count} vehicles from --instance {first} on end at system {first + count}, and MAVLink's last one is "
            f"{LAST_INSTANCE + 1}. Start at most {most} of them"
        )


def check_bind(address: str) -> str:
    """Return the address of this computer that vehicles are to be reached at.

    Raises:
        UsageError: not an IPv4 address: PX4's ports are called at 127.0.0.1.
    """
    try:
        return str(ipaddress.IPv4Address(address))
    except ValueError:
        raise UsageError(
            f"--bind {address}: give an IPv4 address of this computer, or 0.0.0.0 for all of them"
        ) from None


def default_urls(instance: int = 0, bind: str = LOOPBACK) -> tuple[str, ...]:
    """Return the link addresses of a vehicle as PX4's simulator uses them.

    Args:
        instance: 0 is system 1.
        bind: the address of this computer that the vehicle's own ports are opened on.

    Raises:
        UsageError: no such instance.
    """
    check_instances(instance, 1)
    api_port = min(_API_PORT + instance, _LAST_API_PORT)
    wider = "" if bind == LOOPBACK else f"&bind={bind}"
    return (
        f"udpout://{LOOPBACK}:{_GCS_PORT}?local={_GCS_LOCAL + instance}{wider}#gcs",
        f"udpout://{LOOPBACK}:{api_port}?local={_API_LOCAL + instance}{wider}#onboard",
    )


def check_links(given: Sequence[str], *, bind: str, count: int) -> None:
    """Refuse addresses that cannot serve so many vehicles.

    Raises:
        UsageError: `bind` is given, too: it widens PX4's ports only.
        LinkUrlError: several vehicles would open the same port.
    """
    if not given:
        return
    if bind != LOOPBACK:
        raise UsageError(
            f"--bind {bind} widens PX4's own ports, and --link replaces those. Name the address in the link: "
            f"udpin://{bind}:14550"
        )
    for url in given:
        shared = url.startswith(("udpout:", "tcpout:")) and "local=" not in url
        if count > 1 and not shared and not _PER_INSTANCE.search(url):
            raise LinkUrlError(
                url,
                f"{count} vehicles cannot share it",
                "Write +i behind its number, and each adds its instance to it: udpin://127.0.0.1:14560+i",
            )


def link_urls(instance: int, *, bind: str = LOOPBACK, given: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the link addresses of one vehicle.

    Args:
        instance: 0 is system 1.
        bind: see `default_urls`.
        given: the user's own addresses instead of PX4's ports; a number with +i behind it, such as 14560+i, grows
            by the instance.
    """
    if not given:
        return default_urls(instance, bind)
    return tuple(_PER_INSTANCE.sub(lambda number: str(int(number[1]) + instance), url) for url in given)


def open_links(urls: Sequence[str], *, instance: int = 0) -> list[ServerLink]:
    """Open a vehicle's links; all are closed again if one cannot be opened.

    Args:
        urls: addresses as `bridge.link` reads them; `#onboard` at the end gives a link the stream rates of a
            companion computer, `#gcs`, the default, those of a ground station.
        instance: 0 is system 1.

    Raises:
        LinkUrlError: an address that cannot be read.
        PortBusy: another program holds a port; says which instance wanted it.
    """
    links: list[ServerLink] = []
    try:
        for number, url in enumerate(urls):
            address, mode = _split_mode(url)
            link = open_link(address)
            connection = Connection(instance + 1, 1, datagram=link.datagram)
            links.append(ServerLink(link, connection, number, mode))
    except PortBusy as busy:
        close_links(links)
        busy.args = (f"instance {instance}: {busy}",)
        raise
    except BaseException:
        close_links(links)
        raise
    return links


def close_links(links: Sequence[ServerLink]) -> None:
    """Release every port."""
    for link in links:
        link.link.close()


def banner(title: str, links: Sequence[ServerLink]) -> str:
    """Return the line that says who is served where."""
    names = {"gcs": "ground station", "onboard": "MAVSDK and other programs", "memory": "this program"}
    where = ", ".join(f"{names[link.mode]} at {link.link.name}" for link in links)
    sysid = links[0].connection.sysid if links else 0
    return f"{title} is system {sysid}, serving {where or 'nobody'}"


def exposure(links: Sequence[ServerLink], *, guarded: bool) -> str | None:
    """Return the warning about the ports that other computers can reach; None if there are none.

    Args:
        links: of all vehicles.
        guarded: whether the vehicles refuse what is not signed with their key.
    """
    places: dict[str, list[int]] = {}
    for link in links:
        if link.link.exposed is not None:
            host, port = link.link.exposed
            places.setdefault(host, []).append(port)
    if not places:
        return None
    where = " and ".join(f"{_where(host)} port {_ranges(ports)}" for host, ports in places.items())
    opened = f"warning: open to other computers: {where}."
    if guarded:
        return f"{opened} Whoever reaches it can listen; only signed messages are obeyed"
    return (
        f"{opened} Whoever reaches it can arm, fly and change every parameter; --signing-key FILE "
        f"leaves that to those who have the key"
    )


def _where(host: str) -> str:
    return "every address of this computer," if ipaddress.ip_address(host).is_unspecified else f"address {host},"


def _ranges(ports: Sequence[int]) -> str:
    """Return port numbers as `14580-14599, 18570`."""
    runs: list[list[int]] = []
    for port in sorted(set(ports)):
        if runs and port == runs[-1][1] + 1:
            runs[-1][1] = port
        else:
            runs.append([port, port])
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)


def _split_mode(url: str) -> tuple[str, LinkMode]:
    """Return (address, mode) of an address with `#mode` at its end."""
    address, _, mode = url.partition("#")
    choices: tuple[LinkMode, ...] = get_args(LinkMode)
    for choice in choices:
        if choice == (mode or "gcs"):
            return address, choice
    raise LinkUrlError(url, f"unknown stream rates {mode!r}", "Write #gcs or #onboard, or neither")
