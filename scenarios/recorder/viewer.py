"""The Rerun viewer that is installed beside the program: found, opened on recordings, or run without a window.

Whatever the viewer listens on, it listens on this machine's loopback only; left alone it would be all addresses.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from sitl.errors import UsageError

HOST: Final = "127.0.0.1"
LOOPBACK: Final = ("--bind", HOST)

_MOMENT_S = 1.0
"""A viewer that cannot start ends within this."""

_START_S = 60.0
_LOOK_S = 0.1
_END_S = 5.0


def viewer_path() -> str:
    """The viewer of this Python's own installation, which matches the library; else the one on the path.

    Raises:
        UsageError: there is none.
    """
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.is_file() else shutil.which("rerun")
    if not found:
        raise UsageError(
            "the Rerun viewer is not installed beside this Python nor on the path. It comes with the package: "
            f"{sys.executable} -m pip install rerun-sdk"
        )
    return found


def has_display() -> bool:
    """Can a window be opened here?"""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_viewer(recordings: Sequence[Path]) -> None:
    """Open recordings in a viewer of its own, which stays when this program ends.

    Args:
        recordings: .rrd files.

    Raises:
        UsageError: there is no display or no viewer, or it ends at once.
    """
    if not has_display():
        raise UsageError(
            "there is no display to open the viewer on (DISPLAY and WAYLAND_DISPLAY are not set). Use --web and a "
            "browser, --screenshot FILE for a picture, or --html for the report"
        )
    command = [viewer_path(), *LOOPBACK, *(str(path.resolve()) for path in recordings)]
    with tempfile.TemporaryFile() as said:
        try:
            viewer = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True
            )
        except OSError as error:
            raise UsageError(f"{command[0]}: the viewer does not start: {error.strerror or error}") from error
        try:
            status = viewer.wait(_MOMENT_S)
        except subprocess.TimeoutExpired:
            viewer.returncode = 0  # it lives on without us, and is nobody's child to be waited for
            return
        if status != 0:
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines()
            why = lines[-1] if lines else f"exit status {status}"
            raise UsageError(f"{command[0]}: the viewer ended at once: {why}. --web shows the same in a browser")


@contextlib.contextmanager
def started(*options: str) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer's program with these options, ended with the block; what it says is dropped.

    Args:
        options: words of its command line, after `--bind` to the loopback.

    Raises:
        UsageError: there is none, or it does not start.
    """
    command = [viewer_path(), *LOOPBACK, *options]
    quiet = subprocess.DEVNULL
    try:
        process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    except OSError as error:
        raise UsageError(f"{command[0]}: the viewer does not start: {error.strerror or error}") from error
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End it with what it started: the program on the path is a script around the viewer proper."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)


def wait_until_listening(process: subprocess.Popen[bytes], port: int) -> None:
    """Wait for a program of ours to listen.

    Args:
        process: it. port: of the loopback.

    Raises:
        UsageError: it ended, or does not listen within a minute.
    """
    pause = threading.Event()
    for _ in range(round(_START_S / _LOOK_S)):
        with contextlib.suppress(OSError), socket.create_connection((HOST, port), 1.0):
            return
        if process.poll() is not None:
            raise UsageError(f"the viewer ended at once, with exit status {process.returncode}")
        pause.wait(_LOOK_S)
    raise UsageError(f"the viewer does not listen on port {port} of {HOST} after {_START_S:g} s")


@contextlib.contextmanager
def headless() -> Iterator[Any]:
    """A viewer without a window: Rerun's `ViewerClient`, ended with the block.

    Raises:
        UsageError: it does not start, most likely for want of a Vulkan driver.
    """
    from rerun.experimental import ViewerClient

    port = free_port()
    with started("--headless", "--hide-welcome-screen", "--port", str(port)) as process:
        wait_until_listening(process, port)
        yield ViewerClient(f"rerun+http://{HOST}:{port}/proxy")


def free_port() -> int:
    """A TCP port of the loopback that nobody has at this moment."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
    return port
