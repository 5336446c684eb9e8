"""What a ground station knows of a vehicle: the newest of what it said of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from bridge.messages import Message
from bridge.px4_modes import ARMED, PX4_MODES

HIL = 32
"""MAV_MODE_FLAG_HIL_ENABLED."""

_PREARM_CHECK = 0x10000000
_TEXT_CHUNK = 50

_NAV_STATES = {mode.custom_mode: state for state, mode in reversed(PX4_MODES.items())}


@dataclass
class VehicleState:
    """What the vehicle last said of itself.

    Attributes:
        nav_state: PX4's mode number, -1 before the first heartbeat. armed: motors may turn.
        autopilot: MAV_AUTOPILOT, -1 before the first heartbeat; 12 is PX4. hil_enabled: of a board in HITL.
        system_status: MAV_STATE. prearm_ok: it would arm in this mode. landed_state: MAV_LANDED_STATE.
        home_alt_m: height of home above mean sea level, m; None until HOME_POSITION.
        position_ned, velocity_ned: m, m/s; None until LOCAL_POSITION_NED.
        euler, rates: rad, rad/s; None until ATTITUDE. thrust_sp: collective set-point, 0..1.
        texts: every STATUSTEXT as (vehicle time us, severity, text).
    """

    nav_state: int = -1
    armed: bool = False
    autopilot: int = -1
    hil_enabled: bool = False
    system_status: int = 0
    prearm_ok: bool = False
    landed_state: int = 0
    home_alt_m: float | None = None
    position_ned: tuple[float, float, float] | None = None
    velocity_ned: tuple[float, float, float] | None = None
    euler: tuple[float, float, float] | None = None
    rates: tuple[float, float, float] | None = None
    thrust_sp: float = 0.0
    texts: list[tuple[int, int, str]] = field(default_factory=list)
    _chunks: dict[int, str] = field(default_factory=dict)

    def handlers(self) -> dict[str, Callable[[Message], object]]:
        """Message name -> what takes it."""
        return {
            "ATTITUDE_TARGET": self._on_attitude_target,
            "SYS_STATUS": self._on_sys_status,
            "EXTENDED_SYS_STATE": self._on_extended_sys_state,
            "HOME_POSITION": self._on_home,
            "CURRENT_MODE": self._on_current_mode,
        }

    def on_heartbeat(self, m: Message) -> None:
        """Take a HEARTBEAT of the autopilot."""
        self.nav_state = _NAV_STATES.get(m.custom_mode, -1)
        self.armed = bool(m.base_mode & ARMED)
        self.autopilot = m.autopilot
        self.hil_enabled = bool(m.base_mode & HIL)
        self.system_status = m.system_status

    def on_text(self, m: Message, now_us: int) -> str | None:
        """Take a STATUSTEXT, a text or a piece of one; the text if it is whole now."""
        text, number = m.text, m["id"]
        if number:
            text = self._chunks.pop(number, "") + text
            if len(m.text) == _TEXT_CHUNK:
                self._chunks[number] = text
                return None
        text = text.rstrip("\t")
        self.texts.append((now_us, m.severity, text))
        return str(text)

    def _on_current_mode(self, m: Message) -> None:
        self.nav_state = _NAV_STATES.get(m.custom_mode, -1)

    def _on_attitude_target(self, m: Message) -> None:
        self.thrust_sp = m.thrust

    def _on_sys_status(self, m: Message) -> None:
        self.prearm_ok = bool(m.onboard_control_sensors_health & _PREARM_CHECK)

    def _on_extended_sys_state(self, m: Message) -> None:
        self.landed_state = m.landed_state

    def _on_home(self, m: Message) -> None:
        self.home_alt_m = m.altitude * 1e-3
