"""The demo's cell: its cell.yaml, calibrated and taught from rendered plates and golden parts."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import yaml

from wearline.cli import main as wearline
from wearline.config import CellSettings, load_cell
from wearline.errors import WearlineError
from wearline.recipe import Limits, Recipe, dump_recipe
from wearline.scene import DEFAULT_HEAD, Head, Light, Plane, mm_per_pixel, part_of_stroke, render
from wearline.topics import SERVICES

CELL = "demo"
OBJECT_INDEX = 1
OBJECT_NAME = "tray"
LIMIT_MM = 0.10
"""Of the mean error."""
PLANES_MM = (0.0, 2.0, 4.0, 6.0, 8.0)
SHOTS = 2
"""Of each plate: what vibrates between them averages out."""
GOLDEN_PARTS = 5
SCAN_MS = 10
_SEED = 9_000_000
"""Far from the seeds of the strokes: what is taught is never what is judged."""


def write_cell(folder: Path, base_port: int, strokes: int | None, stroke_period_s: float) -> Path:
    """Write the demo's cell.yaml: loopback only, ports from ``base_port`` on.

    Router, metrics of the five services, PLC and HMI take base, base + 1 to 5, base + 6 and base + 8.
    """
    content = {
        "cell": CELL,
        "data_dir": ".",
        "plc_is_simulated": True,
        "router": {"endpoint": f"tcp/127.0.0.1:{base_port}"},
        "metrics_ports": {name: base_port + 1 + index for index, name in enumerate(SERVICES)},
        "capture": {"kind": "sim"},
        # This die lasts 65 strokes: the alarm's ladder must not stand on a real die's thousands.
        "judge": {"alarms": {"strokes_to_stop": 10}},
        "fieldbus": {"plc": {"host": "127.0.0.1", "port": base_port + 6}},
        "hmi": {"port": base_port + 8, "view_without_login": True},
        "plc_sim": {
            "port": base_port + 6,
            "scan_ms": SCAN_MS,
            "stroke_period_s": stroke_period_s,
            "object_index": OBJECT_INDEX,
            **({"strokes": strokes} if strokes is not None else {}),
        },
    }
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def _head(cell: CellSettings) -> Head:
    return replace(DEFAULT_HEAD, **cell.capture.get("head", {}))


def recipe(head: Head) -> Recipe:
    """What is wanted of the tray."""
    return Recipe(mm_per_pixel=mm_per_pixel(head), limits=Limits(mean_error_mm=LIMIT_MM))


def prepare(cell_path: Path, tell: Callable[[str], None]) -> bool:
    """Calibrate the simulated head and teach the tray, once; False where that was done before.

    Every step is the command that a setter would give.

    Raises:
        WearlineError: a step failed, with its own sentence.
    """
    cell = load_cell(cell_path)
    done = cell.data_dir / "prepared.json"
    if done.exists():
        return False
    folder = cell.data_dir / "prepared"
    folder.mkdir(parents=True, exist_ok=True)
    head = _head(cell)
    tell(f"rendering {len(PLANES_MM) * SHOTS} plates and {GOLDEN_PARTS} golden parts")
    planes = [f"{z:g}={path}" for z, path in _plates(folder, head)]
    golden = [str(path) for path in _golden(folder, head)]
    (folder / "recipe.yaml").write_text(dump_recipe(recipe(head)), encoding="utf-8")
    calibration, template = str(folder / "calibration.npz"), str(folder / "template.npz")
    recipe_file = str(folder / "recipe.yaml")
    tell("calibrating the head")
    _run(
        "calibrate", *(word for plane in planes for word in ("--plane", plane)), "--lines", str(head.lines),
        "--orientation", "vertical" if head.vertical else "horizontal",
        "--mm-per-pixel", f"{mm_per_pixel(head):.6g}", "--out", calibration,
    )  # fmt: skip
    tell("making the template")
    _run("template", *golden, "--calibration", calibration, "--recipe", recipe_file, "--out", template)
    tell(f"releasing object {OBJECT_INDEX} '{OBJECT_NAME}'")
    _run(
        "recipe", "--config", str(cell_path), "add", "--object", str(OBJECT_INDEX), "--name", OBJECT_NAME,
        "--recipe", recipe_file, "--calibration", calibration, "--template", template,
    )  # fmt: skip
    # Last of all: a preparation that was interrupted is done anew.
    done.write_text(json.dumps({"object_index": OBJECT_INDEX, "limit_mm": LIMIT_MM}) + "\n", encoding="utf-8")
    return True


def _plates(folder: Path, head: Head) -> Iterator[tuple[float, Path]]:
    for index, z in enumerate(PLANES_MM):
        for shot in range(SHOTS):
            path = folder / f"plate_{z:g}mm_{shot + 1}.png"
            cv2.imwrite(str(path), render(head, Plane(z), Light(), _SEED + SHOTS * index + shot)[0])
            yield z, path


def _golden(folder: Path, head: Head) -> Iterator[Path]:
    for index in range(GOLDEN_PARTS):
        part = replace(part_of_stroke(_SEED + index), wear_mm=0.0)
        path = folder / f"golden_{index + 1}.png"
        cv2.imwrite(str(path), render(head, part, Light(), _SEED + 1000 + index)[0])
        yield path


def _run(*words: str) -> None:
    """One command of ours, in this process; what it prints is for setters and not for this screen."""
    said, complained = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
        code = wearline(list(words))
    if code:
        lines = complained.getvalue().strip().splitlines() or [f"exit {code}"]
        raise WearlineError(lines[-1].removeprefix("wearline: "), f"demo: wearline {words[0]}")


def last_stroke(cell: CellSettings) -> int:
    """Of the runs before, from what the simulated head noted; 0 = there was none."""
    return max((int(line["stroke"]) for line in json_lines(cell.data_dir / "capture" / "truth.jsonl")), default=0)


def regrind(cell: CellSettings) -> int | None:
    """Grind the die after the last stroke; that stroke, or None where nothing has worn."""
    stroke = last_stroke(cell)
    path = cell.data_folder("capture") / "die.json"
    known = json.loads(path.read_text(encoding="utf-8"))["regrinds"] if path.exists() else []
    if stroke == 0 or stroke in known:
        return None
    draft = path.with_suffix(".json.new")
    draft.write_text(json.dumps({"regrinds": [*known, stroke]}) + "\n", encoding="utf-8")
    draft.replace(path)
    return stroke


def json_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The whole lines of a file of JSON lines; nothing where there is no file."""
    if not path.exists():
        return
    with path.open(encoding="utf-8") as file:
        for line in file:
            # The last line may be in the middle of being written.
            if line.endswith("\n"):
                yield json.loads(line)
