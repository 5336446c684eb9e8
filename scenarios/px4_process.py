"""A PX4 SITL that the user has built, started for a run and stopped after it."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from bridge.errors import PeerLost
from sitl.errors import FileError, UsageError

SIMULATOR_PORT, MAVLINK_PORT = 4560, 14540
PX4_PORTS = (14580, 18570)
"""Which a PX4 itself binds, for programs and for ground stations."""

MODEL = "none_iris"
"""PX4's airframe 10016 with a simulator that connects over TCP."""

MOST_INSTANCES = 10
_STOP_S = 2.0
_PR_SET_PDEATHSIG, _PR_CAPBSET_DROP, _CAP_SYS_NICE = 1, 24, 23


class Px4Process:
    """One instance; a context manager.

    Args:
        build: PX4's build directory, with `bin/px4` and `etc`.
        folder: its working directory, made if it is missing; parameters and logs go there.
        instance: 0 to 9: ports and system id follow from it.

    Raises:
        FileError: no PX4 there.
    """

    def __init__(self, build: Path, folder: Path, instance: int) -> None:
        self.binary = build / "bin" / "px4"
        remedy = "Give the build directory of PX4, such as PX4-Autopilot/build/px4_sitl_default"
        if not self.binary.is_file() or not (build / "etc").is_dir():
            raise FileError(build, "holds no bin/px4 and etc", remedy)
        if not os.access(self.binary, os.X_OK):
            raise FileError(self.binary, "is not executable", remedy)
        self.build = build.resolve()
        self.folder = folder.resolve()
        self.instance = instance
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def simulator_url(self) -> str:
        """Where it connects to its simulator."""
        return f"tcpin://127.0.0.1:{SIMULATOR_PORT + self.instance}"

    @property
    def connect_url(self) -> str:
        """Where its MAVLink for programs arrives."""
        return f"udpin://127.0.0.1:{MAVLINK_PORT + self.instance}"

    @property
    def log(self) -> Path:
        """What it printed."""
        return self.folder / "px4.log"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Start it; it waits for its simulator by itself.

        Raises:
            FileError: it cannot be started, or its folder not be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with self.log.open("wb") as log:
                self._process = subprocess.Popen(
                    [str(self.build / "bin" / "px4"), "-d", "-i", str(self.instance), "-w", str(self.folder),
                     str(self.build / "etc")],
                    cwd=self.folder,
                    env={**os.environ, "PX4_SIM_MODEL": MODEL},
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=_as_our_own,
                )  # fmt: skip
        except OSError as error:
            where = error.filename or self.binary
            raise FileError(where, f"PX4 cannot be started: {error.strerror}", "Does it start by hand?") from error

    def check(self) -> None:
        """Raise PeerLost if it has ended by itself, with its last words."""
        if self._process is not None and (status := self._process.poll()) is not None:
            how = f"with status {status}" if status >= 0 else f"by signal {-status} ({signal.Signals(-status).name})"
            raise PeerLost("PX4", f"it ended {how}; it last said: {self.last_words()}. Its output is in {self.log}")

    def last_words(self) -> str:
        """The last line it printed."""
        with suppress(OSError):
            lines = self.log.read_text(errors="replace").strip().splitlines()
            if lines:
                return lines[-1][:200]
        return "it printed nothing"

    def stop(self) -> None:
        """Stop it and everything it started; it may ignore a polite request once its simulator is gone."""
        process, self._process = self._process, None
        if process is None:
            return
        for how in (signal.SIGINT, signal.SIGKILL):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, how)
            with suppress(subprocess.TimeoutExpired):
                process.wait(_STOP_S)
                break
        # what it started itself may not have heard the polite request
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        # left behind by a kill, they would block the next start of this instance
        for name in (f"px4-sock-{self.instance}", f"px4_lock-{self.instance}"):
            with suppress(OSError):
                Path("/tmp", name).unlink()


def free_instance() -> int:
    """The first instance whose ports nobody holds.

    Raises:
        UsageError: all are taken.
    """
    for instance in range(MOST_INSTANCES):
        # its own ports, too: another PX4 of that number, with another simulator, would talk into our link
        ports = (MAVLINK_PORT, *PX4_PORTS)
        if _free(socket.SOCK_STREAM, SIMULATOR_PORT + instance) and all(
            _free(socket.SOCK_DGRAM, port + instance) for port in ports
        ):
            return instance
    last = MOST_INSTANCES - 1
    raise UsageError(
        f"ports {SIMULATOR_PORT} to {SIMULATOR_PORT + last} and {MAVLINK_PORT} to {MAVLINK_PORT + last} are taken: "
        "stop other simulators, or start PX4 yourself and give --hil and --connect"
    )


def _free(kind: int, port: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def _as_our_own() -> None:
    """Run in the child: it ends with us, and as root it gets no real-time priority, with which it starves its plant."""
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.geteuid() == 0:
        libc.prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
