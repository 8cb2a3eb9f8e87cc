"""``wearline verify``: find the first record that was altered."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from wearline.cli import Command, progress
from wearline_judge.commands.stored import stored_cell
from wearline_judge.drivers.chain import ChainError


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")


def _run(arguments: Namespace) -> int:
    with stored_cell(arguments.config) as stored:
        total = 0
        try:
            for _ in progress(stored.records.verified(), "verify", stored.records.count_entries()):
                total += 1
        except ChainError as error:
            print(f"{arguments.config}: {error}")
            return 1
    print(f"{arguments.config}: {total} entries, none altered")
    return 0


VERIFY = Command("verify", "check the chain of records and find the first altered one", _configure, _run)
