"""A run's report is prepared by a process of its own while the run is flown.

Importing a plotting library, the uncertain models and the loops take longer than a flight; on a second core they take
no time at all. A report that fails never loses the run.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sitl.errors import FileError

MOST_S = 300.0
"""A helper that has not written the report by then is given up."""


class ReportDraft:
    """The report of a run that is being flown; a context manager.

    Args:
        data: what `run.json` will say of scenario, vehicle and profile.
        sets: name, baseline and uploaded of every flight, in the order of the run.
    """

    def __init__(self, data: Mapping[str, Any], sets: Iterable[Mapping[str, Any]]) -> None:
        self._known = json.dumps({"data": data, "sets": list(sets)})
        self._process: subprocess.Popen[str] | None = None
        self._folder = Path()

    def __enter__(self) -> Self:
        command = [sys.executable, "-P", "-m", "scenarios.report.helper"]
        with suppress(OSError, ValueError):
            # in a session of its own it does not hear Ctrl-C: the run decides what becomes of it
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                encoding="utf-8",
                start_new_session=True,
            )
            self._send(self._known)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def begin(self, folder: Path) -> None:
        """Let the report be written: `run.json` and the flights' files are there.

        Args:
            folder: of the run.
        """
        self._folder = folder
        with suppress(OSError, ValueError):
            self._send(json.dumps({"write": str(folder.resolve())}))

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

    def _send(self, line: str) -> None:
        process = self._process
        if process is not None and process.stdin is not None:
            process.stdin.write(line + "\n")
            process.stdin.flush()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(OSError):
            process.kill()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
        process.wait()
