"""Says what pip-audit has found, and what it could not look at: it takes an advisory it cannot reach for none.

    python .ci/audit_result.py AUDIT.json AUDIT.log

Status 0: every version was looked up and none has a known vulnerability. 1: some have. 2: not every one was looked up.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def result(found: Path, log: Path) -> tuple[int, list[str]]:
    """Status and lines for people.

    Args:
        found: pip-audit's JSON; it need not exist. log: what pip-audit printed.
    """
    try:
        packages = json.loads(found.read_text(encoding="utf-8"))["dependencies"]
    except (OSError, ValueError, KeyError):
        said = log.read_text(errors="replace").strip().splitlines() if log.is_file() else []
        why = said[-1] if said else "pip-audit printed nothing"
        return 2, [f"no audit: the database of advisories was not reached ({why})"]
    lines = [
        f"{one['name']} {one['version']}: {bug['id']}, mended in {', '.join(bug['fix_versions']) or 'no version yet'}"
        for one in packages
        for bug in one.get("vulns", ())
    ]
    vulnerable = len(lines)
    skipped = [one for one in packages if "skip_reason" in one]
    looked = len(packages) - len(skipped)
    lines.append(f"{vulnerable} known vulnerabilities in {looked} versions that were looked up")
    if skipped:
        names = ", ".join(one["name"] for one in skipped[:5]) + (" ..." if len(skipped) > 5 else "")
        lines.append(
            f"{len(skipped)} of {len(packages)} could not be looked up ({names}): nothing is known of those. Is there "
            "a network, and does the package index in use pass advisories on?"
        )
    return 1 if vulnerable else 2 if skipped or not packages else 0, lines


if __name__ == "__main__":
    status, told = result(Path(sys.argv[1]), Path(sys.argv[2]))
    sys.stdout.write("\n".join(told) + "\n")
    sys.exit(status)
