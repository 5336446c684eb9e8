"""Which addresses let other computers in, told before they are opened."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from urllib.parse import parse_qsl, urlsplit

from bridge.link import LOOPBACK

FIRST = "whoever speaks there first is taken for the vehicle"

_LISTENING = ("udpin", "tcpin", "json")


def warnings(urls: Iterable[str], what: str) -> list[str]:
    """A line for people for each address at which other computers can speak to this one.

    Args:
        urls: as `bridge.link` reads them; one that cannot be read is for whoever opens it to refuse.
        what: what may be done there, such as "whoever speaks first is taken for the vehicle".
    """
    return [
        f"warning: open to other computers: {where}; {what}"
        for where in dict.fromkeys(exposed(url) for url in urls)
        if where
    ]


def exposed(url: str) -> str:
    """The address and port of this computer that an address opens to others; empty if it opens none.

    Args:
        url: of a link.
    """
    try:
        parts = urlsplit(url.partition("#")[0])
        options, port = dict(parse_qsl(parts.query)), parts.port
    except ValueError:
        return ""
    host = parts.hostname or LOOPBACK
    if parts.scheme == "udpout":
        if "local" not in options:
            return ""
        host, port_text = options.get("bind", "" if is_loopback(host) else "0.0.0.0"), options["local"]
    elif parts.scheme in _LISTENING:
        port_text = str(port)
    else:
        return ""
    return "" if not host or is_loopback(host) else f"{host} port {port_text}"


def is_loopback(host: str) -> bool:
    """Whether nobody but this computer can reach a host; a name that is not `localhost` is taken for open."""
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return host.rstrip(".").casefold() == "localhost"
