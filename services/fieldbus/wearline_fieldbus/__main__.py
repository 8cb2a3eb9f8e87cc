"""``python -m wearline_fieldbus --config CELL.yaml``."""

from wearline.runner import main
from wearline_fieldbus.config import FieldbusSettings
from wearline_fieldbus.service import build

if __name__ == "__main__":
    main("fieldbus", FieldbusSettings, build)
