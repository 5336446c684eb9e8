"""`froude hil --link json://127.0.0.1:9002`: the plant for an ArduPilot, over its JSON backend."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from bridge.ardupilot_frames import FrameFit, fit_frame
from bridge.ardupilot_json import PORT, ArduPilotFace, NotArduPilot, ServoFrame, parse_frame
from bridge.clock import Clock, ScaledClock, WallClock
from bridge.datagram_port import Address, DatagramPort
from bridge.errors import LinkUrlError
from bridge.fleet import stop_on_signals
from bridge.link import LOOPBACK
from sitl.control_settings import mix_of
from sitl.parameters import ParameterTable
from sitl.rotation import to_euler
from sitl.true_body import TrueBody
from sitl.vehicle import airframe_parameters

if TYPE_CHECKING:
    from scenarios.hil_serve import Serving
    from scenarios.status_line import StatusLine
    from sitl.vehicle_spec import VehicleModel

FIRST_RATE_HZ = 1200
"""ArduPilot's SIM_RATE_HZ, until its first frame names one."""

SILENT_US = 2_000_000
"""Wall-clock silence after which another ArduPilot may take the place: one that gets no answer repeats every second."""

_STATUS_US = 1_000_000
_LISTEN_S = 0.05
_SAID_AT_MOST = 20


def serve_json(what: Serving, screen: StatusLine) -> dict[str, Any]:
    """Step the plant until stopped.

    Args:
        what: to serve. screen: the status line.

    Returns:
        the report, as that of `serve`.

    Raises:
        UsageError: a link that cannot be read, or an airframe that ArduPilot has no frame for.
        LinkError: a port that is taken.
    """
    host, port = json_address(what.link)
    model = what.model
    mix = mix_of(ParameterTable(airframe_parameters(model, what.profile)))
    fit = fit_frame(model.name, model.airframe.rotors, mix)
    body = TrueBody(model, what.profile, rate_hz=FIRST_RATE_HZ)
    # what is not compiled yet is compiled before ArduPilot may wait for it
    body.step(())
    with DatagramPort(what.link, host, port) as udp, stop_on_signals() as stop:
        return _Server(what, screen, udp, body, fit).run(stop)


def json_address(url: str) -> tuple[str, int]:
    """Host and port of `json://host:port`; this computer and ArduPilot's port are understood.

    Args:
        url: as given.

    Raises:
        LinkUrlError: there is no host and port in it.
    """
    remedy = f"Write json://{LOOPBACK}:{PORT}; instance N of ArduPilot's looks for port {PORT} + 10 N"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise LinkUrlError(url, str(error), remedy) from None
    if parts.scheme != "json" or parts.path not in ("", "/") or parts.query or parts.username is not None:
        raise LinkUrlError(url, "not json:// with host and port alone", remedy)
    return parts.hostname or LOOPBACK, PORT if port is None else port


def setup_parameters(model: VehicleModel, fit: FrameFit) -> dict[str, float]:
    """What an ArduPilot needs so that its motor commands are the plant's: linear thrust, this frame.

    Args:
        model: what flies. fit: its frame.

    Returns:
        parameter -> value.
    """
    return {
        "FRAME_CLASS": fit.frame.frame_class,
        "FRAME_TYPE": fit.frame.frame_type,
        "MOT_PWM_MIN": 1000,
        "MOT_PWM_MAX": 2000,
        "MOT_SPIN_ARM": 0.0,
        "MOT_SPIN_MIN": 0.0,
        "MOT_SPIN_MAX": 1.0,
        "MOT_THST_EXPO": 0.0,
        "MOT_BAT_VOLT_MAX": 0.0,
        "MOT_THST_HOVER": model.assumptions.hover_thrust,
        "MOT_HOVER_LEARN": 0,
    }


