"""``wearline plc-sim`` and ``wearline plc-kit``."""

from __future__ import annotations

import logging
import sys
import time
from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path

from wearline.cli import Command
from wearline.config import load_cell, validated
from wearline.errors import UsageError
from wearline.log import start_log
from wearline.stop import StopSignal
from wearline_fieldbus.config import FieldbusSettings, PlcSimSettings, make_profile
from wearline_fieldbus.core.profiles import PROFILES, Direction
from wearline_fieldbus.core.soft_plc import SOFT_PLCS, SoftPlc
from wearline_fieldbus.core.tia import kit
from wearline_fieldbus.drivers.s7_server import S7Server
from wearline_fieldbus.drivers.stroke_log import StrokeLog

LOG = logging.getLogger(__name__)

RELEASE_S = 0.5
"""After the last stroke, for Wearline to take its result back. [s]"""


def _configure_plc_sim(parser: ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")
    parser.add_argument("--profile", choices=tuple(PROFILES), help="layout of the DB (default: as cell.yaml says)")
    parser.add_argument("--strokes", type=int, metavar="N", help="end after so many (default: as cell.yaml says)")


def _run_plc_sim(arguments: Namespace) -> int:
    cell = load_cell(arguments.config)
    given = {"strokes": arguments.strokes, "profile": arguments.profile or cell.fieldbus.get("profile")}
    section = {**cell.plc_sim, **{name: value for name, value in given.items() if value is not None}}
    settings = validated(PlcSimSettings, section, f"{arguments.config}: plc_sim")
    start_log(cell.cell, "plc-sim")
    log = StrokeLog(cell.data_folder("plc_sim") / "log.jsonl")
    plc = SOFT_PLCS[settings.profile](settings, log.stroke, log.measure_number)
    server = S7Server(settings.host, settings.port, settings.db, PROFILES[settings.profile].size)
    LOG.info("soft PLC: DB%d on %s:%d, stroke %d comes next", settings.db, settings.host, server.port, plc.stroke + 1)
    try:
        with StopSignal() as stop:
            _run_program(plc, server, log, settings, stop)
    finally:
        server.close()
        log.close()
    return 0


def _run_program(plc: SoftPlc, server: S7Server, log: StrokeLog, settings: PlcSimSettings, stop: StopSignal) -> None:
    """Scan until stopped, or until the last stroke is over and its result taken back (with a limit to the wait)."""
    profile = PROFILES[settings.profile]
    start, end = profile.span(Direction.REQUEST)
    due_s = time.monotonic()
    end_s = float("inf")
    while due_s < end_s and not (settings.strokes is not None and log.lines >= settings.strokes and plc.is_released):
        with server.memory() as memory:
            belief = plc.scan(profile.decode(bytes(memory), Direction.RESPONSE), time.monotonic())
            memory[start:end] = profile.encode(plc.request(), Direction.REQUEST)
        if belief is not None:
            log.add(asdict(belief))
            if log.lines == settings.strokes:
                end_s = due_s + RELEASE_S
        due_s = max(due_s + settings.scan_ms / 1000.0, time.monotonic())
        if stop.wait(max(0.0, due_s - time.monotonic())):
            return


PLC_SIM = Command(
    "plc-sim", "a simulated Siemens PLC with its press line, behind the real S7 protocol", _configure_plc_sim,
    _run_plc_sim,
)  # fmt: skip


def _configure_plc_kit(parser: ArgumentParser) -> None:
    parser.add_argument("--profile", choices=tuple(PROFILES), help="default: as cell.yaml says, else basic")
    parser.add_argument("--config", type=Path, metavar="CELL.yaml", help="a cell: its profile, remap and DB number")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def _run_plc_kit(arguments: Namespace) -> int:
    settings = FieldbusSettings()
    if arguments.config is not None:
        section = load_cell(arguments.config).fieldbus
        settings = validated(FieldbusSettings, section, f"{arguments.config}: fieldbus")
    if arguments.profile not in (None, settings.profile):
        if settings.remap:
            raise UsageError(
                f"the remap of {arguments.config} is of profile {settings.profile}", f"--profile {arguments.profile}",
                "leave --profile out",
            )  # fmt: skip
        settings = settings.model_copy(update={"profile": arguments.profile})
    profile = make_profile(settings)
    if not settings.handshake.numbered:
        raise UsageError(
            "a PLC that numbers nothing has no function block of ours", "handshake.numbered",
            "number the measurements, or write the PLC's side yourself",
        )  # fmt: skip
    try:
        files = dict(kit(profile, settings.plc.db, settings.plc.poll_ms))
    except ValueError as error:
        raise UsageError(f"no data type has this layout ({error})", "fieldbus.remap", "move the field") from error
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        # TIA Portal reads UTF-8 with a byte order mark.
        (arguments.out / name).write_text(
            text, encoding="utf-8" if name.endswith(".md") else "utf-8-sig", newline="\r\n"
        )
        sys.stdout.write(f"{arguments.out / name}\n")
    return 0


PLC_KIT = Command(
    "plc-kit", "data type, data block and function block for TIA Portal", _configure_plc_kit, _run_plc_kit
)
