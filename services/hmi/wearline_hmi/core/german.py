"""German, keyed by the English text."""

from __future__ import annotations

GERMAN: dict[str, str] = {}
