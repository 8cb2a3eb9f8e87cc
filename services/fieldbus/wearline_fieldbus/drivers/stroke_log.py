"""The soft PLC's log: one JSON line per stroke, the truth about what the PLC believed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wearline.errors import RecordError


class StrokeLog:
    """Appends and flushes line by line; a new run goes on where the last one stopped."""

    def __init__(self, path: Path) -> None:
        """Open, or begin, the log.

        Raises:
            RecordError: it cannot be read or written.
        """
        self._path = path
        self.stroke, self.measure_number, self.lines = 0, 0, 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                content = path.read_bytes()
                whole = content[: content.rfind(b"\n") + 1]
                if len(whole) < len(content):
                    path.write_bytes(whole)
                lines = whole.splitlines()
                if lines:
                    last: dict[str, Any] = json.loads(lines[-1])
                    self.stroke, self.measure_number = int(last["stroke"]), int(last["measure_number"])
            self._file = path.open("a", encoding="utf-8")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RecordError(f"is no log of strokes ({error})", str(path), "move it away") from error

    def add(self, belief: Mapping[str, Any]) -> None:
        """Note what the PLC believes of one stroke (the fields of its belief).

        Raises:
            RecordError: the disk is full or broken.
        """
        line = {
            **belief,
            "part_id": f"P{belief['stroke']:06d}",
            "failed": not belief["passed"],
            "ms": round(belief["ms"], 1),
            "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
        }
        try:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        except OSError as error:
            raise RecordError(f"cannot be written ({error})", str(self._path), "free space") from error
        self.lines += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()
