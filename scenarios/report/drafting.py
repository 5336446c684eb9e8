"""A run's report is prepared by a process of its own while the run is flown.

Importing a plotting library, the uncertain models and the loops take longer than a flight; on a second core they take
no time at all. A report that fails never loses the run.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from scenarios.report import helper
from sitl.errors import FileError

MOST_S = 300.0
"""A helper that has not written the report by then is given up."""


class ReportDraft:
    """The report of a run that is being flown; a context manager.

    Args:
        data: what `run.json` will say of scenario, vehicle and profile.
        sets: name, baseline and uploaded of every flight, in the order of the run.
        behind: what flies has the cores first. On a busy computer the page is late then.
    """

    def __init__(self, data: Mapping[str, Any], sets: Iterable[Mapping[str, Any]], *, behind: bool = False) -> None:
        self._words = [helper.BEHIND] if behind else []
        self._known = json.dumps({"data": data, "sets": list(sets)})
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._sending: threading.Thread | None = None
        self._folder = Path()

    def __enter__(self) -> Self:
        command = [sys.executable, "-P", "-m", "scenarios.report.helper", *self._words]
        with suppress(OSError, ValueError):
            # in a session of its own it does not hear Ctrl-C: the run decides what becomes of it
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                encoding="utf-8",
                start_new_session=True,
            )
            # who flies never waits for a helper that has no time to read
            self._sending = threading.Thread(target=_send, args=(process.stdin, self._lines), daemon=True)
            self._sending.start()
            self._lines.put(self._known)
            self._process, process.stdin = process, None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def landed(self, number: int, flight: Mapping[str, Any], telemetry: Path) -> None:
        """Let a flight that is over be drawn.

        Args:
            number: in the order of the run. flight: as in `run.json`. telemetry: its file.
        """
        if self._process is not None:
            self._lines.put(json.dumps({"number": number, "flight": flight, "telemetry": str(telemetry.resolve())}))

    def begin(self, folder: Path) -> None:
        """Let the report be written: `run.json` and the flights' files are there.

        Args:
            folder: of the run.
        """
        self._folder = folder
        self._lines.put(json.dumps({"write": str(folder.resolve())}))
        self._lines.put(None)

    def finish(self) -> Path:
        """Wait for the report that was begun.

        Returns:
            the page's path.

        Raises:
            FileError: it could not be written.
        """
        answer = self._answer()
        if "wrote" in answer:
            return self._folder / Path(answer["wrote"]).name
        if "failed" in answer:
            raise FileError(self._folder, f"no report: {answer['failed']}", "`froude review --html` tries again")
        # no helper, or none any more: out of memory, or not allowed here
        from scenarios.report import write_report

        return write_report(self._folder)

    def _answer(self) -> dict[str, str]:
        process = self._process
        if process is None:
            return {}
        try:
            answer = json.loads(process.communicate(timeout=MOST_S)[0])
        except (OSError, ValueError, subprocess.TimeoutExpired):
            return {}
        finally:
            self._end()
        return answer if isinstance(answer, dict) else {}

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(OSError):
            process.kill()
        self._lines.put(None)
        if self._sending is not None:
            self._sending.join()
        if process.stdout is not None:
            with suppress(OSError):
                process.stdout.close()
        process.wait()


def _send(stdin: IO[str], lines: queue.SimpleQueue[str | None]) -> None:
    """Until there is None, or nobody reads any more."""
    with suppress(OSError, ValueError), stdin:
        while (line := lines.get()) is not None:
            stdin.write(line + "\n")
            stdin.flush()
