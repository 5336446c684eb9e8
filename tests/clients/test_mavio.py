"""mavio: a MAVLink stack of its own in Python, sharing no code with pymavlink and MAVSDK."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from mavsdk_script import within
from vehicle_process import VehicleProcess

from sitl.parameters import parameter_specs

pytestmark = pytest.mark.client

mavio = pytest.importorskip("mavio")

from mavio.metadata import fetch_parameter_metadata  # noqa: E402
from mavio.node import MavNode  # noqa: E402
from mavio.serializer import CommandLongBuilder  # noqa: E402

HEARTBEAT, ATTITUDE, GLOBAL_POSITION_INT = 0, 30, 33
ACCEPTED, TEMPORARILY_REJECTED, UNSUPPORTED = 0, 1, 3
NAN = float("nan")


@pytest.fixture(scope="module")
def vehicle(sitl: Callable[..., VehicleProcess]) -> VehicleProcess:
    return sitl(speed=3.0)


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Any]:
    """A node that speaks to the vehicle at a port."""
    node = MavNode({"url": f"udpin://127.0.0.1:{port}", "target_id": "1:1", "heartbeat_interval": 1})
    task = asyncio.create_task(node.run())
    try:
        await until(lambda: node.snapshot().get(HEARTBEAT))
        yield node
    finally:
        node.close()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(good: Callable[[], Any], limit_s: float = 30.0) -> Any:
    """Wait for something true."""
    for _ in range(int(limit_s / 0.02)):
        found = good()
        if found:
            return found
        await asyncio.sleep(0.02)
    raise AssertionError(f"not within {limit_s} s")


async def do(node: Any, command: int, *params: float) -> int:
    """The result of a command."""
    ack = await node.do(CommandLongBuilder(command, *params), retries=2)
    assert ack is not None
    return int(ack.result)


def test_parameters(vehicle: VehicleProcess) -> None:
    async def script() -> None:
        specs = parameter_specs()
        # It asks for the list once and never for what the system dropped of it: a new node asks again.
        for _ in range(5):
            async with connected(vehicle.port) as node:
                await node.params.get("*", timeout=10)
                # What it says about completeness is from before it waited, so it is asked twice.
                everything = await node.params.get("*")
            if everything.pop("cache_level").value == 1.0:
                break
        assert set(everything) - {"_HASH_CHECK"} == set(specs)
        assert everything["MC_ROLL_P"].value == pytest.approx(specs["MC_ROLL_P"].default)
        assert everything["MAV_SYS_ID"].value == 1

    within(90, script)


def test_metadata_and_files(vehicle: VehicleProcess) -> None:
    async def script() -> None:
        async with connected(vehicle.port) as node:
            described = await fetch_parameter_metadata(node, cache_dir=None)
            assert set(described) == set(parameter_specs())
            assert described["MC_ROLL_P"]["description"]
            names = {entry.name for entry in await node.ftp.list_directory("/etc/extras")}
            general = next(name for name in names if name.startswith("component_general"))
            path = f"/etc/extras/{general}"
            assert await node.ftp.read(path, burst=True) == await node.ftp.read(path, burst=False)

    within(60, script)


def test_a_flight(vehicle: VehicleProcess) -> None:
    async def script() -> None:
        async with connected(vehicle.port) as node:

            def heartbeat() -> Any:
                return node.snapshot()[HEARTBEAT].msg

            def height_m() -> float:
                return float(node.snapshot()[GLOBAL_POSITION_INT].msg.relative_alt) * 1e-3

            await until(lambda: GLOBAL_POSITION_INT in node.snapshot())
            assert await do(node, 31_999) == UNSUPPORTED
            assert await do(node, 511, ATTITUDE, 10_000) == ACCEPTED
            for _ in range(100):
                # A vehicle that has just started has not aligned yet.
                if await do(node, 400, 1) == ACCEPTED:
                    break
                await asyncio.sleep(0.1)
            assert await do(node, 22, 0, 0, 0, NAN, NAN, NAN, 492) == ACCEPTED
            await until(lambda: heartbeat().base_mode & 128)
            await until(lambda: height_m() > 3.0)
            assert await do(node, 400, 0) == TEMPORARILY_REJECTED  # not in the air
            assert await do(node, 176, 1, 4, 6) == ACCEPTED  # Land
            await until(lambda: heartbeat().custom_mode == 0x06040000)
            await until(lambda: not heartbeat().base_mode & 128)
            assert abs(height_m()) < 0.5

    within(60, script)
