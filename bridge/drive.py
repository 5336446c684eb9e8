"""How a client lets vehicle time pass: tick by tick in the vehicle's own thread, or by listening to a socket.

A client never sleeps and never looks at a clock. It asks its drive to `wait`, gets bytes or nothing, and reads
`now_us`: vehicle time either way, so the same flight gives the same result at any speed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from bridge.clock import Clock, SimClock, WallClock
from bridge.errors import PeerLost, PeerSilent
from bridge.link import Link

_SLICE_S = 0.02
_LOOK_US = 100_000
_JUMP_BACK_US = 1_000_000


class Drive(ABC):
    """Vehicle time and the waiting for it."""

    _look: Callable[[int], object] | None = None

    @abstractmethod
    def now_us(self) -> int:
        """Vehicle time as far as it is known, us since the vehicle's boot."""

    @abstractmethod
    def wait(self, link: Link, until_us: int) -> bytes | None:
        """Let time pass until something comes.

        Args:
            link: what to listen to. until_us: vehicle time at which the caller has something to do itself.

        Returns:
            what came; None at `until_us`, or earlier.

        Raises:
            LinkError: the peer went away or never answered.
        """

    def heard(self, time_us: int) -> None:
        """A message of the vehicle carried this vehicle time."""
        return

    @property
    def knows_time(self) -> bool:
        """Whether `now_us` means something yet."""
        return True

    def running_us(self) -> int:
        """Vehicle time, us, that also goes on while nothing is heard of the vehicle."""
        return self.now_us()

    def wire_us(self) -> int:
        """Time on the link, us: the vehicle's, or the wall clock's where the vehicle's is what its messages say."""
        return self.now_us()

    def watch(self, look: Callable[[int], object] | None) -> None:
        """Have vehicle time looked at as closely as it is known.

        Args:
            look: called with it (us) after every tick, or before every wait where ticks cannot be seen; None ends that.
        """
        self._look = look

    def sent_setpoint(self, quat: tuple[float, float, float, float]) -> None:
        """An attitude set-point was sent.

        Args:
            quat: body to world, w first.
        """
        return


class SharedDrive(Drive):
    """The vehicle lives in this thread: every wait is one of its ticks.

    Args:
        clock: the vehicle's clock; the vehicle itself is registered with it.
    """

    def __init__(self, clock: SimClock) -> None:
        self._clock = clock

    def watch(self, look: Callable[[int], object] | None) -> None:
        """Have vehicle time looked at after every tick; without anybody who looks it costs nothing."""
        self._clock.forget(self._tell)
        self._look = look
        if look is not None:
            self._clock.every_tick(self._tell)

    def _tell(self) -> None:
        if self._look is not None:
            self._look(self._clock.now_us())

    def now_us(self) -> int:
        """Vehicle time, us."""
        return self._clock.now_us()

    def wait(self, link: Link, until_us: int) -> bytes | None:
        """Let ticks pass, one at least, until something comes or `until_us` is reached."""
        clock = self._clock
        clock.advance()
        data = link.recv()
        while data is None and clock.now_us() < until_us:
            clock.advance()
            data = link.recv()
        return data


class NetworkDrive(Drive):
    """The vehicle is elsewhere: its time is what its messages say.

    Args:
        patience_s: wall-clock time without progress of the vehicle's clock after which the vehicle counts as lost,
            s; the escape that keeps a dead peer, or one that talks of other things, from holding the caller for
            ever.
        clock: measures that time.
    """

    def __init__(self, patience_s: float = 5.0, clock: Clock | None = None) -> None:
        self.patience_s = patience_s
        self._clock: Clock = clock or WallClock()
        self._now_us = self._running_us = 0
        self._knows_time = False
        self._looked_us = self._heard_at_us = self._clock.now_us()
        self._waited_us = 0
        self._anything = False

    def now_us(self) -> int:
        """Latest vehicle time heard, us; 0 before the first."""
        return self._now_us

    @property
    def knows_time(self) -> bool:
        """Whether the vehicle has told its time."""
        return self._knows_time

    def running_us(self) -> int:
        """Latest vehicle time heard, and as much wall time as has passed since; it never goes back."""
        if self._knows_time:
            self._running_us = max(self._running_us, self._now_us + self._clock.now_us() - self._heard_at_us)
        return self._running_us

    def wire_us(self) -> int:
        """The wall clock."""
        return self._clock.now_us()

    def heard(self, time_us: int) -> None:
        """A message carried this vehicle time; a jump back means that the vehicle started anew."""
        if time_us < self._now_us - _JUMP_BACK_US:
            raise PeerLost(
                "the vehicle",
                f"its clock went back from {self._now_us / 1e6:.1f} s to {time_us / 1e6:.1f} s, so it has restarted",
            )
        if time_us > self._now_us or not self._knows_time:
            self._now_us = max(self._now_us, time_us)
            self._heard_at_us = self._clock.now_us()
            self._knows_time = True
            self._waited_us = 0

    def wait(self, link: Link, until_us: int) -> bytes | None:
        """Listen for up to 20 ms of wall time; vehicle time moves only with what comes."""
        if self._look is not None:
            self._look(self.running_us())
        data = link.recv(_SLICE_S)
        now = self._clock.now_us()
        # A pause of this whole computer is no silence of the vehicle: each look counts 0.1 s at most.
        self._waited_us += min(now - self._looked_us, _LOOK_US)
        self._looked_us = now
        self._anything = self._anything or data is not None
        if self._waited_us > self.patience_s * 1e6:
            raise self._given_up(link)
        return data

    def _given_up(self, link: Link) -> PeerLost | PeerSilent:
        if self._knows_time:
            return PeerLost(link.name, f"nothing new from the vehicle for {self.patience_s:g} s")
        if self._anything:
            awaited = "an autopilot's HEARTBEAT with ATTITUDE or SYSTEM_TIME, though something does send here,"
            return PeerSilent(link.name, self.patience_s, awaited, "Is it a MAVLink autopilot (component 1)?")
        remedy = "Is the vehicle running, and does it send to this port? `froude sitl ant-x` starts one"
        return PeerSilent(link.name, self.patience_s, "a MAVLink vehicle", remedy)


class ListeningDrive(Drive):
    """For what needs no vehicle time, such as the parameters of a vehicle whose simulator is absent: wall time.

    Args:
        patience_s: silence after which the vehicle counts as lost, s. clock: measures the time.
    """

    def __init__(self, patience_s: float = 5.0, clock: Clock | None = None) -> None:
        self.patience_s = patience_s
        self._clock: Clock = clock or WallClock()
        self._start_us = self._looked_us = self._clock.now_us()
        self._silent_us = 0
        self._anything = False

    def now_us(self) -> int:
        """Wall time since this drive was made, us."""
        return self._clock.now_us() - self._start_us

    def wait(self, link: Link, until_us: int) -> bytes | None:
        """Listen for up to 20 ms."""
        data = link.recv(min(_SLICE_S, max(0.0, (until_us - self.now_us()) * 1e-6)))
        now = self._clock.now_us()
        # as in NetworkDrive: a pause of this whole computer is no silence of the vehicle
        self._silent_us = 0 if data is not None else self._silent_us + min(now - self._looked_us, _LOOK_US)
        self._looked_us = now
        self._anything = self._anything or data is not None
        if self._silent_us > self.patience_s * 1e6:
            if self._anything:
                raise PeerLost(link.name, f"nothing from the vehicle for {self.patience_s:g} s")
            remedy = "Is the vehicle switched on, and does it send to this port?"
            raise PeerSilent(link.name, self.patience_s, "a MAVLink vehicle", remedy)
        return data
