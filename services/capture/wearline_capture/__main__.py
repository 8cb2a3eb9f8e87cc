"""``python -m wearline_capture --config CELL.yaml``."""

from wearline.runner import main
from wearline_capture.config import CaptureSettings
from wearline_capture.service import build

if __name__ == "__main__":
    main("capture", CaptureSettings, build)
