"""How a client lets vehicle time pass: tick by tick in the vehicle's own thread, or by listening to a socket.

A client never sleeps and never looks at a clock. It asks its drive to `wait`, gets bytes or nothing, and reads
`now_us`: vehicle time either way, so the same flight gives the same result at any speed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from bridge.clock import Clock, SimClock, WallClock
from bridge.errors import PeerLost, PeerSilent
from bridge.link import Link

_SLICE_S = 0.02


class Drive(ABC):
    """Vehicle time and the waiting for it."""

    @abstractmethod
    def now_us(self) -> int:
        """Vehicle time as far as it is known, us since the vehicle's boot."""

    @abstractmethod
    def wait(self, link: Link) -> bytes | None:
        """Let some time pass; bytes that came meanwhile, if any.

        Raises:
            LinkError: the peer went away or never answered.
        """

    def heard(self, time_us: int) -> None:
        """A message carried this vehicle time."""
        return


class SharedDrive(Drive):
    """The vehicle lives in this thread: every wait is one of its ticks.

    Args:
        clock: the vehicle's clock; the vehicle itself is registered with it.
    """

    def __init__(self, clock: SimClock) -> None:
        self._clock = clock

    def now_us(self) -> int:
        """Vehicle time, us."""
        return self._clock.now_us()

    def wait(self, link: Link) -> bytes | None:
        """Let one tick pass."""
        self._clock.advance()
        return link.recv()


class NetworkDrive(Drive):
    """The vehicle is elsewhere: its time is what its messages say.

    Args:
        patience_s: wall-clock silence after which the vehicle counts as lost, s; the escape that keeps a dead
            peer from holding the caller for ever.
        clock: measures that silence.
    """

    def __init__(self, patience_s: float = 5.0, clock: Clock | None = None) -> None:
        self.patience_s = patience_s
        self._clock: Clock = clock or WallClock()
        self._now_us = 0
        self._ever_heard = False
        self._alive_us = self._clock.now_us()

    def now_us(self) -> int:
        """Latest vehicle time heard, us."""
        return self._now_us

    def heard(self, time_us: int) -> None:
        """A message carried this vehicle time; a jump back means that the vehicle started anew."""
        if time_us < self._now_us - 1_000_000:
            raise PeerLost(
                "the vehicle",
                f"its clock went back from {self._now_us / 1e6:.1f} s to {time_us / 1e6:.1f} s: it restarted",
            )
        self._ever_heard = True
        self._now_us = max(self._now_us, time_us)

    def wait(self, link: Link) -> bytes | None:
        """Listen for up to 20 ms."""
        data = link.recv(_SLICE_S)
        now = self._clock.now_us()
        if data is not None:
            self._alive_us = now
        elif now - self._alive_us > self.patience_s * 1e6:
            if self._ever_heard:
                raise PeerLost(link.name, f"silent for {self.patience_s:g} s")
            raise PeerSilent(
                link.name,
                self.patience_s,
                "a MAVLink vehicle",
                "Is the vehicle running, and does it send to this port? `froude sitl ant-x` starts one",
            )
        return data
