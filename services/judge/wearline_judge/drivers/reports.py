"""Capability studies as a page for the browser and as a PDF to be signed."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Protocol

from reportlab.graphics.shapes import Circle, Drawing, Line, PolyLine, String
from reportlab.lib import colors
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle, getSampleStyleSheet
from reportlab.lib.units import mm
from reportlab.platypus import KeepTogether, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle

_WIDTH, _HEIGHT = 470.0, 190.0
_LEFT, _BOTTOM, _TOP, _RIGHT = 62.0, 34.0, 26.0, 74.0
_INK, _LEVEL, _GRID = "#1d3557", "#b3541e", "#c8ccd2"
_GOOD, _AMBER, _BAD = "#1b6e3c", "#8a5a00", "#a11d1d"
_TONE = {"capable": _GOOD, "conditionally capable": _AMBER}
"""Of an outcome; what is not named here is bad."""


class Chart(Protocol):
    """What a study's picture shows."""

    @property
    def x_name(self) -> str: ...
    @property
    def y_name(self) -> str: ...
    @property
    def x(self) -> Sequence[float]: ...
    @property
    def y(self) -> Sequence[float]: ...
    @property
    def levels(self) -> Sequence[tuple[str, float]]: ...
    @property
    def is_joined(self) -> bool: ...
    @property
    def fitted(self) -> Sequence[tuple[float, float]]: ...


class Figure(Protocol):
    """One line of a study's table."""

    @property
    def name(self) -> str: ...
    @property
    def value(self) -> float: ...
    @property
    def unit(self) -> str: ...
    @property
    def condition(self) -> str: ...
    @property
    def is_met(self) -> bool | None: ...


class Study(Protocol):
    """What a report needs of a study."""

    @property
    def title(self) -> str: ...
    @property
    def outcome(self) -> str: ...
    @property
    def sentence(self) -> str: ...
    @property
    def figures(self) -> Sequence[Figure]: ...
    @property
    def chart(self) -> Chart: ...
    @property
    def notes(self) -> Sequence[str]: ...


@dataclass(frozen=True)
class ReportHead:
    """What a report is about and who answers for it."""

    cell: str
    gauge: str
    """Head or camera, by the name that the plant gives it."""
    object_name: str
    utc: str
    """ISO 8601."""
    person: str = ""
    """Who made the study."""
    calibration_hash: str = ""
    template_hash: str = ""
    code_version: str = ""
    is_simulated: bool = False


@dataclass(frozen=True)
class _Scale:
    """Data to page, y upwards."""

    x0: float
    x1: float
    y0: float
    y1: float

    def x(self, value: float) -> float:
        return _LEFT + (value - self.x0) / (self.x1 - self.x0) * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        return _BOTTOM + (value - self.y0) / (self.y1 - self.y0) * (_HEIGHT - _BOTTOM - _TOP)


