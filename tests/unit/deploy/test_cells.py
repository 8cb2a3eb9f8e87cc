"""The example cells: each can be obeyed by each service, and those for one host do not meet."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.unit.deploy.test_containers import DEPLOY
from wearline.cli import main
from wearline.config import load_cell, validated
from wearline.supervisor import _ports
from wearline.topics import SERVICES
from wearline_fieldbus.config import FieldbusSettings, PlcSimSettings

CELLS = sorted((DEPLOY / "cells").glob("*.yaml"))


@pytest.mark.parametrize("path", CELLS, ids=lambda path: path.stem)
@pytest.mark.parametrize("service", SERVICES)
def test_each_service_can_obey_each_example(
    path: Path, service: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["wearline"])
    with pytest.raises(SystemExit) as ended:
        main(["run", service, "--config", str(path), "--check-config"])
    said = capsys.readouterr()
    assert ended.value.code == 0, said.err
    assert said.out == f"{path}: {service} is valid\n"


@pytest.mark.parametrize("path", [p for p in CELLS if "plc_sim" in p.read_text()], ids=lambda path: path.stem)
def test_the_simulated_plc_is_where_fieldbus_looks(path: Path) -> None:
    cell = load_cell(path)
    assert cell.plc_is_simulated
    simulated = validated(PlcSimSettings, cell.plc_sim, str(path))
    asked = validated(FieldbusSettings, cell.fieldbus, str(path)).plc
    assert (simulated.port, simulated.db) == (asked.port, asked.db)


def test_there_is_an_example_of_each_kind() -> None:
    assert {path.stem for path in CELLS} == {"simulated", "s7-1500", "press-1", "press-2", "compose"}
    assert not load_cell(DEPLOY / "cells" / "s7-1500.yaml").plc_is_simulated


def test_two_cells_on_one_host_share_nothing() -> None:
    one, other = (load_cell(DEPLOY / "cells" / f"press-{number}.yaml") for number in (1, 2))
    assert one.cell != other.cell
    assert one.data_dir != other.data_dir
    ports = [port for cell in (one, other) for _, _, port in _ports(cell, with_plc_sim=True)]
    assert len(ports) == len(set(ports)) == 2 * 8
