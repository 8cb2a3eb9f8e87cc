"""What every test may rely on."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With WEARLINE_NO_SKIP=1 (CI) a skipped test is a failed test."""
    report = yield
    if os.environ.get("WEARLINE_NO_SKIP") == "1" and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped where nothing may be skipped: {report.longrepr}"
    return report


@pytest.fixture(scope="session")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Calibration, template and released object of the simulated head, for cells that run (`tests/system/cell.py`)."""
    from tests.system.cell import prepared

    return prepared(tmp_path_factory.mktemp("taught"))
