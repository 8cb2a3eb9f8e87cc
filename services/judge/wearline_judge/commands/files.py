"""``wearline template`` and ``wearline judge``: files in, a template or verdicts out."""

from __future__ import annotations

import json
import math
import time
from argparse import ArgumentParser, Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration, Template, content_hash
from wearline.cli import Command, progress
from wearline.errors import CalibrationError, FrameError, RecipeError, TemplateError, UsageError, WearlineError
from wearline.messages import ResultCode, Verdict
from wearline.offline import Chain, oriented, read_frame
from wearline.recipe import Recipe, load_recipe, recipe_hash
from wearline_judge.config import JudgeSettings
from wearline_judge.core.golden import make_golden
from wearline_judge.core.judgement import make_setup
from wearline_judge.core.teaching import Sample, clipped, teach

_NOT_THE_FRAME: dict[int, type[WearlineError]] = {
    ResultCode.NO_CALIBRATION: CalibrationError,
    ResultCode.NO_TEMPLATE: TemplateError,
    ResultCode.UNKNOWN_OBJECT: RecipeError,
}
"""Codes that every frame would get: the references are at fault, so the run ends."""


@dataclass(frozen=True)
class References:
    """What frames are measured and judged with, checked before the first frame."""

    recipe: Recipe
    calibration: Calibration
    calibration_bytes: bytes
    template_bytes: bytes | None


def load_references(calibration: Path | None, template: Path | None, recipe: Path | None) -> References:
    """Read and check.

    Raises:
        UsageError: no calibration was named.
        RecipeError, CalibrationError, TemplateError: missing, broken, or not made for each other.
    """
    if calibration is None:
        raise UsageError("is missing", "--calibration", "name a calibration; 'wearline calibrate' makes one")
    ruling = load_recipe(recipe)
    content = _bytes(calibration, CalibrationError, "calibrate")
    found = Calibration.from_bytes(content, str(calibration))
    ruling = oriented(ruling, found)
    if found.is_vertical != (ruling.orientation == "vertical"):
        lines = "vertical" if found.is_vertical else "horizontal"
        raise CalibrationError(f"is for {lines} lines", str(calibration), f"set orientation: {lines} in the recipe")
    try:
        clipped(ruling, int(found.image_shape[0]), int(found.image_shape[1]))
    except TemplateError as error:
        raise RecipeError(error.what, str(recipe), error.cure) from error
    golden = None
    if template is not None:
        golden = _bytes(template, TemplateError, "template")
        held = Template.from_bytes(golden, str(template))
        if held.calibration_hash != content_hash(content):
            raise TemplateError(
                f"was not made with {calibration}", str(template), "make it anew with 'wearline template'"
            )
        try:
            make_setup(make_golden(held, ruling.mm_per_pixel), ruling)
        except TemplateError as error:
            raise TemplateError(error.what, str(template), error.cure) from error
    return References(ruling, found, content, golden)


