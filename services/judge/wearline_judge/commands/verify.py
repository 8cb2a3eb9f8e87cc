"""``wearline verify``: find the first record that was altered."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from wearline.cli import Command, progress
from wearline.config import load_cell, validated
from wearline_judge.config import JudgeSettings
from wearline_judge.drivers.chain import ChainError
from wearline_judge.service import open_records


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")


def _run(arguments: Namespace) -> int:
    cell = load_cell(arguments.config)
    records = open_records(cell, validated(JudgeSettings, cell.judge, f"{arguments.config}: judge"), must_exist=True)
    try:
        total = 0
        for _ in progress(records.verified(), "verify", records.count_entries()):
            total += 1
    except ChainError as error:
        print(f"{arguments.config}: {error}")
        return 1
    finally:
        records.close()
    print(f"{arguments.config}: {total} entries, none altered")
    return 0


VERIFY = Command("verify", "check the chain of records and find the first altered one", _configure, _run)
