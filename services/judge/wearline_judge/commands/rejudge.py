"""``wearline rejudge``: what another recipe would have said of the recorded parts."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections import Counter
from pathlib import Path

import cv2

from wearline.cli import Command, progress
from wearline.errors import RecordError, UsageError
from wearline.recipe import load_recipe
from wearline_judge.commands.stored import OF_THE_FRAME, stored_cell


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")
    parser.add_argument("--recipe", type=Path, required=True, metavar="NEW.yaml")
    parser.add_argument("--last", type=int, default=10000, metavar="N", help="newest records (default 10000)")
    parser.add_argument("--object", type=int, metavar="N", help="of one object alone")
    parser.add_argument("--json", action="store_true", help="one JSON object per part, one per line")


def _run(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    if arguments.last < 1:
        raise UsageError(f"{arguments.last} records cannot be", "--last", "give 1 or more")
    recipe = load_recipe(arguments.recipe)
    moves: Counter[tuple[str, str]] = Counter()
    left_out: Counter[str] = Counter()
    with stored_cell(arguments.config) as stored:
        total = min(sum(stored.records.counts(arguments.object).values()), arguments.last)
        if not total:
            raise UsageError("has no such records", str(arguments.config), "see --object")
        for _, cycle in progress(stored.records.cycles(arguments.last, arguments.object), "rejudge", total):
            recorded = cycle.verdict
            if recorded is None or recorded.code not in OF_THE_FRAME:
                left_out["not judged by a frame"] += 1
                continue
            try:
                _, computed, _, _ = stored.computed(recorded, recipe)
            except RecordError as error:
                left_out["frame or references not stored any more" if "stored" in error.what else error.what] += 1
                continue
            old, new = recorded.decision.value, computed.decision.value
            moves[old, new] += 1
            if arguments.json:
                told = {
                    "cycle_id": recorded.cycle_id, "stroke": recorded.request.stroke,
                    "part_id": recorded.request.part_id, "recorded": old, "rejudged": new, "reason": computed.reason,
                    "recorded_mean_error_mm": recorded.mean_error_mm, "mean_error_mm": computed.mean_error_mm,
                }  # fmt: skip
                print(json.dumps(told), flush=True)
            elif old != new:
                print(
                    f"stroke {recorded.request.stroke}, cycle {recorded.cycle_id}: {old} -> {new}: {computed.reason}",
                    flush=True,
                )
    if not arguments.json:
        _report(moves, left_out)
    return 0


def _report(moves: Counter[tuple[str, str]], left_out: Counter[str]) -> None:
    total = sum(moves.values())
    changed = sum(count for (old, new), count in moves.items() if old != new)
    print(f"{total} parts judged again, {changed} would have been judged otherwise")
    for (old, new), count in sorted(moves.items()):
        print(f"  {old:>12} -> {new:<12} {count:>7}")
    for why, count in sorted(left_out.items()):
        print(f"  left out: {count} ({why})")


REJUDGE = Command("rejudge", "judge recorded parts again by another recipe", _configure, _run)
