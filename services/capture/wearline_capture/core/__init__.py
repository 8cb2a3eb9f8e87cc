"""Pure parts of capture."""