def _scale(chart: Chart) -> _Scale:
    heights = [*chart.y, *(height for _, height in chart.levels), *(y for _, y in chart.fitted)]
    low, high = min(heights, default=0.0), max(heights, default=1.0)
    room = 0.08 * (high - low) or 0.01
    first, last = min(chart.x, default=0.0), max(chart.x, default=1.0)
    beside = 0.03 * (last - first) or 0.5
    return _Scale(first - beside, last + beside, low - room, high + room)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers, four to ten of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step *= next(k for k in (5.0, 2.0, 1.0) if k * step <= (high - low) / 4.0)
    return [step * k for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _number(value: float) -> str:
    return f"{value:.4g}"


def _drawing(chart: Chart) -> Drawing:
    scale = _scale(chart)
    drawing = Drawing(_WIDTH, _HEIGHT)
    for value in _ticks(scale.y0, scale.y1):
        y = scale.y(value)
        drawing.add(Line(_LEFT, y, _WIDTH - _RIGHT, y, strokeColor=colors.HexColor(_GRID), strokeWidth=0.4))
        drawing.add(String(_LEFT - 4, y - 2.5, _number(value), fontSize=7, fontName="Helvetica", textAnchor="end"))
    for value in _ticks(scale.x0, scale.x1):
        drawing.add(
            String(scale.x(value), _BOTTOM - 11, _number(value), fontSize=7, fontName="Helvetica", textAnchor="middle")
        )
    for name, height in chart.levels:
        y = scale.y(height)
        drawing.add(Line(_LEFT, y, _WIDTH - _RIGHT, y, strokeColor=colors.HexColor(_LEVEL), strokeWidth=0.8))
        drawing.add(
            String(
                _WIDTH - _RIGHT + 4, y - 2.5, name, fontSize=7, fontName="Helvetica", fillColor=colors.HexColor(_LEVEL)
            )
        )
    points = [(scale.x(x), scale.y(y)) for x, y in zip(chart.x, chart.y, strict=True)]
    if chart.is_joined and len(points) > 1:
        flat = [v for point in points for v in point]
        drawing.add(PolyLine(flat, strokeColor=colors.HexColor(_INK), strokeWidth=0.7))
    for x, y in points:
        drawing.add(Circle(x, y, 1.7, fillColor=colors.HexColor(_INK), strokeColor=None))
    if chart.fitted:
        ends = [v for x, y in chart.fitted for v in (scale.x(x), scale.y(y))]
        drawing.add(Line(*ends, strokeColor=colors.HexColor(_LEVEL), strokeWidth=1.2))
    drawing.add(
        String(0.5 * (_LEFT + _WIDTH - _RIGHT), 4, chart.x_name, fontSize=8, fontName="Helvetica", textAnchor="middle")
    )
    drawing.add(String(2, _HEIGHT - 8, chart.y_name, fontSize=8, fontName="Helvetica"))
    return drawing


def _svg(chart: Chart) -> str:
    scale = _scale(chart)

    def at(y: float) -> str:
        return f"{_HEIGHT - scale.y(y):.1f}"

    right = _WIDTH - _RIGHT
    parts = [f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="{html.escape(chart.y_name)}">']
    for value in _ticks(scale.y0, scale.y1):
        parts.append(f'<line x1="{_LEFT}" x2="{right}" y1="{at(value)}" y2="{at(value)}" stroke="{_GRID}"/>')
        parts.append(f'<text x="{_LEFT - 4}" y="{at(value)}" class="end">{_number(value)}</text>')
    for value in _ticks(scale.x0, scale.x1):
        parts.append(f'<text x="{scale.x(value):.1f}" y="{_HEIGHT - _BOTTOM + 12}" class="mid">{_number(value)}</text>')
    for name, height in chart.levels:
        parts.append(f'<line x1="{_LEFT}" x2="{right}" y1="{at(height)}" y2="{at(height)}" stroke="{_LEVEL}"/>')
        parts.append(f'<text x="{right + 4}" y="{at(height)}" fill="{_LEVEL}">{html.escape(name)}</text>')
    pairs = [(f"{scale.x(x):.1f}", at(y)) for x, y in zip(chart.x, chart.y, strict=True)]
    if chart.is_joined:
        line = " ".join(",".join(pair) for pair in pairs)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{_INK}"/>')
    parts += [f'<circle cx="{x}" cy="{y}" r="1.8" fill="{_INK}"/>' for x, y in pairs]
    if chart.fitted:
        (xa, ya), (xb, yb) = chart.fitted
        ends = f'x1="{scale.x(xa):.1f}" y1="{at(ya)}" x2="{scale.x(xb):.1f}" y2="{at(yb)}"'
        parts.append(f'<line {ends} stroke="{_LEVEL}" stroke-width="1.4"/>')
    parts.append(f'<text x="{0.5 * (_LEFT + right)}" y="{_HEIGHT - 4}" class="mid">{html.escape(chart.x_name)}</text>')
    parts.append(f'<text x="2" y="9">{html.escape(chart.y_name)}</text></svg>')
    return "".join(parts)


def _shown(figure: Figure) -> tuple[str, str, str, str]:
    """Name, value with unit, what is asked, whether it is met."""
    met = "" if figure.is_met is None else ("met" if figure.is_met else "NOT met")
    return figure.name, f"{_number(figure.value)} {figure.unit}".strip(), figure.condition, met


def _facts(head: ReportHead) -> list[tuple[str, str]]:
    facts = [
        ("cell", head.cell), ("gauge", head.gauge), ("object", head.object_name), ("time (UTC)", head.utc),
        ("made by", head.person), ("calibration", head.calibration_hash[:12]), ("template", head.template_hash[:12]),
        ("software", head.code_version),
    ]  # fmt: skip
    return [(name, text) for name, text in facts if text]


_SIMULATED = "Simulated measurements: this report says nothing of a real gauge."
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#14181f;max-width:58rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}table{border-collapse:collapse;margin:.6rem 0}
td,th{border-bottom:1px solid #c8ccd2;padding:.25rem .8rem .25rem 0;text-align:left}td.n{text-align:right}
svg{width:100%;max-width:46rem}svg text{font-size:8px;dominant-baseline:middle}
svg .end{text-anchor:end}svg .mid{text-anchor:middle}
.simulated{border:2px solid #8a5a00;color:#8a5a00;padding:.5rem .8rem;font-weight:600}
.sign td{height:3rem;vertical-align:bottom;min-width:14rem}
"""


def html_report(head: ReportHead, studies: Sequence[Study]) -> str:
    """One page that needs nothing beside it."""
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f"<title>Gauge capability, {html.escape(head.cell)}</title><style>{_STYLE}</style></head><body>",
        "<h1>Gauge capability</h1>",
    ]
    if head.is_simulated:
        parts.append(f'<p class="simulated">{_SIMULATED}</p>')
    parts.append("<table>")
    parts += [f"<tr><th>{html.escape(n)}</th><td>{html.escape(t)}</td></tr>" for n, t in _facts(head)]
    parts.append("</table>")
    for study in studies:
        tone = _TONE.get(study.outcome, _BAD)
        parts.append(f"<section><h2>{html.escape(study.title)}</h2>")
        parts.append(f'<p style="color:{tone};font-weight:600">{html.escape(_sentence(study.sentence))}</p>')
        parts.append(_svg(study.chart))
        parts.append("<table><tr><th>figure</th><th>value</th><th>asked</th><th></th></tr>")
        for figure in study.figures:
            name, value, asked, met = (html.escape(t) for t in _shown(figure))
            parts.append(f'<tr><td>{name}</td><td class="n">{value}</td><td>{asked}</td><td>{met}</td></tr>')
        parts.append("</table>")
        parts += [f"<p>{html.escape(_sentence(note))}</p>" for note in study.notes]
        parts.append("</section>")
    parts.append('<table class="sign"><tr><td>date</td><td>name</td><td>signature</td></tr></table></body></html>')
    return "\n".join(parts)


def pdf_report(head: ReportHead, studies: Sequence[Study]) -> bytes:
    """The same for paper; equal input gives equal bytes."""
    styles = getSampleStyleSheet()
    body, title, heading = styles["BodyText"], styles["Title"], styles["Heading2"]
    story: list[object] = [Paragraph("Gauge capability", title)]
    if head.is_simulated:
        warned = ParagraphStyle(
            "simulated", parent=body, textColor=colors.HexColor("#8a5a00"), fontName="Helvetica-Bold"
        )
        story.append(Paragraph(_SIMULATED, warned))
    lines = TableStyle(
        [
            ("FONTSIZE", (0, 0), (-1, -1), 9),
            ("LINEBELOW", (0, 0), (-1, -1), 0.3, colors.HexColor(_GRID)),
            ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ]
    )
    story.append(
        Table([[n, Paragraph(html.escape(t), body)] for n, t in _facts(head)], (30 * mm, 140 * mm), style=lines)
    )
    for study in studies:
        tone = ParagraphStyle(
            "outcome", parent=body, textColor=colors.HexColor(_TONE.get(study.outcome, _BAD)), fontName="Helvetica-Bold"
        )
        rows = [["figure", "value", "asked", ""], *(list(_shown(f)) for f in study.figures)]
        block = [
            Paragraph(html.escape(study.title), heading),
            Paragraph(html.escape(_sentence(study.sentence)), tone),
            Spacer(1, 2 * mm),
            _drawing(study.chart),
            Table(rows, (62 * mm, 36 * mm, 52 * mm, 20 * mm), style=lines),
            *(Paragraph(html.escape(_sentence(note)), body) for note in study.notes),
        ]
        story.append(KeepTogether(block))
    signature = Table([["date", "name", "signature"]], (45 * mm, 60 * mm, 65 * mm), (16 * mm,))
    signature.setStyle(
        TableStyle(
            [
                ("LINEBELOW", (0, 0), (-1, -1), 0.6, colors.black),
                ("FONTSIZE", (0, 0), (-1, -1), 8),
                ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ]
        )
    )
    story += [Spacer(1, 8 * mm), signature]
    buffer = BytesIO()
    document = SimpleDocTemplate(
        buffer, pagesize=A4, title=f"Gauge capability, {head.cell}", author=head.person or "Wearline", invariant=1,
        leftMargin=20 * mm, rightMargin=20 * mm, topMargin=16 * mm, bottomMargin=16 * mm,
    )  # fmt: skip
    document.build(story)
    return buffer.getvalue()
