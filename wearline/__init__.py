"""What every Wearline service shares: messages, topics, recipe, artifacts, bus and runner."""

from importlib import metadata

try:
    __version__ = metadata.version("wearline")
except metadata.PackageNotFoundError:
    # Run from a source tree that is on the path but not installed.
    __version__ = "0+source"
