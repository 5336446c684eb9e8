"""What is better among candidates that pass alike: a metric, one way or the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scenarios.analysis import HIGH_IS_GOOD, SHOWN_MARGINS
from scenarios.batch_flight import metrics_of
from scenarios.limits import METRICS
from scenarios.manoeuvres import Manoeuvre
from sitl.keyed_table import KeyedTable, nearest

STATISTICS = ("nominal", "worst", "median", "best")


@dataclass(frozen=True)
class Objective:
    """A number of every point that is to be small, or large.

    Attributes:
        metric: name of `scenarios.limits.METRICS`. statistic: over the samples, one of STATISTICS.
        maximise: large is good.
    """

    metric: str
    statistic: str
    maximise: bool

    @property
    def column(self) -> str:
        """Its column in the dataset."""
        return f"{self.metric}_{self.statistic}"


def parse_objectives(file: KeyedTable, manoeuvres: Sequence[Manoeuvre], margins: bool) -> tuple[Objective, ...]:
    """The list `objectives` of a sweep file: `"rise_time_s"`, or with the statistic, `"rise_time_s_median"`.

    Args:
        file: of the sweep. manoeuvres: what is measured. margins: they are worked out, too.

    Raises:
        FileError: no such metric, or it is not measured.
    """
    measured = [*metrics_of(manoeuvres), *(SHOWN_MARGINS if margins else ())]
    texts = file.texts("objectives")
    if not texts:
        wanted = ["rise_time_s", "delay_margin_s", "overshoot_pct", "rms_error_deg", "lag_s", "rms_delta_lat"]
        texts = tuple([name for name in wanted if name in measured][:2])
    objectives = tuple(_objective(file, text, measured) for text in texts)
    for k, one in enumerate(objectives):
        if one in objectives[:k]:
            raise file.error("objectives", f'"{texts[k]}" is named twice', "Name it once")
    return objectives


def _objective(file: KeyedTable, text: str, measured: Sequence[str]) -> Objective:
    metric, statistic = text, "worst"
    for one in STATISTICS:
        if text.endswith(f"_{one}"):
            metric, statistic = text.removesuffix(f"_{one}"), one
    if metric not in measured:
        why = "is not measured by these manoeuvres" if metric in METRICS else f"is no metric{nearest(metric, measured)}"
        raise file.error("objectives", f'"{text}" {why}', f"Measured are {', '.join(measured)}")
    return Objective(metric, statistic, metric in HIGH_IS_GOOD)
