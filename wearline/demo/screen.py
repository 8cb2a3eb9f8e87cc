"""What the demo shows on a terminal, from 60 columns on; pure apart from being drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from wearline.demo.tally import Row, Summary
from wearline.messages import Decision, WearTrend

# Shape and word beside colour: a verdict must be legible without colours.
_SHAPE = {
    Decision.PASSED: ("✔ PASSED", "bold green"),
    Decision.FAILED: ("✘ FAILED", "bold red"),
    Decision.UNSURE: ("? UNSURE", "bold yellow"),
    Decision.NOT_MEASURED: ("– NOT MEASURED", "bold magenta"),
}
_BARS = "▁▂▃▄▅▆▇█"
_WIDE = 96
"""Columns from which all figures have room."""


@dataclass(frozen=True)
class Picture:
    """All that the screen shows at one moment."""

    address: str
    services: Mapping[str, bool] = field(default_factory=dict)
    """Name -> is it there."""
    is_plc_linked: bool = False
    rows: Sequence[Row] = ()
    """Oldest first."""
    trend: WearTrend | None = None
    limit_mm: float = 0.0
    note: str = ""
    wanted: int | None = None
    """Strokes of this run; None = until Ctrl-C."""


def verdict_text(decision: Decision) -> Text:
    """Shape, word and colour."""
    word, style = _SHAPE[decision]
    return Text(word, style)


def _figure(value: float | None, digits: int = 3, signed: bool = False) -> str:
    if value is None:
        return "–"
    return f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"


def sparkline(values: Sequence[float], width: int) -> str:
    """The values as bars from 0 to the largest, the newest ones at the right."""
    shown = list(values)[-max(width, 1) :]
    top = max(shown, default=0.0)
    if top <= 0.0:
        return _BARS[0] * len(shown)
    return "".join(_BARS[min(int(len(_BARS) * max(v, 0.0) / top), len(_BARS) - 1)] for v in shown)


def draw(picture: Picture, width: int, height: int) -> RenderableType:
    """The whole screen for a terminal of this size."""
    head = Text.assemble(
        ("Wearline demo", "bold"), "  everything simulated  ", ("HMI ", "dim"), (picture.address, "bold cyan")
    )
    states = Text()
    for name, is_there in picture.services.items():
        states.append("● " if is_there else "○ ", "green" if is_there else "red")
        states.append(f"{name}  ", "" if is_there else "red")
    states.append("● PLC" if picture.is_plc_linked else "○ PLC no link", "green" if picture.is_plc_linked else "red")
    shown = max(height - 15, 3)
    parts: list[RenderableType] = [
        head, states, _strokes(picture.rows[-shown:], width, picture.limit_mm), _trend(picture, width),
    ]  # fmt: skip
    count = f"stroke {len(picture.rows)}" + (f" of {picture.wanted}" if picture.wanted is not None else "")
    parts.append(Text.assemble((count, "bold"), "   ", (picture.note, "italic"), "   Ctrl-C ends it", style="dim"))
    return Group(*parts)


def _strokes(rows: Sequence[Row], width: int, limit_mm: float) -> RenderableType:
    is_wide = width >= _WIDE
    table = Table(expand=False, header_style="dim", box=None, padding=(0, 1))
    table.add_column("stroke", justify="right")
    table.add_column("verdict", min_width=14, no_wrap=True)
    table.add_column("mean mm", justify="right")
    table.add_column("max mm", justify="right")
    table.add_column("ms", justify="right")
    if is_wide:
        table.add_column("wear mm", justify="right")
        table.add_column("mean error over limit", no_wrap=True)
    for row in rows:
        cells: list[RenderableType] = [
            str(row.stroke), verdict_text(row.decision), _figure(row.mean_mm), _figure(row.max_mm, signed=True),
            _figure(row.cycle_ms, 0),
        ]  # fmt: skip
        if is_wide:
            share = 0.0 if row.mean_mm is None or not limit_mm else row.mean_mm / limit_mm
            cells += [_figure(row.wear_mm), Text("█" * min(round(20 * share), 40), _SHAPE[row.decision][1])]
        table.add_row(*cells)
    return Panel(table, title="last strokes", title_align="left", border_style="dim")


def _trend(picture: Picture, width: int) -> RenderableType:
    trend = picture.trend
    if trend is None or not trend.points:
        return Panel(Text("no wear trend yet", "dim"), title="wear", title_align="left", border_style="dim")
    bars = Text(sparkline([wear for _, wear in trend.points], width - 6), "cyan")
    slope = trend.slope_mm_per_kilostroke
    words = [f"wear {_figure(trend.wear_mm)} mm", f"limit {_figure(trend.limit_mm)} mm"]
    words.append("slope –" if slope is None else f"slope {slope:.2f} mm per 1000 strokes")
    if trend.remaining_p50 is None:
        words.append("strokes left: not identifiable yet")
    else:
        words.append(
            f"strokes left {trend.remaining_p50:.0f} ({trend.remaining_p10 or 0:.0f}–{trend.remaining_p90 or 0:.0f})"
        )
    words.append(f"{trend.strokes_since_service} since service")
    return Panel(Group(bars, Text("   ".join(words))), title="wear", title_align="left", border_style="dim")


def line(row: Row) -> str:
    """One stroke as a line of a log."""
    return (
        f"stroke {row.stroke:>5}  {row.decision.value:<12}  mean {_figure(row.mean_mm)} mm  "
        f"max {_figure(row.max_mm, signed=True)} mm  wear {_figure(row.wear_mm)} mm  {_figure(row.cycle_ms, 0)} ms"
        + (f"  {row.reason}" if row.decision is Decision.NOT_MEASURED and row.reason else "")
    )


def summary_lines(summary: Summary, scan_ms: float, seconds: float) -> list[str]:
    """The end of a run."""
    counts = ", ".join(f"{count} {decision.value}" for decision, count in summary.counts.items() if count)
    flip = (
        f"verdict turned at stroke {summary.flipped_at or '–'}, the true mean error crossed the limit at stroke "
        f"{summary.true_flip_at or '–'}"
    )
    lines = [
        f"{summary.strokes} strokes in {seconds:.0f} s: {counts or 'none'}",
        f"truth: {summary.agreed} of {summary.judged} verdicts right (parts near the limit aside); {flip}",
        f"records: {summary.records} of {summary.strokes}; PLC log agrees on {summary.plc_agreed} of {summary.strokes}",
        f"Measure to Measure finished: median {summary.median_ms:.0f} ms, 99th percentile {summary.p99_ms:.0f} ms "
        f"(10 ms exposure counted in, PLC scan {scan_ms:g} ms)",
    ]
    if summary.false_passed:
        lines.append(f"FALSE PASSED at strokes {', '.join(map(str, summary.false_passed))}")
    if summary.disagreed:
        lines.append(f"verdicts against the truth at strokes {', '.join(map(str, summary.disagreed))}")
    lines.append("as promised" if summary.is_right else "NOT as promised")
    return lines
