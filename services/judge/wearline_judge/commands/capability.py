"""``wearline capability``: is the gauge good enough? Studies from lists of values, from records, or from frames."""

from __future__ import annotations

import csv
import getpass
import json
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import content_hash
from wearline.cli import Command, progress
from wearline.errors import FrameError, UsageError
from wearline.messages import Decision
from wearline.offline import Chain, read_frame
from wearline_judge.commands.files import References, load_references
from wearline_judge.commands.stored import stored_cell
from wearline_judge.core.capability import Study, flatness, linearity, stability, step, type_1, type_3
from wearline_judge.drivers.fingerprint import code_version
from wearline_judge.drivers.reports import ReportHead, html_report, pdf_report

_FIGURES = ("mean_error_mm", "max_error_mm", "wear_mm")
F64 = NDArray[np.float64]


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("study", choices=("type1", "type3", "linearity", "stability", "flatness", "step"))
    parser.add_argument("frames", nargs="*", metavar="FRAME.png",
                        help="of a plate (type1, flatness) or a step (step), one per repeat or position")  # fmt: skip
    source = parser.add_argument_group("where the values come from")
    source.add_argument("--values", type=Path, metavar="V.csv", help="readings in mm: one per line (type1, stability),"
                        " one line per part (type3), or reference, reading, reading, ... (linearity)")  # fmt: skip
    source.add_argument("--config", type=Path, metavar="CELL.yaml", help="the records of a cell, with --part")
    source.add_argument("--part", action="append", default=[], metavar="ID", help="part id; type3: each one again")
    source.add_argument("--figure", choices=_FIGURES, default="max_error_mm", help="with --config")
    source.add_argument("--calibration", type=Path, metavar="C.npz", help="with frames")
    source.add_argument("--recipe", type=Path, metavar="R.yaml", help="with frames")
    limits = parser.add_argument_group("what is asked of the gauge")
    limits.add_argument("--reference", type=float, metavar="MM", help="true value (type1, stability, step)")
    limits.add_argument("--tolerance", type=float, metavar="MM", help="width of the part's tolerance")
    limits.add_argument("--limit", type=float, metavar="MM", help="largest error (flatness, step)")
    limits.add_argument("--low", metavar="X,Y,W,H", help="step: the lower face [px]")
    limits.add_argument("--high", metavar="X,Y,W,H", help="step: the upper face [px]")
    parser.add_argument("--gauge", default="", help="name of the head, for the report")
    parser.add_argument("--out", type=Path, metavar="REPORT", help=".pdf or .html")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")


