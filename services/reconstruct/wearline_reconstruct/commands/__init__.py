"""``wearline calibrate``, ``wearline reconstruct`` and ``wearline bench``."""

from __future__ import annotations

import json
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from wearline.artifact import Calibration, Template
from wearline.cli import Command, progress
from wearline.errors import CalibrationError, FrameError, UsageError
from wearline.messages import LinePoints
from wearline.offline import Chain, oriented, read_frame
from wearline.recipe import Recipe, load_recipe
from wearline.surface import dense_map
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.core.calibration import CalibrationSettings, Shot, calibrate
from wearline_reconstruct.core.chain import Reconstruction, prepare, reconstruct
from wearline_reconstruct.core.hdr import MOST_EXPOSURES
from wearline_reconstruct.core.lateral import Target, distance_mm, find_target, fit_lateral, positions_mm, scale_of
from wearline_reconstruct.core.looking import any_stripes, drawn
from wearline_reconstruct.core.stripes import strip_image
from wearline_reconstruct.drivers.pictures import read_picture


def _configure_calibrate(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--plane", action="append", default=[], metavar="HEIGHT=FILE",
        help="picture of a flat plate at this height [mm]; two heights at least, several per height are welcome",
    )  # fmt: skip
    parser.add_argument("--lines", type=int, default=25, help="lines that the laser projects (default 25)")
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument("--mm-per-pixel", type=float, metavar="S", help="lateral scale on the plane z = 0 [mm/px]")
    scale.add_argument(
        "--target", type=Path, metavar="BOARD.png", help="picture of a chessboard or a grid of dots on the plane z = 0"
    )
    parser.add_argument(
        "--square-mm",
        type=float,
        metavar="MM",
        help="edge of one field of the chessboard, or distance of the dots [mm]",
    )
    parser.add_argument("--report", type=Path, metavar="FILE.txt", help="write the report there, too")
    parser.add_argument("--orientation", choices=("horizontal", "vertical"), default="horizontal")
    parser.add_argument("--out", type=Path, required=True, metavar="C.npz")


