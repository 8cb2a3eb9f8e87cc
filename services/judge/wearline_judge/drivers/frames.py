"""Frames by the hash of their pixels, as PNG, within a quota: the oldest Passed goes first, Failed is kept longest."""

from __future__ import annotations

import hashlib
import logging
import os
import queue
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wearline.config import Settings
from wearline.errors import RecordError

LOG = logging.getLogger(__name__)
U8 = NDArray[np.uint8]
_WAITING = 8
"""Frames that may wait for the disk; 2 MB each."""
_FASTEST = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class FrameSettings(Settings):
    """How much of the disk frames may take."""

    frames_quota_mb: float = Field(default=4096.0, ge=0)
    """0 = keep none. [MB]"""


class Class(StrEnum):
    """What a frame is worth, in the order in which they go."""

    PASSED = "passed"
    NOT_MEASURED = "not_measured"
    FAILED = "failed"


def pixel_hash(pixels: U8) -> str:
    """sha256 of the pixels, hex, as `LinePoints.frame_hash` has it."""
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


@dataclass(frozen=True)
class _Job:
    pixels: U8
    kind: Class


class FrameStore:
    """Writes on a thread of its own, so that no verdict waits for it; what cannot keep up is counted and left out."""

    def __init__(self, folder: Path, settings: FrameSettings, is_low: Callable[[], bool] = lambda: False) -> None:
        """`is_low` says whether the disk is so full that frames must give way to records."""
        self._folder, self._quota_bytes, self._is_low = folder, int(settings.frames_quota_mb * 1e6), is_low
        self._kept: dict[Class, OrderedDict[str, int]] = {kind: OrderedDict() for kind in Class}
        self.left_out = 0
        """Frames that were not stored: the disk was full, failed or too slow."""
        self._jobs: queue.Queue[_Job | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._work, name="frames", daemon=True)
        if self._quota_bytes:
            self._thread.start()

    def put(self, pixels: U8, kind: Class) -> None:
        """Store one frame soon; returns at once."""
        if not self._quota_bytes:
            return
        try:
            self._jobs.put_nowait(_Job(pixels, kind))
        except queue.Full:
            self.left_out += 1

    def get(self, name: str) -> U8:
        """The pixels [row, col] of that hash.

        Raises:
            RecordError: it is not here any more, or was altered.
        """
        what = f"frame {name[:12] or '(none)'}"
        for kind in reversed(Class):
            path = self._path(name, kind)
            if name.isalnum() and path.is_file():
                pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
                if pixels is None or pixels.dtype != np.uint8 or pixel_hash(np.asarray(pixels, np.uint8)) != name:
                    raise RecordError("was altered on disk", what, "restore a backup")
                return np.asarray(pixels, np.uint8)
        raise RecordError("is not stored (any more)", what, "raise judge.frames_quota_mb to keep frames longer")

    def close(self) -> None:
        """Store what waits, then stop."""
        if self._thread.is_alive():
            self._jobs.put(None)
            self._thread.join(timeout=1.0)

    def _path(self, name: str, kind: Class) -> Path:
        return self._folder / kind.value / name[:2] / f"{name}.png"

    def _work(self) -> None:
        self._find()
        while (job := self._jobs.get()) is not None:
            try:
                self._store(job)
            except (OSError, cv2.error) as error:
                self.left_out += 1
                LOG.warning("a frame could not be stored: %s", error)

    def _find(self) -> None:
        """What is there from before, oldest first."""
        for kind in Class:
            found: list[tuple[int, str, int]] = []
            for path in (self._folder / kind.value).glob("*/*.png"):
                about = path.stat()
                found.append((about.st_mtime_ns, path.stem, about.st_size))
            self._kept[kind].update((name, size) for _, name, size in sorted(found))

    def _store(self, job: _Job) -> None:
        if self._is_low():
            self.left_out += 1
            self._give_way()
            return
        name = pixel_hash(job.pixels)
        # A frame that was seen before keeps the better of its two places.
        if any(name in self._kept[kind] for kind in Class if list(Class).index(kind) >= list(Class).index(job.kind)):
            return
        fine, content = cv2.imencode(".png", job.pixels, _FASTEST)
        if not fine:
            raise OSError("PNG encoder failed")
        self._make_room(content.size)
        path = self._path(name, job.kind)
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(f".{name}.{os.getpid()}")
        draft.write_bytes(content.tobytes())
        draft.replace(path)
        self._kept[job.kind][name] = content.size

    def _give_way(self) -> None:
        """Remove the oldest frames of good parts until the disk has room, or none is left."""
        kept = self._kept[Class.PASSED]
        while kept and self._is_low():
            name, _ = kept.popitem(last=False)
            self._path(name, Class.PASSED).unlink(missing_ok=True)

    def _make_room(self, size: int) -> None:
        used = sum(sum(kept.values()) for kept in self._kept.values())
        for kind in Class:
            kept = self._kept[kind]
            while kept and used + size > self._quota_bytes:
                name, gone = kept.popitem(last=False)
                self._path(name, kind).unlink(missing_ok=True)
                used -= gone
