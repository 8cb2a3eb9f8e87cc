"""Simplified Chinese, keyed by the English text."""

from __future__ import annotations

CHINESE: dict[str, str] = {}