def _run_calibrate(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    if arguments.lines < 3:
        raise UsageError(f"{arguments.lines} lines are too few", "--lines", "give 3 or more")
    if arguments.mm_per_pixel is not None and not 0.0 < arguments.mm_per_pixel < 10.0:
        raise UsageError(f"{arguments.mm_per_pixel:g} mm per pixel cannot be", "--mm-per-pixel", "give mm of one pixel")
    planes = [_plane(text) for text in arguments.plane]
    if len({height for height, _ in planes}) < 2:
        raise UsageError("needs plates at two heights at least", "--plane", "give --plane HEIGHT=FILE for each")
    _check_writable(arguments.out)
    if arguments.report is not None:
        _check_writable(arguments.report, "--report")
    target = None
    if arguments.target is not None:
        target = _target(arguments.target, arguments.square_mm)
    elif arguments.square_mm is not None:
        raise UsageError("goes with --target", "--square-mm", "name the picture of the target")
    settings = ReconstructSettings()
    shots = [Shot(height, read_frame(path), str(path)) for height, path in progress(planes, "read")]
    calibration = calibrate(
        shots, lines=arguments.lines, is_vertical=arguments.orientation == "vertical",
        mm_per_pixel=arguments.mm_per_pixel,
        settings=settings.calibration, stripes=settings.stripes, line_settings=settings.lines,
    )  # fmt: skip
    if target is not None:
        calibration = _with_lateral(calibration, target, arguments.square_mm, arguments.target)
    name = calibration.save(arguments.out)
    report = "\n".join(_report(calibration, arguments.out, name, settings.calibration))
    print(report)
    if arguments.report is not None:
        arguments.report.write_text(report + "\n", encoding="utf-8")
    return 0


def _plane(text: str) -> tuple[float, Path]:
    height, found, path = text.partition("=")
    try:
        value = float(height)
    except ValueError:
        found = ""
    if not found or not path or not np.isfinite(value):
        raise UsageError(f"'{text}' is not HEIGHT=FILE", "--plane", "write for example --plane 3=P3.png")
    return value, Path(path)


def _check_writable(path: Path, option: str = "--out") -> None:
    if path.is_dir() or not path.parent.is_dir():
        raise UsageError(
            "is a folder" if path.is_dir() else "lies in no folder", f"{option} {path}", "name a file to write"
        )


def _target(path: Path, field_mm: float | None) -> tuple[Target, tuple[int, int]]:
    """The target in a picture, and the picture's size."""
    if field_mm is None or not 0.0 < field_mm < 1000.0:
        raise UsageError("needs the size of its fields", "--target", "add --square-mm MM")
    try:
        picture = read_picture(path)
    except FrameError as error:
        raise CalibrationError(error.what, error.where, error.cure) from error
    grey = picture if picture.dtype == np.uint8 else np.clip(picture, 0, 255).astype(np.uint8)
    return find_target(np.asarray(grey, np.uint8), str(path)), (int(grey.shape[0]), int(grey.shape[1]))


def _with_lateral(
    calibration: Calibration, found: tuple[Target, tuple[int, int]], field_mm: float, path: Path
) -> Calibration:
    target, shape = found
    rows, cols = (int(v) for v in calibration.image_shape)
    if shape != (rows, cols):
        raise CalibrationError(
            f"is {shape[1]} x {shape[0]} pixels, the plates are {cols} x {rows}", str(path),
            "take the target with the same camera",
        )  # fmt: skip
    lateral = fit_lateral(target, field_mm, shape, distance_mm(calibration), str(path))
    return replace(
        calibration, mm_per_pixel=scale_of(lateral, shape), meta={**calibration.meta, "lateral": lateral}
    )  # fmt: skip


def _report(calibration: Calibration, path: Path, name: str, limits: CalibrationSettings) -> list[str]:
    low, high = calibration.z_range_mm
    meta = calibration.meta
    covered = np.isfinite(calibration.across0_px).mean()
    rests = [line["rest_mm"] for line in meta["lines"] if line["rest_mm"] is not None]
    text = [f"{path}: {name[:12]}, {calibration.lines} lines, {covered:.0%} covered"]
    text += [
        f"  {shot['z_mm']:8.3f} mm  {shot['where']}: {shot['lines']} lines, offset {1e3 * shot['offset_mm']:+.1f} um,"
        f" rest {1e3 * shot['rms_mm']:.1f} um per point"
        for shot in meta["shots"]
    ]
    text += [
        f"  plane {plane['z_mm']:g} mm lies {1e3 * plane['left_out_mm']:+.1f} um off what the other planes predict"
        f" (expected within {2e3 * plane['sigma_mm']:.0f} um of 0)"
        + ("" if plane["is_believed"] else ": WARNING, its height was not used; check the height that was entered")
        for plane in meta["planes"]
    ]
    worst = max(meta["lines"], key=lambda line: line["rest_mm"] or 0.0)
    missing = [str(line["line"]) for line in meta["lines"] if line["covered"] < 0.5]
    text.append(
        f"  lines: rest {1e3 * float(np.median(rests)):.1f} um, worst {1e3 * worst['rest_mm']:.1f} um"
        f" (line {worst['line']}, limit {1e3 * limits.largest_line_rest_mm:.0f} um)"
        + (f"; less than half seen of {', '.join(missing)}" if missing else "")
    )
    text.append(
        f"  heights {low:.2f} to {high:.2f} mm, {1e3 * abs(meta['mm_per_line_px']):.1f} um per px of line"
        f" shift, calibration uncertainty {1e3 * float(np.nanmedian(calibration.z_sigma_mm)):.1f} um,"
        f" vibration {meta['vibration_px']:.3f} px"
        + (": WARNING, the head or the plates shake; hold them firmly" if meta["vibration_px"] > 0.2 else "")
    )
    if np.isfinite(calibration.mm_per_pixel):
        lateral = meta.get("lateral")
        told = f", {lateral['target']}, rest {lateral['rms_px']:.2f} px" if lateral else ""
        text.append(f"  lateral scale {calibration.mm_per_pixel:.5f} mm/px{told}")
    text.append("  accepted")
    return text


def _configure_reconstruct(parser: ArgumentParser) -> None:
    parser.add_argument("frames", nargs="*", type=Path, metavar="FRAME.png")
    parser.add_argument("--calibration", type=Path, metavar="C.npz")
    parser.add_argument("--recipe", type=Path, metavar="R.yaml")
    parser.add_argument("--template", type=Path, metavar="T.npz", help="gates the line numbers")
    parser.add_argument("--stripes-only", action="store_true", help="only find the stripes; needs no calibration")
    parser.add_argument("--orientation", choices=("horizontal", "vertical"), help="with --stripes-only")
    parser.add_argument(
        "--bracket", type=int, metavar="N",
        help="each N (2 or 3) frames that follow each other are exposures of one part at rest, measured as one",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def _run_reconstruct(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    frames: list[Path] = arguments.frames
    if not frames:
        raise UsageError("no frame was named", "reconstruct", "name one or more image files")
    stems: dict[str, Path] = {}
    for frame in frames:
        if frame.stem in stems:
            raise UsageError(
                f"{stems[frame.stem]} and {frame} would both be written to {frame.stem}.npz", "reconstruct",
                "rename one, or give them an --out each",
            )  # fmt: skip
        stems[frame.stem] = frame
    if arguments.out.exists() and not arguments.out.is_dir():
        raise UsageError("is no folder", f"--out {arguments.out}", "name a folder")
    if arguments.stripes_only:
        if arguments.calibration or arguments.template or arguments.recipe:
            raise UsageError("needs no calibration, template or recipe", "--stripes-only", "leave them out")
        arguments.out.mkdir(parents=True, exist_ok=True)
        return _stripes_only(frames, arguments.orientation == "vertical", arguments.out)
    if arguments.calibration is None:
        raise UsageError("is missing", "--calibration", "name a calibration, or look at --stripes-only")
    if arguments.orientation is not None:
        raise UsageError("goes with --stripes-only", "--orientation", "the calibration knows it")
    recipe = load_recipe(arguments.recipe)
    calibration = Calibration.load(arguments.calibration)
    exposures = _exposures(arguments.bracket, len(frames), recipe)
    template = Template.load(arguments.template) if arguments.template else None
    prepare(calibration, recipe, template)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if exposures > 1:
        return _bracketed(frames, exposures, oriented(recipe, calibration), calibration, template, arguments.out)
    return _heights(frames, recipe, calibration, template, arguments.out)


def _exposures(bracket: int | None, frames: int, recipe: Recipe) -> int:
    """How many frames make one part."""
    if bracket is None:
        if recipe.hdr == "bracket":
            raise UsageError(
                "asks for a bracket of exposures", "hdr of the recipe", "say with --bracket 2 or 3 how many a part has"
            )
        return 1
    if not 2 <= bracket <= MOST_EXPOSURES:
        raise UsageError(f"{bracket} exposures cannot be merged", "--bracket", "give 2 or 3")
    if frames % bracket:
        raise UsageError(f"{frames} frames are not whole brackets of {bracket}", "--bracket", "name all exposures")
    return bracket


def _bracketed(
    frames: Sequence[Path], count: int, recipe: Recipe, calibration: Calibration, template: Template | None, out: Path
) -> int:
    """Exposures of parts at rest, ``count`` frames each; files are named after the first of them."""
    if recipe.hdr == "off":
        recipe = recipe.model_copy(update={"hdr": "bracket"})
    prepared = prepare(calibration, recipe, template, ReconstructSettings().chain)
    for first in progress(range(0, len(frames), count), "reconstruct", len(frames) // count):
        paths = frames[first : first + count]
        start = time.perf_counter()
        try:
            pictures = [read_frame(path) for path in paths]
            decoded = time.perf_counter()
            found = reconstruct(pictures, prepared, time.perf_counter)
        except FrameError as error:
            where = "" if error.where else f"{paths[0]}: "
            print(f"wearline: {where}{error}", file=sys.stderr)
            continue
        _save_heights(out / f"{paths[0].stem}.npz", found, calibration, recipe, 1e3 * (decoded - start))
        _tell(paths[0], found, out)
    return 0


def _heights(
    frames: Sequence[Path], recipe: Recipe, calibration: Calibration, template: Template | None, out: Path
) -> int:
    chain = Chain(recipe, calibration, template)
    try:
        for path in progress(frames, "reconstruct"):
            start = time.perf_counter()
            try:
                pixels = read_frame(path)
            except FrameError as error:
                print(f"wearline: {error}", file=sys.stderr)
                continue
            decoded = time.perf_counter()
            found = chain.line_points(pixels)
            if found.refusal_code:
                print(f"wearline: {path}: {found.refusal}", file=sys.stderr)
                continue
            _save_heights(out / f"{path.stem}.npz", found, calibration, recipe, 1e3 * (decoded - start))
            _tell(path, found, out)
    finally:
        chain.close()
    return 0


def _tell(path: Path, found: LinePoints | Reconstruction, out: Path) -> None:
    print(f"{path}: {len(found.points)} points, coverage {found.coverage:.3f}, {out / path.stem}.npz")
    for sentence in found.quality.sentences:
        print(f"  {sentence}")


def _save_heights(
    path: Path, found: LinePoints | Reconstruction, calibration: Calibration, recipe: Recipe, decode_ms: float
) -> None:
    start = time.perf_counter()
    rows, cols = (int(v) for v in calibration.image_shape)
    surface = dense_map(
        np.asarray(found.points),
        (rows, cols),
        is_vertical=calibration.is_vertical,
        roi=_clipped(recipe.roi, rows, cols),
    )
    timings = {"decode": round(decode_ms, 3), **found.timings_ms, "map": round(1e3 * (time.perf_counter() - start), 3)}
    points = found.points
    x_mm, y_mm = positions_mm(calibration, *(points[:, k].astype(np.float64) for k in (1, 2, 3)))
    np.savez_compressed(
        path, line=points[:, 0].astype(np.int16), row_px=points[:, 1], col_px=points[:, 2], z_mm=points[:, 3],
        sigma_mm=points[:, 4], sigma_frame_mm=np.float64(found.sigma_frame_mm), z_map_mm=surface.z_mm,
        sigma_map_mm=surface.sigma_mm, roi=surface.roi, coverage=np.float64(found.coverage),
        timings_ms=np.array(json.dumps(timings)),
        x_mm=x_mm.astype(np.float32), y_mm=y_mm.astype(np.float32),
    )  # fmt: skip


def _clipped(roi: tuple[int, int, int, int] | None, rows: int, cols: int) -> tuple[int, int, int, int] | None:
    if roi is None:
        return None
    x, y, width, height = roi
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + width, cols), min(y + height, rows)
    if x1 <= x0 or y1 <= y0:
        raise UsageError(
            f"roi {roi} lies outside the {cols} x {rows} sensor", "recipe", "give x, y, width, height in px"
        )
    return x0, y0, x1 - x0, y1 - y0


def _stripes_only(frames: Sequence[Path], is_vertical: bool, out: Path) -> int:
    settings = ReconstructSettings()
    for path in progress(frames, "stripes"):
        try:
            picture = read_picture(path)
        except FrameError as error:
            print(f"wearline: {error}", file=sys.stderr)
            continue
        scale, found = any_stripes(strip_image(picture, is_vertical), settings.stripes, settings.lines)
        if not found.count:
            print(f"wearline: {path}: shows no stripes; check --orientation and exposure", file=sys.stderr)
            continue
        across, along = found.peaks.across_px, found.peaks.along.astype(np.float32)
        row, col = (along, across) if is_vertical else (across, along)
        np.savez_compressed(
            out / f"{path.stem}.npz",
            row_px=row,
            col_px=col,
            sigma_px=found.sigma_px,
            stripe=found.label.astype(np.int32),
        )
        cv2.imwrite(str(out / f"{path.stem}_stripes.png"), drawn(picture, found, is_vertical))
        print(f"{path}: {found.count} stripes, {len(row)} points, width {scale.width_px:.1f} px")
    return 0


def _configure_bench(parser: ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, default=5, help="frames per scene of tables 5.3 and 5.4 (default 5)")
    parser.add_argument("--seed", type=int, default=1, help="of the rendered frames")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the tables")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the results, too")


def _run_bench(arguments: Namespace) -> int:
    from wearline_reconstruct.commands.bench import run_bench

    if not 1 <= arguments.frames <= 1000:
        raise UsageError(f"{arguments.frames} frames cannot be", "--frames", "give 1 to 1000")
    if arguments.picture is not None and (arguments.picture.suffix != ".png" or not arguments.picture.parent.is_dir()):
        raise UsageError("is no .png in an existing folder", f"--picture {arguments.picture}", "name a file to write")
    return run_bench(arguments.frames, arguments.seed, arguments.json, arguments.picture)


CALIBRATE = Command("calibrate", "calibrate a head from plates at known heights", _configure_calibrate, _run_calibrate)
RECONSTRUCT = Command("reconstruct", "frames to heights on the laser lines", _configure_reconstruct, _run_reconstruct)
BENCH = Command(
    "bench", "speed and precision on simulated parts, beside the thesis' tables", _configure_bench, _run_bench
)
