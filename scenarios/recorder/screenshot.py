"""A picture of a recording without a display: the viewer runs headless for a few seconds.

It needs a Vulkan driver; on a machine without a graphics card Mesa's software one does (Debian:
`mesa-vulkan-drivers`). Not while something is flown in real time on the same machine: the software renderer
takes every core.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from scenarios.recorder.cursor import first_moment, put
from scenarios.recorder.stream import TIMELINE
from scenarios.recorder.viewer import headless
from sitl.errors import FileError, UsageError

_PAUSE_S = 0.3
_LOAD_ATTEMPTS = 100
_STILL_ATTEMPTS = 30
_STILL_FRAMES = 3
"""Axes are animated and notices fade: the picture is taken when so many frames in a row are the same."""


def screenshot(rrd: Path, png: Path, at_s: float | None = None, tab: str | None = None) -> list[str]:
    """Draw a recording as the viewer shows it.

    Args:
        rrd: the recording.
        png: the picture, 1920 x 1080; replaced if it exists.
        at_s: where the time cursor stands, s on the recording's timeline; None: a moment into the first
            manoeuvre.
        tab: title of the tab to open; None: the layout's own choice.

    Returns:
        Errors and warnings that the viewer's views reported; empty if all is well.

    Raises:
        FileError: no such recording, one that the viewer cannot show, or the picture cannot be written.
        UsageError: no such tab; or the viewer does not start, most likely for want of a Vulkan driver.
    """
    if not rrd.is_file():
        raise FileError(rrd, "no such recording", "Give a .rrd file of a run")
    moment = first_moment(rrd)
    try:
        with headless() as viewer:
            viewer.open(str(rrd.resolve()))
            _wait_loaded(viewer)
            if not viewer.get_state().views:
                raise FileError(rrd, "the viewer shows nothing of it: damaged, or empty", "Draw another recording")
            if tab is not None:
                _open_tab(viewer, tab)
            if at_s is not None:
                viewer.set_time(TIMELINE, duration=at_s, play_state="paused")
            elif moment is not None:
                put(viewer, moment)
            image = _still_frame(viewer)
            reports = [f"{view.name}: {report}" for view in viewer.get_state().views for report in view.reports]
    except (RuntimeError, OSError, ValueError) as error:
        raise UsageError(
            f"the Rerun viewer could not draw {rrd}: {error}. Without a graphics card it needs a software "
            "Vulkan driver (Debian, Ubuntu: apt-get install mesa-vulkan-drivers libvulkan1)"
        ) from error
    part = png.with_name(png.name + ".part")
    try:
        part.write_bytes(image)
        part.replace(png)
    except OSError as error:
        raise FileError(png, f"cannot be written: {error}", "Choose another file") from error
    return reports


def _wait_loaded(viewer: Any) -> None:
    pause = threading.Event()
    for _ in range(_LOAD_ATTEMPTS):
        if not viewer.get_state().loading:
            return
        pause.wait(_PAUSE_S)


def _open_tab(viewer: Any, tab: str) -> None:
    current = viewer.get_blueprint()
    parts: dict[str, dict[str, dict[str, Any]]] = current.blueprint
    containers = {path: part["ContainerBlueprint"] for path, part in parts.items() if "ContainerBlueprint" in part}
    root = next((box for box in containers.values() if box.get("container_kind") == "Tabs"), {})
    names = {}
    for content in root.get("contents", ()):
        part = parts.get(f"/{content}", {})
        names[(part.get("ContainerBlueprint") or part.get("ViewBlueprint") or {}).get("display_name", "")] = content
    if tab not in names:
        raise UsageError(f"the recording has no tab {tab!r}; it has {', '.join(map(repr, names))}")
    root["active_tab"] = names[tab]
    viewer.set_blueprint(parts, store_id=current.store_id)


def _still_frame(viewer: Any) -> bytes:
    pause = threading.Event()
    frame = b""
    same = 1
    for _ in range(_STILL_ATTEMPTS):
        latest: bytes = viewer.take_screenshot()
        same = same + 1 if latest == frame else 1
        frame = latest
        if same >= _STILL_FRAMES:
            break
        pause.wait(_PAUSE_S)
    return frame
