"""``wearline demo``: a whole simulated cell on loopback, from laser light to the PLC's result word.

Router, five services and a simulated PLC run as processes of their own, as they would at a press;
this process prepares their data, watches them on the bus and shows what happens.
"""

from __future__ import annotations

import fcntl
import shutil
import threading
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from wearline.bus import Bus
from wearline.cli import Command
from wearline.config import CellSettings
from wearline.demo import screen
from wearline.demo.cell import LIMIT_MM, OBJECT_INDEX, SCAN_MS, json_lines, last_stroke, prepare, regrind, write_cell
from wearline.demo.tally import Believed, Row, Summary, Tally, Truth, summarise
from wearline.errors import BusError, ConfigError, DeviceError, UsageError
from wearline.messages import AskRecords, DieEvent, Outcome, Records, ServiceState, Verdict
from wearline.stop import StopSignal
from wearline.supervisor import PLC_SIM, Supervisor
from wearline.topics import DIE_EVENT, OUTCOME, RECORDS, SERVICES, STATES, VERDICT

FRESH_S = 3.0
"""A service that said nothing for so long is shown as gone. [s]"""
TREND_S = 2.0
"""Between two looks at the trend. [s]"""
REGRIND_STROKES = 130
"""An endless demo grinds its die after so many strokes; by then it has failed parts for a good while."""
STUCK_S = 60.0
"""A counted run that sees no stroke for so long, and for many stroke periods, will see none. [s]"""
LAST_S = 3.0
"""What the PLC has heard, its outcome message and record may need to arrive at the end. [s]"""


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("--strokes", type=int, metavar="N", help="end after N strokes (default: with Ctrl-C)")
    parser.add_argument("--headless", action="store_true", help="a line per stroke and a summary, for scripts")
    parser.add_argument("--data", type=Path, default=Path("run/demo"), metavar="DIR", help="default run/demo")
    parser.add_argument("--base-port", type=int, default=8440, metavar="P", help="uses P to P+8 (default 8440)")
    parser.add_argument(
        "--stroke-period", type=float, default=1.5, metavar="S", help="seconds per stroke (default 1.5)"
    )
    parser.add_argument("--prepare-only", action="store_true", help="only calibrate and teach, then end")
    parser.add_argument("--cell", type=Path, metavar="CELL.yaml", help="with --prepare-only: for this simulated cell")


