"""What a live judge keeps on disk."""

from __future__ import annotations

from dataclasses import dataclass

from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.frames import FrameStore
from wearline_judge.drivers.objects import ObjectFile
from wearline_judge.drivers.records import RecordStore
from wearline_judge.drivers.room import Room


@dataclass(frozen=True)
class Stores:
    """All of it, open."""

    objects: ObjectFile
    blobs: BlobStore
    records: RecordStore
    frames: FrameStore
    room: Room
