"""A part's report as PDF, one page: what was decided, why, where, and by which references."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from reportlab.lib import colors
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle, getSampleStyleSheet
from reportlab.lib.units import mm
from reportlab.platypus import Image, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle

from wearline.messages import Decision, Outcome, Verdict

U8 = NDArray[np.uint8]
_INK = {
    Decision.PASSED: colors.HexColor("#1b7f3b"), Decision.FAILED: colors.HexColor("#b3261e"),
    Decision.UNSURE: colors.HexColor("#9a6700"), Decision.NOT_MEASURED: colors.HexColor("#5f6368"),
}  # fmt: skip
_GRID = TableStyle([
    ("FONTSIZE", (0, 0), (-1, -1), 8), ("LEADING", (0, 0), (-1, -1), 10),
    ("LINEBELOW", (0, 0), (-1, -1), 0.25, colors.HexColor("#c7c7cc")), ("VALIGN", (0, 0), (-1, -1), "TOP"),
    ("TOPPADDING", (0, 0), (-1, -1), 2), ("BOTTOMPADDING", (0, 0), (-1, -1), 2), ("LEFTPADDING", (0, 0), (-1, -1), 2),
])  # fmt: skip
_MOST_ROWS = 8


@dataclass(frozen=True)
class Picture:
    """One picture and what stands below it."""

    title: str
    rgb: U8
    """(row, col, rgb), or (row, col) in grey."""


def write_report(
    path: Path, cell: str, record: int, utc: str, object_name: str, verdict: Verdict, outcome: Outcome | None,
    pictures: list[Picture],
) -> None:  # fmt: skip
    """Write the page.

    Raises:
        OSError: it cannot be written.
    """
    styles = getSampleStyleSheet()
    text = ParagraphStyle("text", parent=styles["Normal"], fontSize=8, leading=10)
    small = ParagraphStyle("small", parent=text, fontSize=6.5, leading=8, textColor=colors.HexColor("#5f6368"))
    title = ParagraphStyle("title", parent=styles["Title"], fontSize=16, leading=20, alignment=0, spaceAfter=2)
    said = ParagraphStyle("said", parent=title, textColor=_INK[verdict.decision])
    request = verdict.request
    story: list[object] = [
        Paragraph(f"Part {_safe(request.part_id) or '(no id)'}, stroke {request.stroke}", title),
        Paragraph(f"{verdict.decision.value}{' (simulated)' if verdict.is_simulated else ''}", said),
        Paragraph(_safe(verdict.reason), text),
        Spacer(1, 3 * mm),
        _table(_facts(cell, record, utc, object_name, verdict, outcome), text, (32 * mm, 58 * mm) * 2),
        Spacer(1, 3 * mm),
    ]
    if pictures:
        story += [_gallery(pictures, small), Spacer(1, 3 * mm)]
    if verdict.regions:
        head = ["region", "mean [mm]", "max [mm]", "p95 [mm]", "area", "at x, y [px]"]
        rows = [
            [
                str(n), f"{r.mean_mm:.3f} ± {r.sigma_mm:.3f}", f"{r.max_mm:+.3f}", f"{r.p95_mm:.3f}",
                f"{r.area_mm2:.0f} mm²" if r.area_mm2 is not None else f"{r.area_px} px",
                f"{r.col_px:.0f}, {r.row_px:.0f}",
            ]
            for n, r in enumerate(verdict.regions[:_MOST_ROWS], 1)
        ]  # fmt: skip
        story += [_table([head, *rows], text, (20 * mm, *(32 * mm,) * 5)), Spacer(1, 3 * mm)]
    if verdict.zones:
        head = ["zone", "mean [mm]", "max [mm]", "wear [mm]", "coverage", "within limits"]
        rows = [
            [
                _safe(z.name), _number(z.mean_error_mm), _number(z.max_error_mm), _number(z.wear_mm),
                f"{z.coverage:.0%}", "yes" if z.is_within else "no",
            ]
            for z in verdict.zones[:_MOST_ROWS]
        ]  # fmt: skip
        story += [_table([head, *rows], text, (45 * mm, *(27 * mm,) * 5)), Spacer(1, 3 * mm)]
    references = (
        ("frame", verdict.frame_hash), ("calibration", verdict.calibration_hash), ("template", verdict.template_hash),
        ("recipe", verdict.recipe_hash),
    )  # fmt: skip
    story.append(Paragraph("<br/>".join(f"{name} {digest or '(none)'}" for name, digest in references), small))
    story.append(Paragraph(f"computed by {_safe(verdict.code_version)}", small))
    buffer = io.BytesIO()
    SimpleDocTemplate(
        buffer, pagesize=A4, leftMargin=15 * mm, rightMargin=15 * mm, topMargin=12 * mm, bottomMargin=12 * mm,
        title=f"Part {request.part_id}, stroke {request.stroke}", author=f"Wearline, cell {cell}",
    ).build(story)  # fmt: skip
    path.write_bytes(buffer.getvalue())


def _facts(
    cell: str, record: int, utc: str, object_name: str, verdict: Verdict, outcome: Outcome | None
) -> list[list[str]]:
    request, motion = verdict.request, verdict.registration
    told = "not yet on record"
    if outcome is not None:
        told = f"code {outcome.code} after {outcome.cycle_seconds:.2f} s" if outcome.was_told else "nothing in time"
    return [
        ["cell", _safe(cell), "mean error", _number(verdict.mean_error_mm, "mm")],
        [
            "object",
            f"{request.object_index} {_safe(object_name)}",
            "maximum error",
            _number(verdict.max_error_mm, "mm"),
        ],
        ["measured", utc, "wear", _number(verdict.wear_mm, "mm")],
        ["cycle", _safe(verdict.cycle_id), "deviating area", _number(verdict.deviating_area_mm2, "mm²", 1)],
        ["record", f"entry {record} of the chain", "coverage", f"{verdict.coverage:.1%}"],
        ["result code", str(verdict.code), "lay off by", f"{motion.dz_mm:+.3f} mm in height"],
        ["PLC was told", told, "tilts", f"{motion.tilt_x_mrad:+.2f}, {motion.tilt_y_mrad:+.2f} mrad"],
    ]


def _number(value: float | None, unit: str = "", digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".strip()


def _safe(text: str) -> str:
    """Text for a paragraph, whose own marks are those of XML."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _table(rows: list[list[str]], style: ParagraphStyle, widths: tuple[float, ...]) -> Table:
    return Table([[Paragraph(cell, style) for cell in row] for row in rows], colWidths=list(widths), style=_GRID)


def _gallery(pictures: list[Picture], style: ParagraphStyle) -> Table:
    width = 88 * mm
    cells: list[list[object]] = []
    for picture in pictures:
        rgb = picture.rgb if picture.rgb.ndim == 2 else cv2.cvtColor(picture.rgb, cv2.COLOR_RGB2BGR)
        content = cv2.imencode(".png", rgb)[1].tobytes()
        rows, cols = picture.rgb.shape[:2]
        height = min(width * rows / cols, 62 * mm)
        cells.append([Image(io.BytesIO(content), height * cols / rows, height), Paragraph(picture.title, style)])
    if len(cells) % 2:
        cells.append([""])
    return Table(
        [cells[n : n + 2] for n in range(0, len(cells), 2)], colWidths=[90 * mm, 90 * mm],
        style=TableStyle([("VALIGN", (0, 0), (-1, -1), "TOP"), ("LEFTPADDING", (0, 0), (-1, -1), 0)]),
    )  # fmt: skip
