"""What differs between a real autopilot and our own, as text: a table of the response, one of everything else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from scenarios.flight_import import is_recording
from scenarios.markdown import markdown_table
from scenarios.table import COLUMNS, SPARED, UNSET, WIDE, cells, number
from scenarios.twin import Quantity, Twin

OWN, DIFFERENCE = "  own autopilot", "  difference"

_SHOWN: Mapping[str, tuple[str, int]] = {
    # quantity: (name in sentences, decimals); the unit of the difference is that of `QUANTITIES`
    "overshoot_pct": ("overshoot", 1),
    "settling_time_5pct_s": ("settling time (5 %)", 3),
    "settling_time_2pct_s": ("settling time (2 %)", 3),
    "rise_time_s": ("rise time", 3),
    "droop_deg": ("droop", 2),
    "vaf_pct": ("VAF", 1),
    "oscillation_hz": ("frequency", 2),
    "oscillation_rad_s": ("amplitude", 1),
    "peak_delta_lat": ("peak delta_lat", 2),
    "roll_difference_deg": ("roll, RMS", 2),
    "roll_estimate_error_deg": ("estimate", 2),
}

_RESPONSE = tuple(column for column in COLUMNS if column.metrics[0] not in ("delay_margin_s", "rms_error_deg"))
"""Columns of the main table that two flights may differ in; the margin is computed, not flown."""

_COLOURS = {"PASS": "green", "FAIL": "red", "UNSET": "yellow", "agree": "bold green", "differs": "bold red"}

_PAIRED: tuple[tuple[str, Callable[[Twin], str]], ...] = (
    # heading, cell
    ("Hold/roll|rad/s", lambda twin: _both(twin, "hold_p_std_rad_s", 2)),
    ("Hold/pitch|rad/s", lambda twin: _both(twin, "hold_q_std_rad_s", 2)),
    ("take-/off|s", lambda twin: _both(twin, "takeoff_time_s", 1)),
    ("touch-/down|m/s", lambda twin: _both(twin, "touchdown_m_s", 2)),
    ("land to/disarm|s", lambda twin: _both(twin, "landing_time_s", 1)),
    ("estimate/off|deg", lambda twin: _both(twin, "estimate_error_rms_deg", 2)),
    ("and/late|ms", lambda twin: _both(twin, "estimate_late_s", 0, 1e3)),
    ("satu-/rated|%", lambda twin: _both(twin, "saturated_high_pct", 0)),
)

_PAIRED_SPARED = ("Hold/pitch|rad/s", "satu-/rated|%")


def _both(twin: Twin, name: str, decimals: int, factor: float = 1.0) -> str:
    quantity = twin.difference.quantity(name)
    values = (None, None) if quantity is None else (quantity.real, quantity.own)
    return "/".join(number(None if value is None else factor * value, decimals) for value in values)


def signed(value: float | None, decimals: int) -> str:
    """A difference with its sign; none for what rounds to nothing."""
    text = number(value, decimals)
    return f"+{text}" if value is not None and value > 0.0 and text.strip("0.") else text


def response(twins: Sequence[Twin], spared: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """The response as a table: three rows per gain set, real, own and difference.

    Args:
        twins: at least one. spared: metrics whose columns are left out.

    Returns:
        headings, "/" breaking the line and "|" before the unit; rows. Columns that no flight filled are left out.
    """
    columns = [column for column in _RESPONSE if column.metrics[0] not in spared]
    head = ["gain set", *(f"{column.title}|{column.unit}" for column in columns), "roll/RMS|deg", "verdict"]
    rows = []
    for twin in twins:
        for name, flight in ((twin.name, twin.flight), (OWN, twin.own)):
            texts = {column.metrics[0]: text for column, (text, _) in zip(COLUMNS, cells(flight), strict=True)}
            rows.append([name, *(texts[column.metrics[0]] for column in columns), "", str(flight.outcome)])
        last = [
            _oscillation(twin) if len(column.metrics) > 1 else _difference(twin, column.metrics[0])
            for column in columns
        ]
        verdict = "agree" if twin.difference.agree else "differs"
        rows.append([DIFFERENCE, *last, _difference(twin, "roll_difference_deg").removeprefix("+"), verdict])
    filled = [k for k in range(len(head)) if any(row[k].strip(UNSET) for row in rows)]
    return [head[k] for k in filled], [[row[k] for k in filled] for row in rows]


def _difference(twin: Twin, name: str) -> str:
    quantity = twin.difference.quantity(name)
    return UNSET if quantity is None else signed(quantity.difference, _SHOWN[name][1])


def _oscillation(twin: Twin) -> str:
    """Of a limit cycle: amplitude in per cent and frequency in Hz."""
    both = [twin.difference.quantity(name) for name in ("oscillation_rad_s", "oscillation_hz")]
    if any(one is None or one.difference is None for one in both):
        return UNSET
    percent, hertz = (one.difference for one in both if one is not None)
    return f"{signed(percent, 1)}% {signed(hertz, 2)}"


def complaint(twin: Twin) -> str:
    """What differs by more than is tolerated, in a line; empty if the two agree."""
    difference = twin.difference
    if difference.agree:
        return ""
    parts = [] if difference.verdicts_agree else [f"verdict {twin.flight.outcome} instead of {twin.own.outcome}"]
    if difference.alone:
        who = "our own" if len(twin.own.segments) > len(twin.flight.segments) else "the real one"
        parts.append(f"only {who} came to {', '.join(difference.alone)}")
    # amplitude and frequency have the same reason if only one of them is in a limit cycle: it is said once
    parts += dict.fromkeys(_sentence(one) for one in difference.outside())
    return f"{twin.name} differs: " + "; ".join(parts)


def remarks(twins: Sequence[Twin]) -> list[str]:
    """Per gain set that differs: a warning that names both verdicts if they do, and what is beyond its tolerance."""
    lines = []
    for twin in twins:
        lines += [f"warning: {twin.warning}"] if twin.warning else []
        lines += [complaint(twin)] if not twin.difference.agree else []
    return lines


def _sentence(one: Quantity) -> str:
    name, decimals = _SHOWN[one.name]
    where = f" ({one.segment})" if one.segment else ""
    if one.difference is None:
        return one.reason if one.name.startswith("oscillation") else f"{name}{where}: {one.reason}"
    if one.name == "roll_estimate_error_deg":
        return f"{name} off by {number(one.real, decimals)} deg ({one.tolerance:g} allowed)"
    amount = signed(one.difference, decimals)
    reason = f"; {one.reason}" if one.reason else ""
    return f"{name}{where} {amount} {one.unit} ({one.tolerance:g} allowed{reason})"


def headline(twins: Sequence[Twin]) -> str:
    """How many gain sets agree."""
    agreeing = sum(twin.difference.agree for twin in twins)
    what = "The real autopilot beside our own, same gains, plant and seed"
    if any(twin.flight.gain_set.path and is_recording(twin.flight.gain_set.path) for twin in twins):
        what = "The recorded flight beside our own autopilot on the model, same gains and set-points"
    return (
        f"{what}: {agreeing} of {len(twins)} "
        f"gain set{'s' if len(twins) != 1 else ''} agree{'s' if len(twins) == 1 else ''} within the tolerances."
    )


def rich_tables(twins: Sequence[Twin], width: int) -> tuple[Any, Any]:
    """For a terminal: the response, and AUTO modes, ground, estimate and saturation as real/own.

    Args:
        twins: at least one. width: columns of the terminal.
    """
    from rich.text import Text

    head, rows = response(twins, () if width >= WIDE else SPARED)
    table = _rich(head[0])
    for title in head[1:]:
        table.add_column(_broken(title), justify="left" if title == head[-1] else "right", no_wrap=True)
    for row in rows:
        style = "bold" if row[0] == DIFFERENCE else ""
        table.add_row(
            *(Text(text, style=style) for text in row[:-1]),
            Text(row[-1], style=_COLOURS.get(row[-1], "")),
            end_section=row[0] == DIFFERENCE,
        )
    rest = _rich("gain set")
    paired = [one for one in _PAIRED if width >= WIDE or one[0] not in _PAIRED_SPARED]
    for title, _ in paired:
        rest.add_column(_broken(title), justify="right", no_wrap=True)
    for twin in twins:
        rest.add_row(twin.name, *(cell(twin) for _, cell in paired))
    return table, rest


def _broken(title: str) -> str:
    name, _, unit = title.partition("|")
    return "\n".join(filter(None, (*name.split("/"), unit)))


def _joined(title: str) -> str:
    name, _, unit = title.partition("|")
    name = name.replace("-/", "").replace("/_", "_").replace("/", " ")
    return f"{name} [{unit}]" if unit else name


def _rich(*first: str) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    for title in first:
        table.add_column(title, overflow="fold")
    return table


def markdown(twins: Sequence[Twin]) -> str:
    """The same for a page of a recording."""
    head, rows = response(twins)
    rest = [[twin.name, *(cell(twin) for _, cell in _PAIRED)] for twin in twins]
    parts = [
        f"### {headline(twins)}",
        markdown_table([_joined(title) for title in head], rows, (0, len(head) - 1)),
        "\n".join(f"- {line}" for line in remarks(twins)),
        "### AUTO modes, ground, estimate, saturation: real/own",
        markdown_table(["gain set", *(_joined(title) for title, _ in _PAIRED)], rest),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"
