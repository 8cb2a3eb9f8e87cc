"""``python -m wearline_reconstruct --config CELL.yaml``."""

from wearline.runner import main
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.service import build

if __name__ == "__main__":
    main("reconstruct", ReconstructSettings, build)
