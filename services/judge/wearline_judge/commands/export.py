"""``wearline export`` and ``wearline import``: records, maps and reports for other programs, and records back."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration, Template
from wearline.cli import Command, progress
from wearline.config import load_cell, validated
from wearline.errors import RecordError, UsageError
from wearline.messages import AskRecords, LinePoints, Verdict, View
from wearline.surface import dense_map
from wearline_judge.commands.stored import OF_THE_FRAME, StoredCell, stored_cell
from wearline_judge.config import JudgeSettings
from wearline_judge.core.pictures import colours, ply, tiff16
from wearline_judge.drivers.part_report import Picture, write_report
from wearline_judge.drivers.tables_io import read_cycles, row_of, write_csv, write_parquet
from wearline_judge.service import open_records

_AT_ONCE = 500
"""Cycles in one transaction: the judge must get a turn between two."""
_RECORD_FILES, _MAP_FILES = (".csv", ".parquet"), (".ply", ".tif", ".tiff")
F32 = NDArray[np.float32]


def _configure_export(parser: ArgumentParser) -> None:
    parser.add_argument("what", choices=("records", "map", "report"))
    parser.add_argument("cycle_id", nargs="?", metavar="CYCLE_ID", help="map and report only")
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE",
                        help="records: .csv or .parquet; map: .ply or .tif (16 bit); report: .pdf")  # fmt: skip
    parser.add_argument("--object", type=int, metavar="N", help="records only: of one object")
    parser.add_argument("--last", type=int, metavar="N", help="records only: the newest N")
    parser.add_argument("--map", choices=("measured", "standard", "difference"), default="measured", help="map only")


def _run_export(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    out: Path = arguments.out
    if out.is_dir() or not out.parent.is_dir():
        raise UsageError("is a folder" if out.is_dir() else "lies in no folder", f"--out {out}", "name a file to write")
    kinds = {"records": _RECORD_FILES, "map": _MAP_FILES, "report": (".pdf",)}[arguments.what]
    if out.suffix.lower() not in kinds:
        raise UsageError(f"is no {' or '.join(kinds)}", f"--out {out}", f"{arguments.what} are written as those")
    if (arguments.cycle_id is None) != (arguments.what == "records"):
        raise UsageError(
            "is missing" if arguments.cycle_id is None else "goes with map and report", "CYCLE_ID",
            "the production screen lists the cycles",
        )  # fmt: skip
    if arguments.last is not None and arguments.last < 1:
        raise UsageError(f"{arguments.last} records cannot be", "--last", "give 1 or more")
    with stored_cell(arguments.config) as stored:
        if arguments.what == "records":
            return _records(stored, arguments)
        recorded = stored.verdict(arguments.cycle_id)
        if arguments.what == "report":
            return _report(stored, recorded, out)
        return _map(stored, recorded, arguments.map, out)


def _records(stored: StoredCell, arguments: Namespace) -> int:
    total = sum(stored.records.counts(arguments.object).values())
    if arguments.last is not None:
        total = min(total, arguments.last)
    found = progress(stored.records.cycles(arguments.last, arguments.object), "export", total)
    rows = (row_of(number, cycle) for number, cycle in found)
    out: Path = arguments.out
    count = write_parquet(out, rows) if out.suffix.lower() == ".parquet" else write_csv(out, rows)
    print(f"{out}: {count} records")
    return 0


def _map(stored: StoredCell, recorded: Verdict, which: str, out: Path) -> int:
    _, _, points, _ = stored.computed(recorded)
    calibration = Calibration.from_bytes(stored.blobs.artifact(recorded.calibration_hash), "calibration")
    z, roi = _chosen(stored, recorded, points, calibration, which)
    if out.suffix.lower() != ".ply":
        out.write_bytes(tiff16(z))
        print(f"{out}: {which} map, {z.shape[1]} x {z.shape[0]} px, steps and offset in its description")
        return 0
    scale = _scale(stored, recorded, calibration)
    row, col = np.nonzero(np.isfinite(z))
    x, y = (col + roi[0]).astype(np.float32) * scale, (row + roi[1]).astype(np.float32) * scale
    unit = "mm" if scale != 1.0 else "x and y in px, z in mm"
    content = ply(
        x.astype(np.float32), y.astype(np.float32), z[row, col], (), (), f"cycle {recorded.cycle_id}, {which}, {unit}"
    )
    out.write_bytes(content)
    print(f"{out}: {which} map, {len(row)} points, {unit}")
    return 0


def _chosen(
    stored: StoredCell, recorded: Verdict, points: LinePoints, calibration: Calibration, which: str
) -> tuple[F32, tuple[int, int, int, int]]:
    """A map on every sensor pixel of the template's ROI, and the ROI."""
    template = Template.from_bytes(stored.blobs.artifact(recorded.template_hash), "template")
    left, top, width, height = (int(v) for v in template.roi)
    if which == "standard":
        return template.z_map_mm, (left, top, width, height)
    rows, cols = (int(v) for v in calibration.image_shape)
    surface = dense_map(
        np.asarray(points.points), (rows, cols), is_vertical=calibration.is_vertical, roi=(left, top, width, height)
    )
    if which == "measured":
        return surface.z_mm, (left, top, width, height)
    motion = recorded.registration
    scale = _scale(stored, recorded, calibration)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) * np.float32(scale)
    middle_x, middle_y = np.float32(0.5 * width * scale), np.float32(0.5 * height * scale)
    lie = motion.dz_mm + 1e-3 * (motion.tilt_x_mrad * (y - middle_y) + motion.tilt_y_mrad * (x - middle_x))
    return (surface.z_mm - template.z_map_mm - lie).astype(np.float32), (left, top, width, height)


