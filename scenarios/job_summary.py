"""The result as a short Markdown page, for the summary of a build server's job: `froude fly --markdown FILE`."""

from __future__ import annotations

from pathlib import Path

from scenarios.flight import RunRecord
from scenarios.markdown import markdown_table
from scenarios.report.verdict import SIGNS, Judged, verdict_of
from scenarios.run_folder import run_object, write_atomically
from scenarios.table import COLUMNS, assumption_lines, blank_cells, cells, own_gains_line

MOST_WARNINGS = 20


def write_job_summary(run: RunRecord, path: Path) -> Path:
    """Write the page.

    Raises:
        FileError: it cannot be written; what was there before is kept.
    """
    write_atomically(path, job_summary(run).encode("utf-8", "replace"))
    return path


def job_summary(run: RunRecord) -> str:
    """Verdict, a table with the reasons, what the verdict rests on.

    Args:
        run: as flown, also one that was interrupted.
    """
    verdict = verdict_of(run_object(run))
    vehicle = str(run.vehicle.get("name") or run.scenario.vehicle)
    parts = [f"## {_text(verdict.headline)}", _text(verdict.choice)]
    parts += ["\n".join(f"> **Before you trust this:** {_text(doubt)}." for doubt in verdict.doubts)]
    head = ["gain set", "verdict", *(_heading(column.name, column.unit) for column in COLUMNS), "why"]
    rows = [_row(run, one) for one in verdict.judged]
    parts += [markdown_table(head, rows, text_columns=(0, 1, len(head) - 1)) if rows else ""]
    parts += [_text(own_gains_line(run))]
    details = [f"- {_text(line)}" for line in blank_cells(run.flights)]
    warnings = [f"- {_text(f'{one.name}: warning: {text}')}" for one in verdict.judged for text in one.warnings]
    if len(warnings) > MOST_WARNINGS:
        warnings = [*warnings[:MOST_WARNINGS], f"- {len(warnings) - MOST_WARNINGS} more warnings in run.json"]
    details += warnings
    parts += ["\n".join(details)]
    limits = [f"{limit.metric} {limit}" for limit in run.scenario.limits]
    rests = [
        f"- scenario {run.scenario.name}, vehicle {vehicle}, profile {run.scenario.profile}, seed {run.scenario.seed}",
        f"- limits ({run.scenario.limits_name}): {', '.join(limits) or 'none'}",
        f"- {', '.join(assumption_lines(run))}" if run.profile else "",
        f"- froude {run.versions['froude']}" if "froude" in run.versions else "",
    ]
    told = "\n".join(_text(line, keep_dash=True) for line in rests if line)
    parts += [f"<details><summary>What this rests on</summary>\n\n{told}\n\n</details>"]
    return "\n\n".join(part for part in parts if part) + "\n"


def _row(run: RunRecord, one: Judged) -> list[str]:
    flight = run.flights[one.place]
    values = [text for text, _ in cells(flight)]
    return [_text(one.name), f"{SIGNS[one.outcome]} **{one.outcome}**", *values, _text(one.why)]


def _heading(name: str, unit: str) -> str:
    return _text(f"{name} [{unit}]" if unit else name)


def _text(text: str, *, keep_dash: bool = False) -> str:
    """Text that Markdown and HTML leave as it is, on one line.

    Args:
        text: of anybody. keep_dash: the dash of a list at its beginning is meant.
    """
    flat = " ".join(text.split())
    lead, rest = ("- ", flat[2:]) if keep_dash and flat.startswith("- ") else ("", flat)
    for character in "\\`*_[]$":
        rest = rest.replace(character, "\\" + character)
    return lead + rest.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
