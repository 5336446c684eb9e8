"""Ctrl-C and its relatives: stop at once, but never in the middle of writing what was flown."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""What asks a program to stop; a vehicle in the air is landed first, whichever it is."""


class _Hold:
    depth = 0
    pending = False


@contextmanager
def caught(first: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Turn every signal of STOPPING into KeyboardInterrupt; does nothing outside the main thread.

    Args:
        first: called at the first signal, to say that it was heard.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        nonlocal heard
        if not heard:
            heard = True
            first()
        if _Hold.depth:
            _Hold.pending = True
        else:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, stop) for number in STOPPING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def held() -> Iterator[None]:
    """Keep a signal that comes meanwhile until the end of this block."""
    _Hold.depth += 1
    try:
        yield
    finally:
        _Hold.depth -= 1
    if _Hold.pending and not _Hold.depth:
        _Hold.pending = False
        raise KeyboardInterrupt


@contextmanager
def kept_from_children() -> Iterator[None]:
    """Processes started in this block never see Ctrl-C: their parent hears it, too, and decides."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