def _run(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    out: Path | None = arguments.out
    if out is not None and (out.suffix.lower() not in (".pdf", ".html") or not out.parent.is_dir()):
        raise UsageError("is no .pdf or .html in a folder that is there", f"--out {out}", "name a report to write")
    references = None
    if arguments.frames:
        references = load_references(arguments.calibration, None, arguments.recipe)
    study = _study(arguments, references)
    if out is not None:
        head = _head(arguments, references)
        if out.suffix.lower() == ".pdf":
            out.write_bytes(pdf_report(head, [study]))
        else:
            out.write_text(html_report(head, [study]), encoding="utf-8")
    print(json.dumps(asdict(study)) if arguments.json else _table(study))
    return 0


def _study(arguments: Namespace, references: References | None) -> Study:
    kind: str = arguments.study
    if kind in ("flatness", "step"):
        if references is None:
            raise UsageError("needs frames", kind, "name one per position, and --calibration")
        clouds = [_cloud(name, points, references) for name, points in _points(arguments.frames, references)]
        limit = _number(arguments, "limit")
        if kind == "flatness":
            return flatness(clouds, limit)
        low, high = _box(arguments.low, "--low"), _box(arguments.high, "--high")
        scale = _scale(references)
        pairs = [(_within(cloud, low, scale), _within(cloud, high, scale)) for cloud in clouds]
        return step(pairs, _number(arguments, "reference"), limit)
    tolerance = _number(arguments, "tolerance")
    if kind == "type3":
        return type_3(_rows(arguments), tolerance)
    if kind == "linearity":
        rows = _rows(arguments)
        if any(len(row) < 2 for row in rows):
            raise UsageError("holds a line without readings", str(arguments.values), "write reference, reading, ...")
        return linearity([row[0] for row in rows], [row[1:] for row in rows], tolerance)
    values = _values(arguments, references)
    reference = _number(arguments, "reference")
    return type_1(values, reference, tolerance) if kind == "type1" else stability(values, reference, tolerance)


def _number(arguments: Namespace, name: str) -> float:
    value: float | None = getattr(arguments, name)
    if value is None or not np.isfinite(value):
        raise UsageError("is missing", f"--{name}", f"{arguments.study} needs it, in mm")
    return value


def _values(arguments: Namespace, references: References | None) -> list[float]:
    """One reading after another."""
    if references is not None:
        return [float(np.mean(points[:, 3])) for _, points in _points(arguments.frames, references)]
    return [value for row in _rows(arguments) for value in row]


def _rows(arguments: Namespace) -> list[list[float]]:
    """One row of readings per line of the file, or per part id of the records."""
    if arguments.values is not None:
        return _file_rows(arguments.values)
    if arguments.config is None or not arguments.part or arguments.study == "linearity":
        raise UsageError("has no values", arguments.study, "give --values V.csv, or --config CELL.yaml with --part ID")
    with stored_cell(arguments.config) as stored:
        found: dict[str, list[float]] = {part: [] for part in arguments.part}
        total = sum(stored.records.counts().values())
        for _, cycle in progress(stored.records.cycles(), "read", total):
            verdict = cycle.verdict
            if verdict is None or verdict.request.part_id not in found or verdict.decision is Decision.NOT_MEASURED:
                continue
            found[verdict.request.part_id].append(float(getattr(verdict, arguments.figure) or 0.0))
    missing = [part for part, values in found.items() if not values]
    if missing:
        raise UsageError("was never measured", f"part {missing[0]}", "see the production screen for part ids")
    return list(found.values())


def _file_rows(path: Path) -> list[list[float]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [[cell for cell in row if cell.strip()] for row in csv.reader(file)]
        found = [[float(cell) for cell in row] for row in rows if row]
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise UsageError(f"cannot be read ({error})", str(path), "write numbers in mm, parted by commas") from error
    if not found:
        raise UsageError("is empty", str(path), "write numbers in mm, parted by commas")
    return found


def _points(frames: Sequence[str], references: References) -> list[tuple[str, NDArray[np.float32]]]:
    """Line points of each frame; a study cannot leave one out in silence."""
    chain = Chain(references.recipe, references.calibration_bytes)
    found = []
    try:
        for name in progress(frames, "measure"):
            try:
                points = chain.line_points(read_frame(Path(name)))
            except FrameError as error:
                raise UsageError(error.what, name, "take it again") from error
            if points.refusal_code:
                raise UsageError(f"cannot be measured ({points.refusal})", name, "take it again")
            found.append((name, points.points))
    finally:
        chain.close()
    return found


def _scale(references: References) -> float:
    scale = references.calibration.mm_per_pixel
    scale = scale if np.isfinite(scale) else (references.recipe.mm_per_pixel or np.nan)
    if not np.isfinite(scale):
        raise UsageError("has no lateral scale", "calibration", "set mm_per_pixel in the recipe")
    return float(scale)


def _cloud(name: str, points: NDArray[np.float32], references: References) -> F64:
    """x, y, z in mm."""
    scale = _scale(references)
    return np.column_stack([points[:, 2] * scale, points[:, 1] * scale, points[:, 3]]).astype(np.float64)


def _box(text: str | None, option: str) -> tuple[float, float, float, float]:
    parts = (text or "").split(",")
    with suppress(ValueError):
        if len(parts) == 4:
            x, y, width, height = (float(part) for part in parts)
            return x, y, width, height
    raise UsageError(f"'{text or ''}' is not X,Y,W,H", option, "name the face as x,y,width,height in px")


def _within(cloud: F64, box: tuple[float, float, float, float], scale: float) -> F64:
    x, y = cloud[:, 0] / scale, cloud[:, 1] / scale
    return cloud[(x >= box[0]) & (x < box[0] + box[2]) & (y >= box[1]) & (y < box[1] + box[3])]


def _head(arguments: Namespace, references: References | None) -> ReportHead:
    person = ""
    with suppress(KeyError, OSError):
        person = getpass.getuser()
    cell = ""
    if arguments.config is not None:
        with stored_cell(arguments.config) as stored:
            cell = stored.cell.cell
    return ReportHead(
        cell=cell,
        gauge=arguments.gauge,
        object_name=", ".join(arguments.part),
        utc=datetime.now(UTC).isoformat(timespec="seconds"),
        person=person,
        calibration_hash=content_hash(references.calibration_bytes) if references else "",
        code_version=code_version(),
    )


def _table(study: Study) -> str:
    lines = [f"{study.title}: {study.outcome.value.upper()}", f"  {study.sentence}"]
    for figure in study.figures:
        met = "" if figure.is_met is None else ("  ok" if figure.is_met else "  NOT met")
        asked = f"  ({figure.condition})" if figure.condition else ""
        lines.append(f"  {figure.name:<34} {figure.value:>12.5g} {figure.unit}{asked}{met}")
    return "\n".join([*lines, *(f"  {note}" for note in study.notes)])


CAPABILITY = Command("capability", "is the gauge good enough: type 1 and 3, linearity, form", _configure, _run)
