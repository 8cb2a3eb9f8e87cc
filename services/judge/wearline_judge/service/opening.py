"""Builds the judge: live with its stores, or offline without."""

from __future__ import annotations

import cv2

from wearline.config import CellSettings
from wearline.service import Asker, Service
from wearline_judge.config import JudgeSettings
from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.chain import key_of
from wearline_judge.drivers.fingerprint import code_version
from wearline_judge.drivers.frames import FrameStore
from wearline_judge.drivers.lock import FolderLock
from wearline_judge.drivers.objects import ObjectFile
from wearline_judge.drivers.records import RecordStore, sqlite_url
from wearline_judge.drivers.references import AskedReferences, StoredReferences
from wearline_judge.drivers.room import Room
from wearline_judge.service.judge import Judge
from wearline_judge.service.stores import Stores


def open_records(cell: CellSettings, settings: JudgeSettings, *, must_exist: bool = False) -> RecordStore:
    """The records of a cell.

    Raises:
        ConfigError: judge.records_url is no URL.
        RecordError: the records or the key cannot be used.
    """
    folder = cell.data_folder("judge")
    url = settings.records_url or sqlite_url(folder / "records.db")
    return RecordStore(url, key_of(folder / "chain.key"), must_exist=must_exist)


def open_stores(cell: CellSettings, settings: JudgeSettings) -> Stores:
    """The stores of a cell.

    Raises:
        ConfigError: judge.records_url is no URL.
        RecordError: the records cannot be used.
    """
    folder = cell.data_folder("judge")
    room = Room(folder, settings)
    return Stores(
        ObjectFile(folder / "objects.json"),
        BlobStore(folder),
        open_records(cell, settings),
        FrameStore(folder / "frames", settings, room.is_low),
        room,
    )


def build(cell: CellSettings, settings: JudgeSettings) -> Service:
    """The live service.

    Raises:
        ConfigError: judge.records_url is no URL.
        RecordError: the records cannot be used, or another judge uses them.
    """
    cv2.setNumThreads(1)  # a pool of threads would take the processors from the other services
    lock = FolderLock(cell.data_folder("judge"))
    try:
        stores = open_stores(cell, settings)
    except BaseException:
        lock.close()
        raise
    return Judge(
        cell.cell, settings, StoredReferences(stores.objects, stores.blobs), stores,
        accepts_simulated=cell.plc_is_simulated, version=code_version(), lock=lock,
    )  # fmt: skip


def offline(asker: Asker) -> Service:
    """The same handlers without files of their own."""
    cv2.setNumThreads(1)
    service = Judge("offline", JudgeSettings(), AskedReferences(asker), version=code_version())
    for _ in service.start(asker):
        pass
    return service
