"""``python -m wearline_judge --config CELL.yaml``."""

from wearline.runner import main
from wearline_judge.config import JudgeSettings
from wearline_judge.service import build

if __name__ == "__main__":
    main("judge", JudgeSettings, build)
