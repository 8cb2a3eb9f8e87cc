"""What a simulated cell needs, made once per run."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.cell import prepared


@pytest.fixture(scope="session")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Calibration, template and released object of the simulated head."""
    return prepared(tmp_path_factory.mktemp("taught"))
