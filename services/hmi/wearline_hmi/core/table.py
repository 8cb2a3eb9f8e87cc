"""Tables as CSV for spreadsheets."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

BOM = "﻿"
"""Without it Excel takes UTF-8 for the local code page."""


def safe_cell(value: object) -> str:
    """A cell that no spreadsheet takes for a formula: part ids and notes come from outside."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "1" if value else "0"
    if isinstance(value, int | float):
        return repr(value)
    text = str(value)
    return f"'{text}" if text.lstrip()[:1] in ("=", "+", "-", "@") or text[:1] in ("\t", "\r") else text


def csv_lines(rows: Iterable[Sequence[object]]) -> str:
    """Rows as RFC 4180 text."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    for row in rows:
        writer.writerow([safe_cell(value) for value in row])
    return stream.getvalue()