def _run(arguments: Namespace) -> int:
    if arguments.strokes is not None and arguments.strokes < 1:
        raise UsageError(f"{arguments.strokes} strokes cannot be", "--strokes", "give 1 or more")
    if not 1024 <= arguments.base_port <= 65527:
        raise UsageError(f"port {arguments.base_port} cannot be", "--base-port", "give 1024 to 65527")
    if not 0.2 <= arguments.stroke_period <= 3600.0:
        raise UsageError(f"{arguments.stroke_period:g} s cannot be", "--stroke-period", "give 0.2 to 3600")
    console = Console(highlight=False)
    if arguments.cell is not None:
        if not arguments.prepare_only:
            raise UsageError("goes with --prepare-only", "--cell", "run the cell with 'wearline up'")
        prepare(arguments.cell, console.print)
        return 0
    folder = arguments.data.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        path = write_cell(folder, arguments.base_port, arguments.strokes, arguments.stroke_period)
        started_s = time.monotonic()
        if prepare(path, console.print):
            console.print(f"prepared in {time.monotonic() - started_s:.1f} s")
        if arguments.prepare_only:
            return 0
        return _Demo(path, arguments.strokes, arguments.headless or not console.is_terminal, console).run()


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two demos must not share a folder."""
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(
                "another demo runs there", str(folder), "end it, or name another folder and other ports"
            ) from error
        yield


class _Demo:
    """One run. Bus threads only put what they hear into the tally; all else happens on the main thread."""

    def __init__(self, path: Path, strokes: int | None, is_headless: bool, console: Console) -> None:
        self._supervisor = Supervisor(path, with_plc_sim=True)
        self._cell: CellSettings = self._supervisor.cell
        self._strokes, self._is_headless, self._console = strokes, is_headless, console
        self._bus = Bus(self._cell.cell, "demo", self._cell.router.endpoint)
        self._tally, self._lock = Tally(), threading.Lock()
        self._heard_s: dict[str, float] = {}
        self._is_plc_linked = False
        self._picture = screen.Picture(self._address(), limit_mm=LIMIT_MM, wanted=strokes)
        self._printed = self._moved_rows = 0
        self._moved_s = 0.0
        self._stuck_s = max(STUCK_S, 10.0 * float(self._cell.plc_sim["stroke_period_s"]))
        self._trend_at_s = 0.0
        self._die_event: DieEvent | None = None

    def _address(self) -> str:
        return f"http://127.0.0.1:{self._cell.hmi['port']}/"

    def run(self) -> int:
        self._regrind()
        first_stroke = last_stroke(self._cell) + 1
        started_s = self._moved_s = time.monotonic()
        with StopSignal() as stop, self._supervisor:
            self._say(f"cell '{self._cell.cell}' starts; HMI: {self._picture.address}")
            self._bus.open(timeout_s=20.0)
            try:
                self._listen()
                with self._shown() as update:
                    while not stop.wait(0.1) and not self._supervisor.is_done(PLC_SIM):
                        self._supervisor.step()
                        self._look()
                        update()
                        self._check_moving()
                    is_done = self._supervisor.is_done(PLC_SIM)
                    if is_done:
                        self._wait_for_the_last(stop)
                    update()
                seconds = time.monotonic() - started_s
                # A cell that is told to stop has no time for questions.
                summary = self._summary(first_stroke) if is_done else None
            finally:
                self._bus.close()
        if summary is None:
            self._say("stopped")
            return 0
        for text in screen.summary_lines(summary, SCAN_MS, seconds):
            self._say(text)
        return 0 if summary.is_right else 1

    # --- what is heard ---

    def _listen(self) -> None:
        self._bus.subscribe(VERDICT, self._locked(self._tally.on_verdict))
        self._bus.subscribe(OUTCOME, self._locked(self._tally.on_outcome))
        for topic in STATES.values():
            self._bus.subscribe(topic, self._locked(self._on_state))

    def _locked(self, on_message: Callable[[Any], None]) -> Callable[[Any], None]:
        def take(message: Verdict | Outcome | ServiceState) -> None:
            with self._lock:
                on_message(message)

        return take

    def _on_state(self, state: ServiceState) -> None:
        self._heard_s[state.service] = time.monotonic()
        if state.service == "fieldbus":
            self._is_plc_linked = bool(state.values.get("plc_link_up"))

    # --- what is shown ---

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False, soft_wrap=True)

    @contextmanager
    def _shown(self) -> Iterator[Callable[[], None]]:
        if self._is_headless:
            yield self._print_new_rows
            return
        with Live(console=self._console, auto_refresh=False, screen=False, transient=False) as live:

            def update() -> None:
                size = shutil.get_terminal_size()
                live.update(screen.draw(self._picture, size.columns, size.lines), refresh=True)

            yield update

    def _print_new_rows(self) -> None:
        rows = self._picture.rows
        # The outcome may be heard before the verdict that it rests on; its line waits for that.
        if rows and not rows[-1].is_whole and not self._supervisor.is_done(PLC_SIM):
            rows = rows[:-1]
        for row in rows[self._printed :]:
            self._say(screen.line(row))
        self._printed = max(self._printed, len(rows))

    def _look(self) -> None:
        now_s = time.monotonic()
        with self._lock:
            rows: tuple[Row, ...] = self._tally.ended
            there = {name: now_s - self._heard_s.get(name, -FRESH_S) < FRESH_S for name in SERVICES}
            is_linked = self._is_plc_linked and there["fieldbus"]
        self._picture = replace(self._picture, rows=rows, services=there, is_plc_linked=is_linked)
        if now_s >= self._trend_at_s and there["judge"]:
            self._trend_at_s = now_s + TREND_S
            self._tell_die_event()
            self._ask_trend()
        trend = self._picture.trend
        is_due = trend is not None and trend.strokes_since_service >= REGRIND_STROKES
        if self._strokes is None and is_due and self._die_event is None:
            self._regrind()

    def _regrind(self) -> None:
        stroke = regrind(self._cell)
        if stroke is None:
            return
        self._die_event = DieEvent(
            user="demo", object_index=OBJECT_INDEX, kind="regrind", note=f"reground after stroke {stroke}"
        )

    def _tell_die_event(self) -> None:
        if self._die_event is None:
            return
        try:
            self._bus.ask(DIE_EVENT, self._die_event, timeout_s=1.0)
        except BusError as error:
            self._picture = replace(self._picture, note=f"regrind not recorded yet: {error}")
            return
        note = f"die {self._die_event.note}"
        self._die_event = None
        # The old trend must not ask for another regrind.
        self._picture = replace(self._picture, note=note, trend=None)
        if self._is_headless:
            self._say(note)

    def _ask_trend(self) -> None:
        try:
            answer = self._bus.ask(RECORDS, AskRecords(last=1, object_index=OBJECT_INDEX), timeout_s=0.5)
        except BusError:
            return
        if isinstance(answer, Records) and answer.trends:
            self._picture = replace(self._picture, trend=answer.trends[0])

    def _check_moving(self) -> None:
        """A script that waits for the end of a counted run must not wait for ever."""
        if len(self._picture.rows) != self._moved_rows:
            self._moved_rows, self._moved_s = len(self._picture.rows), time.monotonic()
        if self._strokes is not None and time.monotonic() - self._moved_s > self._stuck_s:
            raise DeviceError(
                f"no stroke for {self._stuck_s:.0f} s",
                "demo",
                f"look into {self._cell.data_dir / 'log'} for the reason",
            )

    # --- how it ended ---

    def _wait_for_the_last(self, stop: StopSignal) -> None:
        deadline_s = time.monotonic() + LAST_S
        while time.monotonic() < deadline_s and len(self._picture.rows) < (self._strokes or 0) and not stop.wait(0.1):
            self._look()

    def _summary(self, first_stroke: int) -> Summary:
        with self._lock:
            tally = self._tally
        truth: dict[str, Truth] = {}
        for entry in json_lines(self._cell.data_dir / "capture" / "truth.jsonl"):
            truth[str(entry["cycle_id"])] = Truth(float(entry["wear_mm"]), float(entry["true_mean_mm"]))
        believed = [
            Believed(int(entry["measure_number"]), int(entry["code"]), bool(entry["passed"]))
            for entry in json_lines(self._cell.data_dir / "plc_sim" / "log.jsonl")
            if int(entry["stroke"]) >= first_stroke
        ]
        try:
            wanted = min(10_000, len(tally.ended) + 100)
            answer = self._bus.ask(RECORDS, AskRecords(last=wanted, object_index=OBJECT_INDEX), timeout_s=5.0)
        except BusError as error:
            raise ConfigError(f"the records could not be read ({error})", "demo", "look at judge's log") from error
        recorded = [row.cycle_id for row in answer.rows] if isinstance(answer, Records) else []
        return summarise(tally, truth, LIMIT_MM, recorded, believed)


DEMO = Command("demo", "a whole simulated cell: laser optics, wearing die, soft PLC, HMI", _configure, _run)
