"""A TOML file as a plain dict, every way it can fail told in one line."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from sitl.errors import FileError
from sitl.plain_file import check_plain


def read_toml(path: Path) -> dict[str, Any]:
    """The whole file.

    Raises:
        FileError: it cannot be read, is no plain file or too large, is not UTF-8, or is not TOML.
    """
    check_plain(path)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(path, f"cannot be read: {error.strerror or error}", "Check the path") from error
    except (ValueError, RecursionError) as error:  # bad TOML and bad UTF-8 are ValueErrors
        raise FileError(path, f"not a TOML file: {error}", "Correct the line it names") from error


def quoted(text: str) -> str:
    """A basic string of TOML; control characters become spaces.

    Args:
        text: any.
    """
    safe = re.sub(r"[\x00-\x1f\x7f]", " ", text)
    return '"' + safe.replace("\\", "\\\\").replace('"', '\\"') + '"'
