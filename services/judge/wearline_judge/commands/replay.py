"""``wearline replay``: compute a recorded verdict again and compare."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

import cv2

from wearline.cli import Command
from wearline.messages import Verdict
from wearline_judge.commands.stored import stored_cell
from wearline_judge.drivers.fingerprint import code_version

_DIGITS = 3
"""Of a millimetre: 1 um."""


def comparable(verdict: Verdict) -> dict[str, Any]:
    """What must come out the same: all but the times and the code that computed it."""
    return verdict.model_dump(mode="json", exclude={"timings_ms", "code_version"})


def differences(recorded: Any, computed: Any, digits: int | None, place: str = "") -> list[str]:
    """Where two verdicts differ; numbers count as equal within one unit of the last of `digits` (None: exactly)."""
    if isinstance(recorded, dict) and isinstance(computed, dict):
        return [
            text
            for key in {**recorded, **computed}
            for text in differences(recorded.get(key), computed.get(key), digits, f"{place}.{key}".lstrip("."))
        ]
    if isinstance(recorded, list) and isinstance(computed, list) and len(recorded) == len(computed):
        return [
            text
            for number, (old, new) in enumerate(zip(recorded, computed, strict=True))
            for text in differences(old, new, digits, f"{place}[{number}]")
        ]
    is_number = isinstance(recorded, int | float) and isinstance(computed, int | float)
    if digits is not None and is_number and abs(recorded - computed) <= 10.0**-digits:
        return []
    return [] if recorded == computed else [f"{place}: recorded {recorded}, computed {computed}"]


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("cycle_id", metavar="CYCLE_ID")
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")


def _run(arguments: Namespace) -> int:
    cv2.setNumThreads(1)
    with stored_cell(arguments.config) as stored:
        recorded = stored.verdict(arguments.cycle_id)
        _, computed, _, _ = stored.computed(recorded)
    return _compare(recorded, computed, f"cycle {arguments.cycle_id}")


def _compare(recorded: Verdict, computed: Verdict, where: str) -> int:
    old, new = comparable(recorded), comparable(computed)
    exact, rounded = differences(old, new, None), differences(old, new, _DIGITS)
    print(f"{where}: recorded {recorded.decision.value}, computed {computed.decision.value}")
    here = code_version()
    is_same_code = recorded.code_version == here
    if not is_same_code:
        print(f"  recorded with {recorded.code_version}\n  computed with {here}")
    if not exact:
        print("  equal bit for bit")
        return 0
    for text in (rounded or exact)[:10]:
        print(f"  {text}")
    if rounded:
        print("  NOT equal after rounding to 1 um")
        return 1
    if is_same_code:
        print("  equal after rounding to 1 um, but NOT bit for bit, though code and processor are the same")
        return 1
    print("  equal after rounding to 1 um; not bit for bit, with other code or another processor")
    return 0


REPLAY = Command("replay", "compute a recorded verdict again and compare", _configure, _run)
