"""The faults happen to the cell of the system tests."""

from tests.system.conftest import taught

__all__ = ["taught"]
