"""The judge as a service of the cell."""

from wearline_judge.service.judge import Judge
from wearline_judge.service.opening import build, offline, open_records, open_stores
from wearline_judge.service.stores import Stores

__all__ = ["Judge", "Stores", "build", "offline", "open_records", "open_stores"]
