"""``python -m wearline_hmi --config CELL.yaml``."""

from functools import partial

from wearline.config import CellSettings
from wearline.runner import main
from wearline.service import Service
from wearline_hmi.config import HmiSettings
from wearline_hmi.drivers.event_log import EventLog
from wearline_hmi.pages import open_web
from wearline_hmi.service import HmiService


def build(cell: CellSettings, settings: HmiSettings) -> Service:
    """The live service with its web server."""
    folder = cell.data_folder("hmi")
    return HmiService(cell, settings, partial(open_web, folder=folder), event_log=EventLog(folder / "events.db"))


if __name__ == "__main__":
    main("hmi", HmiSettings, build)
