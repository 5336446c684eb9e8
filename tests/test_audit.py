"""What `make audit` says of what pip-audit found: nothing that was not looked up is taken for sound."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
SOUND = {"name": "a", "version": "1.0", "vulns": []}
BAD = {"name": "b", "version": "2.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2.1"]}]}
HOPELESS = {"name": "c", "version": "3.0", "vulns": [{"id": "PYSEC-2", "fix_versions": []}]}
SKIPPED = {"name": "d", "skip_reason": "not found"}


@pytest.mark.parametrize(
    ("packages", "status", "says"),
    [
        ([SOUND, SOUND], 0, ["0 known vulnerabilities in 2 versions"]),
        ([SOUND, BAD], 1, ["b 2.0: PYSEC-1, mended in 2.1", "1 known vulnerabilities in 2 versions"]),
        ([HOPELESS], 1, ["c 3.0: PYSEC-2, mended in no version yet"]),
        ([SOUND, SKIPPED], 2, ["in 1 versions", "1 of 2 could not be looked up (d)", "Is there a network"]),
        ([BAD, SKIPPED], 1, ["PYSEC-1", "1 of 2 could not be looked up"]),
        ([], 2, ["0 known vulnerabilities in 0 versions"]),
        (None, 2, ["no audit: the database of advisories was not reached (a connection failed)"]),
    ],
)
def test_what_is_said(tmp_path: Path, packages: list[Any] | None, status: int, says: list[str]) -> None:
    found, log = tmp_path / "audit.json", tmp_path / "audit.log"
    log.write_text("x\na connection failed\n")
    if packages is not None:
        found.write_text(json.dumps({"dependencies": packages, "fixes": []}))
    command = [sys.executable, str(ROOT / ".ci" / "audit_result.py"), str(found), str(log)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, "")
    assert all(text in done.stdout for text in says), done.stdout
