"""``python -m wearline_hmi --config CELL.yaml``."""

from functools import partial

from wearline.config import CellSettings
from wearline.runner import main
from wearline.service import Service
from wearline_hmi.config import HmiSettings
from wearline_hmi.pages import open_web
from wearline_hmi.service import HmiService


def build(cell: CellSettings, settings: HmiSettings) -> Service:
    """The live service with its web server."""
    return HmiService(cell, settings, partial(open_web, folder=cell.data_folder("hmi")))


if __name__ == "__main__":
    main("hmi", HmiSettings, build)
