"""The README and the code say the same: commands, files, tables, scripts and measured figures."""

from __future__ import annotations

import contextlib
import fnmatch
import io
import json
import re
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from scenarios import cli
from scenarios.limits import LIMIT_CYCLE_RAD_S, METRICS
from scenarios.manoeuvres import KINDS
from scenarios.profile_items import PROFILE_ITEMS
from scenarios.telemetry import COLUMNS
from sitl.errors import FileError, LinkError, UsageError
from sitl.parameters import ParameterTable
from sitl.profile import PROFILES

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS: list[tuple[str, str]] = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
COMMANDS = [
    line.partition("#")[0].split()[1:]
    for language, block in BLOCKS
    if language == "sh"
    for line in block.splitlines()
    if line.startswith("froude ")
]
"""Every command line shown, without the program's name."""

FILES = {
    match.group(1): block
    for language, block in BLOCKS
    if language in ("toml", "text") and (match := re.match(r"# (\S+\.(?:toml|params))\n", block))
}
"""Every file shown: its name stands in its first line."""