def _bytes(path: Path, kind: type[WearlineError], command: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise kind(f"cannot be read ({error.strerror})", str(path), f"make one with 'wearline {command}'") from error


def _configure_template(parser: ArgumentParser) -> None:
    parser.add_argument("frames", nargs="*", metavar="FRAME.png", help="good parts; three or more are better than one")
    parser.add_argument("--calibration", type=Path, metavar="C.npz")
    parser.add_argument("--recipe", type=Path, metavar="R.yaml")
    parser.add_argument("--out", type=Path, required=True, metavar="T.npz")


def _run_template(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    if not arguments.frames:
        raise UsageError("no frame was named", "template", "name one or more image files of good parts")
    out: Path = arguments.out
    if out.is_dir() or not out.parent.is_dir():
        raise UsageError("is a folder" if out.is_dir() else "lies in no folder", f"--out {out}", "name a file to write")
    references = load_references(arguments.calibration, None, arguments.recipe)
    chain = Chain(references.recipe, references.calibration_bytes)
    samples = []
    try:
        for name in progress(arguments.frames, "template"):
            try:
                pixels = read_frame(Path(name))
            except FrameError as error:
                raise TemplateError(error.what, name, "leave it out or take it again") from error
            samples.append(Sample(name, chain.line_points(pixels)))
    finally:
        chain.close()
    template = teach(
        samples, references.calibration, content_hash(references.calibration_bytes), references.recipe,
        recipe_hash(references.recipe), JudgeSettings(),
    )  # fmt: skip
    name = template.save(out)
    expected = template.line_coverage >= 0.5
    spread = float(np.nanmedian(template.line_spread_mm[expected])) if expected.any() else 0.0
    print(
        f"{out}: {name[:12]}, {len(samples)} frame{'s' if len(samples) > 1 else ''},"
        f" {float(expected.mean()):.0%} of the lines covered, spread {1e3 * spread:.1f} um per point"
    )
    if len(samples) == 1:
        print("  one frame alone shows no spread among parts, and nothing that it could be checked against")
    return 0


def _configure_judge(parser: ArgumentParser) -> None:
    parser.add_argument("frames", nargs="*", metavar="FRAME.png")
    parser.add_argument("--calibration", type=Path, metavar="C.npz")
    parser.add_argument("--template", type=Path, metavar="T.npz")
    parser.add_argument("--recipe", type=Path, metavar="R.yaml")
    parser.add_argument("--json", action="store_true", help="one JSON object per frame, one per line")


def _run_judge(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    if not arguments.frames:
        raise UsageError("no frame was named", "judge", "name one or more image files")
    if arguments.template is None:
        raise UsageError("is missing", "--template", "name a template; 'wearline template' makes one")
    references = load_references(arguments.calibration, arguments.template, arguments.recipe)
    chain = Chain(references.recipe, references.calibration_bytes, references.template_bytes)
    try:
        for name in progress(arguments.frames, "judge"):
            start_s = time.perf_counter()
            image: NDArray[np.uint8] | FrameError
            try:
                image = read_frame(Path(name))
            except FrameError as error:
                image = error
            decode_ms = 1e3 * (time.perf_counter() - start_s)
            verdict = chain.verdict(image)
            if verdict.code in _NOT_THE_FRAME:
                raise _NOT_THE_FRAME[verdict.code](verdict.reason, "judge", "mend the references, then judge again")
            print(json.dumps(as_json(name, verdict, decode_ms), allow_nan=False) if arguments.json
                  else sentence(name, verdict), flush=True)  # fmt: skip
    finally:
        chain.close()
    return 0


def as_json(frame: str, verdict: Verdict, decode_ms: float) -> dict[str, Any]:
    """What ``--json`` prints of one frame; every number is finite or null."""
    fields = verdict.model_dump(
        mode="json",
        include={
            "decision", "reason", "code", "mean_error_mm", "max_error_mm", "wear_mm", "deviating_area_mm2",
            "deviating_area_px", "coverage", "regions", "zones", "registration",
        },
    )  # fmt: skip
    timings = {"decode": round(decode_ms, 3), **verdict.timings_ms}
    found: dict[str, Any] = _finite({"frame": frame, **fields, "timings_ms": timings})
    return found


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def sentence(frame: str, verdict: Verdict) -> str:
    """One line for people."""
    figures = ""
    if verdict.mean_error_mm is not None and verdict.max_error_mm is not None:
        figures = f", mean error {verdict.mean_error_mm:.3f} mm, max {verdict.max_error_mm:+.3f} mm"
    return (
        f"{frame}: {verdict.decision.value}{figures}, coverage {verdict.coverage:.0%},"
        f" {verdict.timings_ms.get('total', 0.0):.0f} ms: {verdict.reason}"
    )


TEMPLATE = Command("template", "golden frames to a template", _configure_template, _run_template)
JUDGE = Command("judge", "frames to verdicts", _configure_judge, _run_judge)
