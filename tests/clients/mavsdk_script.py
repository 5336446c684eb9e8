"""What scripts with MAVSDK-Python 4 do again and again."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

mavsdk = pytest.importorskip("mavsdk.asyncio")

from mavsdk.asyncio.plugins.action import ActionAsync  # noqa: E402
from mavsdk.asyncio.plugins.param import ParamAsync  # noqa: E402
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync  # noqa: E402


class Craft:
    """A vehicle as MAVSDK sees it, with the plugins that every script needs."""

    def __init__(self, sdk: Any, system: Any) -> None:
        self.sdk = sdk
        self.system = system
        self.action = ActionAsync(system)
        self.param = ParamAsync(system)
        self.telemetry = TelemetryAsync(system)

    async def ready(self) -> None:
        """Wait until everything is healthy and it may be armed."""
        await until(self.telemetry.subscribe_health_all_ok(), bool)
        await until(self.telemetry.subscribe_health(), lambda one: one.is_armable)

    async def up(self, altitude_m: float = 4.0) -> None:
        """Take off and wait for Hold."""
        await self.ready()
        await self.action.set_takeoff_altitude(altitude_m)
        await self.action.arm()
        await self.action.takeoff()
        await until(self.telemetry.subscribe_position(), lambda one: one.relative_altitude_m > altitude_m - 0.5)
        await self.mode("HOLD")

    async def down(self) -> None:
        """Land and wait until it has disarmed itself."""
        await self.action.land()
        await self.disarmed()

    async def mode(self, name: str) -> None:
        """Wait for a flight mode."""
        await until(self.telemetry.subscribe_flight_mode(), lambda one: one.name == name)

    async def disarmed(self) -> None:
        """Wait until the motors are off."""
        await until(self.telemetry.subscribe_armed(), lambda armed: not armed)


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Craft]:
    """The vehicle that speaks to a port."""
    configuration = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    async with mavsdk.Mavsdk(configuration) as sdk:
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await sdk.first_autopilot(timeout_s=30)
        assert system is not None
        yield Craft(sdk, system)


def fly(port: int, script: Callable[[Craft], Awaitable[None]], limit_s: float = 60.0) -> None:
    """Connect, and run a script that may take so long."""

    async def run() -> None:
        async with connected(port) as craft:
            await script(craft)

    within(limit_s, run)


def within(limit_s: float, script: Callable[[], Awaitable[None]]) -> None:
    """Run a script that may take so long."""
    asyncio.run(asyncio.wait_for(script(), limit_s))  # type: ignore[arg-type]


async def until(stream: Any, good: Callable[[Any], Any], limit_s: float = 40.0) -> Any:
    """Return the first good item of a telemetry stream."""
    last: Any = None

    async def first() -> Any:
        nonlocal last
        async for item in stream:
            last = item
            if good(item):
                return item
        raise AssertionError("the stream ended")

    try:
        return await asyncio.wait_for(first(), limit_s)
    except TimeoutError:
        raise AssertionError(f"nothing good within {limit_s} s; the last was {last}") from None
