"""Serial ports, for a real autopilot; needs pyserial, which is imported only here and only when asked for."""

from __future__ import annotations

import importlib
from typing import Any

from bridge.errors import LinkClosed, LinkUrlError, PeerLost, PortBusy
from bridge.link import Link

_STUCK_S = 1.0


class SerialLink(Link):
    """A serial port, 8 data bits, no parity, no flow control.

    Args:
        device: for example /dev/ttyACM0.
        baud: bits per second; USB boards ignore it.

    Raises:
        LinkUrlError: no such device, no right to open it, or pyserial is not installed.
        PortBusy: another program holds the device.
    """

    datagram = False

    def __init__(self, device: str, baud: int) -> None:
        super().__init__(f"serial://{device}:{baud}")
        try:
            serial = importlib.import_module("serial")
        except ImportError:
            raise LinkUrlError(self.name, "pyserial is not installed", "Run: pip install pyserial") from None
        self._error: type[Exception] = serial.SerialException
        try:
            self._port: Any = serial.Serial(device, baud, timeout=0.0, write_timeout=_STUCK_S, exclusive=True)
        except serial.SerialException as error:
            if "lock" in str(error):
                raise PortBusy(device, baud) from None
            remedy = "Check the cable, the name and your right to use it (group dialout)"
            raise LinkUrlError(self.name, str(error), remedy) from None

    def send(self, data: bytes) -> None:
        """Write all the bytes."""
        if self._port is None:
            raise LinkClosed(self.name)
        try:
            self._port.write(data)
        except (self._error, OSError) as error:
            raise PeerLost(self.name, str(error)) from None

    def recv(self, timeout_s: float = 0.0) -> bytes | None:
        """Return what has arrived."""
        if self._port is None:
            raise LinkClosed(self.name)
        try:
            self._port.timeout = timeout_s
            data: bytes = self._port.read(1)
            if data and self._port.in_waiting:
                data += self._port.read(self._port.in_waiting)
        except (self._error, OSError) as error:
            raise PeerLost(self.name, str(error)) from None
        return data or None

    def close(self) -> None:
        """Release the device."""
        if self._port is not None:
            self._port.close()
            self._port = None


def is_usb(link: Link) -> bool:
    """Return whether a link is a serial line over USB, as Linux names those of flight controllers."""
    return isinstance(link, SerialLink) and "ttyACM" in link.name
