"""Wearline capture: camera drivers to frames."""
