"""A PLC in memory: for tests, and for a cell that has none yet."""

from __future__ import annotations

import threading


class MemoryPlc:
    """A data block that another thread may look at and change."""

    def __init__(self, image_bytes: int, name: str = "PLC in memory") -> None:
        self.name = name
        self._lock = threading.Lock()
        self._image = bytearray(image_bytes)
        self.writes: list[tuple[int, bytes]] = []
        """Everything that was written through the port, oldest first."""

    def connect(self) -> None:
        """Always succeeds."""

    def read(self) -> bytes:
        with self._lock:
            return bytes(self._image)

    def write(self, start: int, content: bytes) -> None:
        with self._lock:
            self._image[start : start + len(content)] = content
            self.writes.append((start, content))

    def close(self) -> None:
        """Nothing to close."""

    def put(self, start: int, content: bytes) -> None:
        """What the PLC's own program writes."""
        with self._lock:
            self._image[start : start + len(content)] = content
