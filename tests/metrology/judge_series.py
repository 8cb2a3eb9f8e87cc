"""``make judge-series``: what the judge finds on hundreds of rendered full-size parts, and what it wrongly finds.

Every part is rendered, measured and judged by the shipped code. Results go line by line into
build/judge-series-<fingerprint of the code>.jsonl, so that a run that was stopped goes on, and no
result of older code is ever mixed in.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import wearline_judge.core
import wearline_reconstruct.core
from tests.metrology.parts import LIGHTS, Refixtured, bench, box, lit, random_pose, true_deviation, worn
from wearline.messages import Decision
from wearline.recipe import Limits, Recipe
from wearline.scene import Flake, StampedPart, Surface
from wearline_judge.core.judgement import JudgingSettings, judge_points
from wearline_judge.core.line_grid import F64
from wearline_reconstruct.core.chain import Prepared, prepare, reconstruct

PART = StampedPart()
ZONES = (
    box("near left", (-78.0, -46.0), (0.0, 0.0)),
    box("near right", (0.0, -46.0), (78.0, 0.0)),
    box("far left", (-78.0, 0.0), (0.0, 46.0)),
    box("far right", (0.0, 0.0), (78.0, 46.0)),
)
Result = dict[str, Any]
THESIS_WITH = (0.3842, 0.3144, 0.4285, 0.5674, 0.5599, 0.3405, 0.4702, 0.5247, 0.3170, 0.3538)
THESIS_WITHOUT = (0.2182, 0.1594, 0.1757, 0.2367, 0.1735, 0.1321, 0.1685, 0.2290, 0.2256, 0.2183)
"""Mean errors of Table 5.4, five in the dark and five in bright light each. [mm]"""


def refixtured(surface: Surface, rng: np.random.Generator) -> Refixtured:
    """As a part lies in its fixture: within half a millimetre and 2 mrad."""
    return Refixtured(surface, random_pose(rng, 0.5, 2.0, 0.3, 2.0))


def flake_result(thickness_mm: float, light: str, number: int) -> Result:
    """One part with a 10 x 10 mm flake somewhere on it."""
    rng = np.random.default_rng([number, LIGHTS.index(light), round(1e3 * thickness_mm), 71])
    x, y = float(rng.uniform(-70.0, 70.0)), float(rng.uniform(-40.0, 40.0))
    part = refixtured(Flake(PART, x, y, 10.0, thickness_mm), rng)
    judged = bench().judge(part, light, 7_000_000 + number)
    near = [
        r for r in judged.fields.get("regions", ())
        if math.hypot(r.col_px - 811.5 - 10.0 * x, r.row_px - 611.5 - 10.0 * y) < 120.0
    ]  # fmt: skip
    return {
        "found": judged.fields["decision"] is Decision.FAILED and bool(near), "x": x, "y": y,
        "decision": judged.fields["decision"].name, "mean_mm": near[0].mean_mm if near else None,
    }  # fmt: skip


def good_result(light: str, number: int) -> Result:
    """One good part, its springing back scattered."""
    rng = np.random.default_rng([number, LIGHTS.index(light), 72])
    part = StampedPart(spring_mm=0.004 * float(rng.standard_normal()))
    judged = bench().judge(refixtured(part, rng), light, 8_000_000 + number)
    comparison = judged.comparison
    found: Result = {"decision": judged.fields["decision"].name, "reason": judged.fields["reason"]}
    if comparison is not None:
        score = comparison.deviation_mm / comparison.sigma_mm
        inside = np.abs(score) < 1.96
        for zone, (_, mask) in zip(ZONES, bench().setup(Recipe(zones=ZONES)).zones, strict=True):
            at = mask & np.isfinite(score)
            squares = float(np.sum(np.minimum(score[at] ** 2, 36.0)))
            found[zone.name] = [int(at.sum()), squares, int(inside[at].sum())]
    return found


def verdict_result(number: int) -> Result:
    """One worn part against a limit on the mean error of a zone near its true one, with a guard band of 95 %."""
    rng = np.random.default_rng([number, 73])
    part = worn(float(rng.uniform(0.15, 0.35)))
    light = LIGHTS[number % 3]
    lying = refixtured(part, rng)
    measured = bench().measure(lying, light, 9_000_000 + number)
    zone = box("corner", (15.0, 5.0), (55.0, 40.0))
    free = judge_points(measured, bench().setup(Recipe(zones=(zone,))), JudgingSettings())
    comparison = free.comparison
    if comparison is None:
        return {"decision": "NOT_MEASURED"}
    mask = bench().setup(Recipe(zones=(zone,))).zones[0][1]
    at = mask & (comparison.label > 0)
    if not at.any():
        return {"decision": "NOTHING"}
    area: F64 = comparison.area_px[at]
    # The truth of the very cells that the figure is a mean of.
    truth = float(np.sum(np.abs(true_deviation(bench(), part)[at]) * area) / np.sum(area))
    sigma = comparison.mean_sigma(at)
    limit = truth + float(rng.uniform(-2.5, 2.5)) * sigma
    held = box("corner", (15.0, 5.0), (55.0, 40.0), Limits(mean_error_mm=max(limit, 1e-3)))
    judged = judge_points(measured, bench().setup(Recipe(zones=(held,), guard_band=1.645)), JudgingSettings())
    reported = free.fields["zones"][0].mean_error_mm
    return {
        "decision": judged.fields["decision"].name, "is_bad": truth > limit,
        "score": (reported - truth) / sigma,
    }  # fmt: skip


def thesis_chain() -> tuple[Prepared, Prepared]:
    """The thesis' own method and ours, both with the taught template's gate."""
    taught = bench()
    return prepare(taught.calibration, Recipe(method="thesis"), None), taught.chain


def thesis_result(number: int) -> Result:
    """One line of Table 5.4: a part with or without a 0.2 mm flake at rest, by the thesis' figure and by ours."""
    rng = np.random.default_rng([number, 74])
    light = ("dark", "bright")[(number // 5) % 2]
    with_flake = number < 10
    x, y = float(rng.uniform(-60.0, 60.0)), float(rng.uniform(-35.0, 35.0))
    surface: Surface = Flake(PART, x, y, float(rng.uniform(10.0, 20.0)), 0.2) if with_flake else PART
    pixels = lit(bench().head, surface, light, 9_500_000 + number)
    begun = time.perf_counter()
    judged = judge_points(bench().points_of(pixels), bench().setup(), JudgingSettings())
    took = 1e3 * (time.perf_counter() - begun)
    # The thesis compares height maps point by point, without registration: its mean over all deviating points.
    found = reconstruct(pixels, thesis_chain()[0]).points
    golden = bench().golden
    line, place = found[:, 0].astype(int), np.rint(found[:, 2]).astype(int)
    off = np.abs(found[:, 3] - golden.z_mm[line, place])
    off = off[np.isfinite(off) & (off > 0.05)]
    return {
        "with": with_flake, "light": light, "decision": judged.fields["decision"].name,
        "mean_mm": judged.fields.get("mean_error_mm"), "ms": took, "thesis_mm": float(off.mean()) if off.size else 0.0,
    }  # fmt: skip


def fingerprint() -> str:
    """Of all code that the results rest on."""
    digest = hashlib.sha256()
    for folder in (wearline_judge.core, wearline_reconstruct.core):
        for source in sorted(Path(str(folder.__file__)).parent.glob("*.py")):
            digest.update(source.read_bytes())
    for name in ("parts.py", "judge_series.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    digest.update((Path(__file__).parents[2] / "wearline" / "scene.py").read_bytes())
    return digest.hexdigest()[:12]


def tasks(chosen: argparse.Namespace) -> Iterator[tuple[str, Callable[[], Result]]]:
    """Key and work, in an order that gives every series something early."""
    for number in range(20):
        yield f"thesis/{number}", partial(thesis_result, number)
    for number in range(max(chosen.good, chosen.flakes, chosen.verdicts)):
        if number < chosen.flakes:
            for light in LIGHTS:
                for thickness in (0.2, 0.1):
                    key = f"flake/{thickness}/{light}/{number}"
                    yield key, partial(flake_result, thickness, light, number)
        for light in LIGHTS:
            if 3 * number + LIGHTS.index(light) < chosen.good:
                yield f"good/{light}/{number}", partial(good_result, light, number)
        if number < chosen.verdicts:
            yield f"verdict/{number}", partial(verdict_result, number)


def interval95(hits: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    z = 1.96
    share = hits / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return middle - half, middle + half


def summary(results: dict[str, Result]) -> list[str]:
    """The figures in words."""
    lines: list[str] = []

    def series(prefix: str) -> list[Result]:
        return [r for key, r in results.items() if key.startswith(prefix)]

    for thickness in (0.2, 0.1):
        for light in LIGHTS:
            rows = series(f"flake/{thickness}/{light}/")
            if rows:
                hits = sum(r["found"] for r in rows)
                low, high = interval95(hits, len(rows))
                lines.append(
                    f"flake {thickness} mm, {light:6}: {hits} of {len(rows)} found ({100 * low:.1f}-{100 * high:.1f} %)"
                )
    good = series("good/")
    if good:
        for light in LIGHTS:
            rows = series(f"good/{light}/")
            alarms = sum(r["decision"] == "FAILED" for r in rows)
            lost = sum(r["decision"] == "NOT_MEASURED" for r in rows)
            lines.append(f"good parts, {light:6}: {alarms} false alarms, {lost} not measured, of {len(rows)}")
        for zone in ZONES:
            cells, squares, inside = (sum(r[zone.name][k] for r in good if zone.name in r) for k in range(3))
            lines.append(
                f"scores of cells, {zone.name:10}: sd {math.sqrt(squares / max(cells, 1)):.3f},"
                f" {100 * inside / max(cells, 1):.1f} % within 95 %"
            )
    verdicts = [r for r in series("verdict/") if "score" in r]
    if verdicts:
        scores = np.array([r["score"] for r in verdicts])
        bad = [r for r in verdicts if r["is_bad"]]
        fine = [r for r in verdicts if not r["is_bad"]]
        accepted = sum(r["decision"] == "PASSED" for r in bad)
        rejected = sum(r["decision"] == "FAILED" for r in fine)
        unsure = sum(r["decision"] == "UNSURE" for r in verdicts)
        lines += [
            f"mean error of a worn zone: scores of mean {scores.mean():+.2f}, sd {scores.std():.2f},"
            f" {100 * float(np.mean(np.abs(scores) < 1.96)):.1f} % within 95 %, of {len(scores)}",
            f"limits within 2.5 standard uncertainties of the truth, guard band 95 %: {accepted} of {len(bad)} bad"
            f" parts accepted, {rejected} of {len(fine)} good ones rejected, {unsure} of {len(verdicts)} unsure",
        ]
    table = [results[f"thesis/{n}"] for n in range(20) if f"thesis/{n}" in results]
    if len(table) == 20:
        lines.append("Table 5.4: light, verdict, mean error | by the thesis' method | printed in the thesis [mm]")
        for row, printed in zip(table, THESIS_WITH + THESIS_WITHOUT, strict=True):
            kind = "with flake" if row["with"] else "without"
            lines.append(
                f"  {kind:10} {row['light']:6} {row['decision']:7} {row['mean_mm'] or 0.0:.3f} | {row['thesis_mm']:.3f}"
                f" | {'Bad ' if row['with'] else 'Good'} {printed:.4f}   {row['ms']:.0f} ms"
            )
    return lines


def run(chosen: argparse.Namespace) -> dict[str, Result]:
    """Do what is not done yet."""
    cv2.setNumThreads(1)
    path = chosen.out or Path("build") / f"judge-series-{fingerprint()}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Result] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            results[row.pop("key")] = row
    begun = time.monotonic()
    with path.open("a", encoding="utf-8") as out:
        for key, work in tasks(chosen):
            if key in results:
                continue
            if chosen.minutes and time.monotonic() - begun > 60.0 * chosen.minutes:
                break
            results[key] = work()
            out.write(json.dumps({"key": key, **results[key]}) + "\n")
            out.flush()
    return results


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flakes", type=int, default=300, help="per thickness and light")
    parser.add_argument("--good", type=int, default=1000)
    parser.add_argument("--verdicts", type=int, default=300)
    parser.add_argument("--minutes", type=float, default=0.0, help="stop after so many; 0 = when done")
    parser.add_argument("--out", type=Path, default=None)
    for line in summary(run(parser.parse_args())):
        print(line)


if __name__ == "__main__":
    main()