def _scale(stored: StoredCell, recorded: Verdict, calibration: Calibration) -> float:
    """mm per pixel, 1 where it is not known."""
    if np.isfinite(calibration.mm_per_pixel):
        return float(calibration.mm_per_pixel)
    return stored.blobs.recipe(recorded.recipe_hash).mm_per_pixel or 1.0


def _report(stored: StoredCell, recorded: Verdict, out: Path) -> int:
    pictures: list[Picture] = []
    note = ""
    if recorded.code in OF_THE_FRAME:
        try:
            frame, _, _, view = stored.computed(recorded)
            pictures = _pictures(frame.pixels, view)
        except RecordError as error:
            note = f"; without pictures: {error}"
    (row,) = stored.records.rows(AskRecords(last=1, cycle_id=recorded.cycle_id))
    listed = stored.objects.objects().get(recorded.request.object_index)
    write_report(
        out, stored.cell.cell, row.record_id, row.utc, listed.name if listed else "", recorded,
        stored.records.outcome(recorded.cycle_id), pictures,
    )  # fmt: skip
    print(f"{out}: report of cycle {recorded.cycle_id}{note}")
    return 0


def _pictures(pixels: NDArray[np.uint8], view: View | None) -> list[Picture]:
    found: list[Picture] = []
    if view is not None:
        _, measured, difference, error = view.maps_mm
        heights = measured[np.isfinite(measured)]
        low, high = (float(np.min(heights)), float(np.max(heights))) if heights.size else (0.0, 1.0)
        away = difference[np.isfinite(difference)]
        span = max(float(np.percentile(np.abs(away), 99.5)), 0.1) if away.size else 0.1
        found = [
            Picture(f"error: beyond the limits, -{span:.2f} to +{span:.2f} mm", colours(error, -span, span)),
            Picture(
                f"difference: measured minus standard, -{span:.2f} to +{span:.2f} mm", colours(difference, -span, span)
            ),
            Picture(f"measured: {low:.2f} to {high:.2f} mm", colours(measured, low, high)),
        ]
    step = max(1, max(pixels.shape) // 640)
    found.append(Picture("camera picture", np.ascontiguousarray(pixels[::step, ::step])))
    return found


def _configure_import(parser: ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help=".csv or .parquet of 'wearline export records'")
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")


def _run_import(arguments: Namespace) -> int:
    if arguments.file.suffix.lower() not in _RECORD_FILES:
        raise UsageError("is no .csv or .parquet", str(arguments.file), "name a file of 'wearline export records'")
    cell = load_cell(arguments.config)
    settings = validated(JudgeSettings, cell.judge, f"{arguments.config}: judge")
    cycles = read_cycles(arguments.file)
    records = open_records(cell, settings)
    try:
        new = [cycle for cycle in progress(cycles, "check") if not records.has_verdict(cycle.cycle_id)]
        for cycle in new:
            index = cycle.verdict.request.object_index if cycle.verdict is not None else 0
            newest = records.newest_utc(index)
            if newest is not None and cycle.utc < newest:
                raise RecordError(
                    f"cycle {cycle.cycle_id} is older than the newest record of object {index}", str(arguments.file),
                    "import into a cell that has no records of it: a trend must stay in its order",
                )  # fmt: skip
        for start in progress(range(0, len(new), _AT_ONCE), "import"):
            records.append(new[start : start + _AT_ONCE])
    finally:
        records.close()
    print(f"{arguments.file}: {len(new)} records imported, {len(cycles) - len(new)} were there already")
    return 0


EXPORT = Command("export", "records, maps and reports for other programs", _configure_export, _run_export)
IMPORT = Command("import", "records that another cell exported", _configure_import, _run_import)