class _Server:
    """One port, one body, one ArduPilot at a time."""

    def __init__(self, what: Serving, screen: StatusLine, udp: DatagramPort, body: TrueBody, fit: FrameFit) -> None:
        self._what = what
        self._screen = screen
        self._udp = udp
        self._fit = fit
        self._body = body
        self._face = ArduPilotFace(body, fit.order, say=screen.tell)
        self._clock: Clock = WallClock()
        self._pace = _Pace(what.speed)
        self._seat: Address | None = None
        self._heard_us = 0
        self._refused = self._rejected = 0
        self._said: set[str] = set()

    def run(self, stop: Callable[[], bool]) -> dict[str, Any]:
        """Serve until told to stop; the report."""
        name = self._what.model.name
        if self._udp.exposed:
            self._screen.tell(f"open to other computers at {self._udp.name}: whoever speaks first flies")
        self._screen.tell(
            f"{name} waits for an ArduPilot at {self._udp.name} (start it with --model JSON:{LOOPBACK}), as its "
            f"{self._fit.frame.name}: "
            + ", ".join(f"{key} {value:g}" for key, value in setup_parameters(self._what.model, self._fit).items())
            + f". delta_lat is {self._fit.roll:.3f} of its roll command. Ctrl-C stops."
        )
        began_us = due_us = self._clock.now_us()
        while not stop() and not self._over():
            came = self._udp.receive(_LISTEN_S)
            for (data, sender), rest in zip(came, _tails(came), strict=True):
                self._take(data, sender, rest)
                if self._over():
                    break
            if self._screen.shows and self._clock.now_us() >= due_us:
                due_us = self._clock.now_us() + _STATUS_US
                self._screen.show(self._line())
        return self._report((self._clock.now_us() - began_us) * 1e-6)

    def _over(self) -> bool:
        # less than a tick less: rounding is no reason for one more
        seconds = self._what.seconds
        return seconds is not None and self._face.report.served_s >= seconds - 1e-6

    def _take(self, data: bytes, sender: Address, rest: list[tuple[bytes, Address]]) -> None:
        """One datagram, of those that were waiting together with `rest`."""
        try:
            frame = parse_frame(data)
        except NotArduPilot as problem:
            self._rejected += 1
            self._once(f"{_shown(sender)} sent {problem}; not answered")
            return
        if not self._admits(sender):
            self._refused += 1
            self._once(
                f"a second ArduPilot at {_shown(sender)} is not answered: {_shown(self._seat)} flies here. "
                "Give it a plant and a port of its own"
            )
            return
        self._heard_us = self._clock.now_us()
        if _comes_again(frame, sender, rest):
            # two answers to one frame would leave ArduPilot one frame behind for good
            self._face.report.repeated += 1
            return
        answer = self._face.answer(frame)
        self._pace.keep(self._face.report.served_s)
        self._udp.send(answer, sender)

    def _admits(self, sender: Address) -> bool:
        """Whether this is the one that flies; whoever comes when that one is silent takes its place."""
        if sender == self._seat:
            return True
        if self._seat is not None:
            if self._clock.now_us() - self._heard_us < SILENT_US:
                return False
            self._face.restart(f"it is at {_shown(sender)} now, {_shown(self._seat)} was silent")
        else:
            self._screen.tell(f"ArduPilot is at {_shown(sender)}")
        self._seat = sender
        return True

    def _once(self, text: str) -> None:
        if text not in self._said and len(self._said) < _SAID_AT_MOST:
            self._said.add(text)
            self._screen.tell(text)

    def _line(self) -> str:
        phi, theta, _ = to_euler(self._body.truth.quat())
        if self._seat is None:
            state = "nobody there"
        elif self._clock.now_us() - self._heard_us > SILENT_US:
            state = "silent"
        else:
            state = f"{self._body.rate_hz:g} Hz  {'motors turn' if self._face.armed else 'motors stand'}"
        return (
            f"{self._body.time_s:8.1f} s  {-self._body.truth.position_ned()[2]:6.1f} m  "
            f"roll {math.degrees(phi):6.1f} pitch {math.degrees(theta):6.1f}  {state}"
        )

    def _report(self, wall_s: float) -> dict[str, Any]:
        report, fit = self._face.report, self._fit
        self._screen.tell(
            f"{report.served_s:.1f} s of vehicle time: {report.frames} frames answered, {report.repeated} repeated, "
            f"{report.lost} lost, {report.restarts} restarts"
            + (f"; INVALID: {report.faults[0]}" if report.faults else "")
        )
        return {
            "mode": "ardupilot json",
            "vehicle": self._what.model.spec,
            "frame": fit.frame.name,
            "output_rotors": [rotor + 1 for rotor in fit.order],
            "delta_lat_per_roll": fit.roll,
            "delta_lon_per_pitch": fit.pitch,
            "delta_yaw_per_yaw": fit.yaw,
            "parameters": setup_parameters(self._what.model, fit),
            "vehicle_time_s": report.served_s,
            "wall_time_s": wall_s,
            "rate_hz": self._body.rate_hz,
            "frames": report.frames,
            "repeated": report.repeated,
            "lost": report.lost,
            "restarts": report.restarts,
            "refused": self._refused,
            "rejected": self._rejected,
            "pulses_outside": report.outside,
            "faults": list(report.faults),
            "stopped": "",
        }


class _Pace:
    """Holds answers back to a speed.

    Args:
        speed: vehicle seconds per second at most; None lets it run.
    """

    def __init__(self, speed: float | None) -> None:
        self._clock = None if speed is None else ScaledClock(speed)
        self._offset_us = 0

    def keep(self, served_s: float) -> None:
        """Wait until this much vehicle time is due; what was late is not caught up.

        Args:
            served_s: vehicle time, s.
        """
        if self._clock is None:
            return
        served_us = round(served_s * 1e6)
        if self._clock.sleep_until_us(served_us + self._offset_us) > 0:
            self._offset_us = self._clock.now_us() - served_us


def _tails(came: list[tuple[bytes, Address]]) -> list[list[tuple[bytes, Address]]]:
    return [came[i + 1 :] for i in range(len(came))]


def _comes_again(frame: ServoFrame, sender: Address, rest: list[tuple[bytes, Address]]) -> bool:
    for data, other in rest:
        if other == sender:
            try:
                return parse_frame(data).count == frame.count
            except NotArduPilot:
                continue
    return False


def _shown(address: Address | None) -> str:
    return "nobody" if address is None else f"{address[0]}:{address[1]}"
