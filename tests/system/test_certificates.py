"""A whole cell whose router believes nobody without a certificate: its services say only what they may."""

from __future__ import annotations

import json
import subprocess
import urllib.request
from pathlib import Path

import pytest

from tests.contract.test_access import SCRIPT
from tests.system.cell import SimulatedCell
from wearline.messages import AskRecords, Records
from wearline.topics import RECORDS, SERVICES


def test_a_cell_with_certificates_measures(tmp_path: Path, taught: Path) -> None:
    done = subprocess.run(
        [str(SCRIPT), "c1", str(tmp_path / "ca")], capture_output=True, text=True, timeout=60, check=False
    )
    if "no openssl" in done.stderr:
        pytest.skip("openssl is not installed (Debian: apt install openssl)")
    assert done.returncode == 0, done.stderr
    with SimulatedCell(tmp_path / "cell", taught, certificates=tmp_path / "ca") as cell:
        last_s = cell.wait_until_measured(0.0, within_s=40.0, times=3)
        assert last_s > 0
        # The outcome's way back to judge is allowed, too.
        records = cell.ask(RECORDS, AskRecords(last=10))
        assert isinstance(records, Records)
        assert sum(row.told_code == 1 for row in records.rows) >= 2
        for service in SERVICES:
            address = f"http://127.0.0.1:{cell.metrics_ports[service]}/healthz"
            with urllib.request.urlopen(address, timeout=5) as answer:
                assert json.load(answer)["router"] is True, service
