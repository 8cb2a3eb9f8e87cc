"""Logs on stderr: one line per record, JSON for machines or plain for people."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal


class _Json(logging.Formatter):
    def __init__(self, cell: str, service: str) -> None:
        super().__init__()
        self._place = {"cell": cell, "service": service}

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, object] = {
            "utc": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            **self._place,
            "logger": record.name,
            "text": record.getMessage(),
        }
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class _Plain(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line = f"{self.formatTime(record, '%H:%M:%S')} {record.levelname:<7} {record.name}: {record.getMessage()}"
        if record.exc_info and record.exc_info[1] is not None:
            # A traceback has many lines and a log line has one: its last frame says most.
            place = record.exc_info[2]
            while place is not None and place.tb_next is not None:
                place = place.tb_next
            where = f" at {place.tb_frame.f_code.co_filename}:{place.tb_lineno}" if place is not None else ""
            line += f" [{type(record.exc_info[1]).__name__}: {record.exc_info[1]}{where}]"
        return " ".join(line.splitlines())


def start_log(
    cell: str, service: str, style: Literal["json", "plain", "auto"] = "auto", level: int = logging.INFO
) -> None:
    """Send all logs of this process to stderr; ``auto`` is plain on a terminal and JSON elsewhere."""
    if style == "auto":
        style = "plain" if sys.stderr.isatty() else "json"
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Json(cell, service) if style == "json" else _Plain())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level)
