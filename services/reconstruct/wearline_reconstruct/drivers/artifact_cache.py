"""Artifacts by content hash, kept on disk so that a restart need not ask for them again."""

from __future__ import annotations

import os
from pathlib import Path

from wearline.artifact import content_hash

_MOST_FILES = 32


class ArtifactCache:
    """A folder of files named by their hash; a file that does not fit its name is forgotten.

    A disk that fails costs the copy, never the measurement: the artifact is asked for again.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes | None:
        """The content, or None."""
        if self._folder is None or not name.isalnum():
            return None
        try:
            content = (self._folder / name).read_bytes()
        except OSError:
            return None
        return content if content_hash(content) == name else None

    def put(self, name: str, content: bytes) -> None:
        """Keep a copy; the oldest go when there are too many."""
        if self._folder is None or not name.isalnum():
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            draft = self._folder / f".{name}.{os.getpid()}"
            draft.write_bytes(content)
            draft.replace(self._folder / name)
            kept = sorted((p for p in self._folder.iterdir() if p.name.isalnum()), key=lambda p: p.stat().st_mtime)
            for old in kept[:-_MOST_FILES]:
                old.unlink(missing_ok=True)
        except OSError:
            return
