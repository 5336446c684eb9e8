"""Commands that fly: arming, modes, take-off, landing, repositioning, home, speed, missions.

Rules are PX4's (src/modules/commander/Commander.cpp, src/modules/navigator/navigator_main.cpp).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from bridge.px4_modes import PX4_MODES, UnknownModeError, asked_mode
from sitl.modes import Mode, Result, Severity
from sitl.plan import RELATIVE_FRAMES
from sitl.sensors import geodetic
from sitl.setpoints import Reposition

if TYPE_CHECKING:
    from bridge.commands import Action, Command
    from bridge.vehicle_server import VehicleServer

_FORCE = 21196
_CHANGE_MODE = 1  # MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
_GROUND_STATION = 190  # MAV_COMP_ID_MISSIONPLANNER: PX4 explains a refused mode to nobody else
_NAN = math.nan


class FlightCommands:
    """Carries out commands that fly one vehicle.

    Args:
        server: the vehicle's face.
    """

    def __init__(self, server: VehicleServer) -> None:
        self._server = server
        self._autopilot = server.vehicle.autopilot

    def actions(self) -> dict[int, Action]:
        """Return what carries out each MAV_CMD."""
        return {
            20: lambda _: self._autopilot.command_return(),
            21: lambda _: self._autopilot.command_land(),
            22: self._take_off,
            23: self._land_precisely,
            34: self._orbit,
            35: self._figure_eight,
            84: lambda _: self._autopilot.command_mode(Mode.VTOL_TAKEOFF),
            176: self.set_mode,
            178: self._change_speed,
            179: self._set_home,
            185: self._terminate,
            186: self._change_altitude,
            189: lambda _: Result.CANCELLED,  # DO_LAND_START: no landing pattern is stored
            191: lambda _: Result.ACCEPTED,  # DO_GO_AROUND: PX4 acknowledges it even on the ground
            192: self._reposition,
            # regions of interest: accepted as on a PX4; there is no camera here that would turn
            **dict.fromkeys((80, 195, 196, 197, 201), lambda _: Result.ACCEPTED),
            262: self._set_standard_mode,
            300: self._start_mission,
            400: self._arm,
        }

    def set_mode(self, command: Command) -> Result:
        """DO_SET_MODE: base_mode, main and sub mode in param1 to param3."""
        base_mode, main, sub = (command.whole(index) for index in (1, 2, 3))
        try:
            mode = asked_mode(base_mode & 0xFF, main, sub)
        except UnknownModeError as error:
            self._server.say(Severity.CRITICAL, f"{error}\t")
            return Result.TEMPORARILY_REJECTED
        explain = command.sender[1] == _GROUND_STATION
        return self._autopilot.command_mode(Mode(mode.nav_state), explain=explain)

    def _set_standard_mode(self, command: Command) -> Result:
        wish = command.whole(1)
        for mode in PX4_MODES.values():
            if wish and mode.standard_mode == wish:
                return self._autopilot.command_mode(Mode(mode.nav_state), explain=False)
        return Result.FAILED

    def _arm(self, command: Command) -> Result | None:
        wish = command.whole(1)
        if wish not in (0, 1):
            self._server.say(Severity.CRITICAL, f"Unsupported ARM_DISARM param: {command.params[0]:.3f}\t")
            return None
        # The force number disarms in the air; it never skips the checks before arming.
        force = wish == 0 and command.whole(2) == _FORCE
        return self._autopilot.command_arm(wish == 1, force=force)

    def _take_off(self, command: Command) -> Result:
        altitude_m = self._altitude_amsl_m(command)
        return self._autopilot.command_takeoff(altitude_m if math.isfinite(altitude_m) else None)

    def _land_precisely(self, _: Command) -> Result:
        result = self._autopilot.command_mode(Mode.PRECLAND)
        if result is Result.ACCEPTED:
            self._server.say(Severity.INFO, "Precision landing\t")
        return result

    def _orbit(self, command: Command) -> Result:
        result = self._autopilot.command_orbit(
            self._place(command, 3), radius_m=command.params[0], speed_m_s=command.params[1]
        )
        if result is not Result.ACCEPTED:
            self._server.say(Severity.CRITICAL, "Orbit command rejected")
        return result

    def _figure_eight(self, _: Command) -> None:
        self._server.say(Severity.CRITICAL, "Figure 8 command not supported.")

    def _change_speed(self, command: Command) -> Result:
        """DO_CHANGE_SPEED: PX4 accepts anything; ground speeds below zero mean the default."""
        kind, speed_m_s = command.whole(1), command.params[1]
        if kind in (0, 1):
            self._autopilot.navigator.cruise_m_s = speed_m_s if speed_m_s >= 0.0 else _NAN
        return Result.ACCEPTED

    def _set_home(self, command: Command) -> Result:
        if not self._server.vehicle.parameters.get("COM_HOME_EN"):
            return Result.DENIED
        if command.params[0] > 0.5:
            return self._autopilot.command_set_home_here()
        where = self._place(command, 3)
        return self._autopilot.command_set_home(where.lat_deg, where.lon_deg, where.alt_m)

    def _terminate(self, command: Command) -> Result:
        return self._autopilot.command_terminate(command.params[0] > 0.5)

    def _change_altitude(self, command: Command) -> Result:
        altitude_m = command.params[0]
        if command.whole(2) in RELATIVE_FRAMES:
            altitude_m += self._home_amsl_m()
        return self._autopilot.command_reposition(Reposition(_NAN, _NAN, altitude_m, _NAN, _NAN))

    def _reposition(self, command: Command) -> Result:
        if command.whole(2) != _CHANGE_MODE:
            return Result.UNSUPPORTED
        speed_m_s = command.params[0]
        where = self._place(command, 3)
        return self._autopilot.command_reposition(where._replace(speed_m_s=speed_m_s if speed_m_s > 0.0 else _NAN))

    def _start_mission(self, command: Command) -> Result:
        first = command.params[0]
        if not (math.isfinite(first) and first >= -1.0):
            return Result.DENIED
        return self._autopilot.command_mission_start()

    def _place(self, command: Command, yaw: int) -> Reposition:
        """Return where param5 to param7 are, whatever the frame; yaw: index of the heading among the params."""
        x, y = command.params[4:6]
        altitude_m = self._altitude_amsl_m(command)
        if command.local:
            x, y, altitude_m = geodetic((x, y, command.params[6]))
        return Reposition(x, y, altitude_m, command.params[yaw], _NAN)

    def _altitude_amsl_m(self, command: Command) -> float:
        altitude_m = command.params[6]
        return altitude_m + self._home_amsl_m() if command.frame in RELATIVE_FRAMES else altitude_m

    def _home_amsl_m(self) -> float:
        home = self._autopilot.home
        return self._server.vehicle.origin[2] if home is None else home.alt_m
