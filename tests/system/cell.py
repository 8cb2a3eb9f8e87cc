"""A simulated cell in a folder and on ports of its own: real processes, watched on the bus, audited afterwards."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml

from tests.contract.conftest import free_port
from wearline.bus import Bus
from wearline.demo.cell import LIMIT_MM, json_lines, prepare
from wearline.errors import BusError
from wearline.messages import (
    AskJournal,
    AskRecords,
    Journal,
    JournalEntry,
    MeasureRequest,
    Message,
    Outcome,
    RecordRow,
    Records,
    Verdict,
)
from wearline.supervisor import Supervisor
from wearline.topics import JOURNAL, MEASURE, OUTCOME, RECORDS, SERVICES, VERDICT, Query

ASIDE_MM = 0.03
"""A part whose true mean error lies so close to the limit may go either way. [mm]"""
MEASURED = (1, 2, 3)
"""Result codes that say that a part was measured."""
WORN_AFTER = 100
"""Strokes after which the die makes parts that must fail."""


@dataclass(frozen=True)
class Heard:
    """One message of a cycle, and when it came (monotonic). [s]"""

    at_s: float
    message: MeasureRequest | Verdict | Outcome


@dataclass
class Books:
    """All that a cell has written down about its cycles, and the truth beside it."""

    journal: list[JournalEntry]
    records: list[RecordRow]
    believed: list[dict[str, Any]]
    """Lines of the PLC's own log."""
    truth: dict[str, dict[str, Any]]
    """By cycle_id, from the simulated head."""
    faults: list[str] = field(default_factory=list)

    def audit(self) -> list[str]:
        """Every sentence is a broken promise; empty when all were kept."""
        self._audit_records()
        self._audit_passed()
        return self.faults

    def _audit_records(self) -> None:
        counts: dict[str, int] = {}
        for row in self.records:
            counts[row.cycle_id] = counts.get(row.cycle_id, 0) + 1
        accepted = [entry.request.cycle_id for entry in self.journal]
        for cycle_id in accepted:
            if counts.get(cycle_id, 0) != 1:
                self.faults.append(f"{cycle_id} was accepted and has {counts.get(cycle_id, 0)} records")
        self.faults += [f"{cycle_id} is recorded and was never accepted" for cycle_id in counts.keys() - set(accepted)]
        self.faults += [f"{c} was accepted twice" for c in set(accepted) if accepted.count(c) > 1]
        told = {row.cycle_id: row.told_code for row in self.records}
        for entry in self.journal:
            if entry.outcome is None:
                self.faults.append(f"{entry.request.cycle_id} has no outcome")
            elif entry.outcome.was_told and told.get(entry.request.cycle_id) != entry.outcome.code:
                self.faults.append(
                    f"{entry.request.cycle_id}: the PLC was told {entry.outcome.code}, "
                    f"the record says {told.get(entry.request.cycle_id)}"
                )

    def _audit_passed(self) -> None:
        by_number = {entry.request.measure_number: entry for entry in self.journal}
        for line in self.believed:
            if not line["passed"]:
                continue
            entry = by_number.get(line["measure_number"])
            place = f"stroke {line['stroke']}, measure number {line['measure_number']}"
            if entry is None:
                self.faults.append(f"{place}: Passed without an accepted Measure")
                continue
            truth = self.truth.get(entry.request.cycle_id)
            if truth is None:
                self.faults.append(f"{place}: Passed without a frame")
            elif truth["stroke"] != line["stroke"]:
                self.faults.append(f"{place}: Passed by the frame of stroke {truth['stroke']}")
            elif truth["true_mean_mm"] > LIMIT_MM + ASIDE_MM:
                self.faults.append(f"{place}: Passed with a true mean error of {truth['true_mean_mm']:.3f} mm")
            if entry.outcome is None or not entry.outcome.passed:
                self.faults.append(f"{place}: Passed, and no outcome says so")


def prepared(folder: Path) -> Path:
    """A folder with what every simulated cell needs (calibration, template, released object), made once per run."""
    cell = SimulatedCell(folder)
    prepare(cell.path, lambda text: None)
    return folder


class SimulatedCell:
    """Router, five services and a soft PLC; a context that starts and stops them.

    The supervisor lives on a thread of its own: its processes die with the thread that started them.
    """

    def __init__(
        self,
        folder: Path,
        taught: Path | None = None,
        name: str = "c1",
        stroke_period_s: float = 0.8,
        first_stroke: int = 1,
        certificates: Path | None = None,
    ) -> None:
        self.name, self.folder = name, folder
        folder.mkdir(parents=True, exist_ok=True)
        if taught is not None:
            for part in ("prepared", "judge"):
                shutil.copytree(taught / part, folder / part)
            shutil.copyfile(taught / "prepared.json", folder / "prepared.json")
        self.path = folder / "cell.yaml"
        plc_port = free_port()
        self.metrics_ports = {service: free_port() for service in SERVICES}
        content = {
            "cell": name,
            "data_dir": ".",
            "plc_is_simulated": True,
            "router": {"endpoint": f"tcp/127.0.0.1:{free_port()}"}
            if certificates is None
            else {
                "endpoint": f"tls/127.0.0.1:{free_port()}",
                "tls": {"authority": str(certificates / "authority.pem"), "folder": str(certificates)},
            },
            "metrics_ports": self.metrics_ports,
            "capture": {"kind": "sim"},
            "fieldbus": {"plc": {"host": "127.0.0.1", "port": plc_port}},
            "hmi": {"port": free_port()},
            "plc_sim": {"port": plc_port, "stroke_period_s": stroke_period_s, "object_index": 1},
        }
        self.path.write_text(yaml.safe_dump(content), encoding="utf-8")
        if first_stroke > 1:
            # As if the strokes before had been made by an earlier run.
            (folder / "plc_sim").mkdir(exist_ok=True)
            line = {"stroke": first_stroke - 1, "measure_number": first_stroke - 1, "passed": False, "code": 0}
            (folder / "plc_sim" / "log.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
        self.heard: list[Heard] = []
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._supervisor: Supervisor | None = None
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None
        self._bus: Bus | None = None
        self.on_outcome: Callable[[Outcome], None] = lambda outcome: None

    # --- life ---

    def __enter__(self) -> Self:
        supervisor = self._supervisor = Supervisor(self.path, with_plc_sim=True)
        self._thread = threading.Thread(target=self._live, args=(supervisor,), name=f"cell {self.name}", daemon=True)
        self._thread.start()
        router = supervisor.cell.router
        # With certificates the watcher must be somebody; the HMI hears most.
        self._bus = Bus(self.name, "watcher" if router.tls is None else "hmi", router.endpoint, router.tls)
        try:
            self._bus.open(timeout_s=20.0)
            for topic in (MEASURE, VERDICT, OUTCOME):
                self._bus.subscribe(topic, self._hear)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._bus is not None:
            self._bus.close()
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)
        assert self._error is None, f"the supervisor of {self.name} failed: {self._error}"

    def _live(self, supervisor: Supervisor) -> None:
        try:
            with supervisor:
                supervisor.run(self._stop)
        except BaseException as error:
            self._error = error

    def pid(self, name: str) -> int:
        """Of a process that runs now.

        Raises:
            KeyError: it does not.
        """
        assert self._supervisor is not None
        return self._supervisor.pids()[name]

    def kill(self, name: str, how: signal.Signals = signal.SIGKILL) -> float:
        """Kill one process of the cell; when that was (monotonic). [s]"""
        os.kill(self.pid(name), how)
        return time.monotonic()

    # --- what is heard ---

    def _hear(self, message: MeasureRequest | Verdict | Outcome) -> None:
        with self._changed:
            self.heard.append(Heard(time.monotonic(), message))
            self._changed.notify_all()
        if isinstance(message, Outcome):
            self.on_outcome(message)

    def wait(self, condition: Callable[[list[Heard]], bool], within_s: float, what: str) -> list[Heard]:
        """All that was heard, once the condition holds."""
        with self._changed:
            is_met = self._changed.wait_for(lambda: condition(self.heard), within_s)
            heard = list(self.heard)
        assert is_met, f"{self.name}: not within {within_s:g} s: {what}\n{self.last_words()}"
        return heard

    def wait_for_next(self, kind: type[Message], within_s: float = 20.0) -> Heard:
        """The next message of that kind from now on."""
        after_s = time.monotonic()
        self.wait(lambda all_: any(isinstance(h.message, kind) and h.at_s > after_s for h in all_), within_s, str(kind))
        return next(h for h in self.heard if isinstance(h.message, kind) and h.at_s > after_s)

    def wait_until_measured(self, after_s: float, within_s: float, times: int = 1) -> float:
        """When the PLC was next told of parts that were measured (their Measure came after ``after_s``). [s]"""

        def found(heard: list[Heard]) -> list[float]:
            fresh = {h.message.cycle_id for h in heard if isinstance(h.message, MeasureRequest) and h.at_s > after_s}
            return [h.at_s for h in heard if _is_measured(h.message) and h.message.cycle_id in fresh]

        return found(self.wait(lambda all_: len(found(all_)) >= times, within_s, "a part is measured"))[times - 1]

    def outcomes(self) -> list[Outcome]:
        """What the PLC was told, in order; each cycle once."""
        found = {h.message.cycle_id: h.message for h in self.heard if isinstance(h.message, Outcome)}
        return list(found.values())

    # --- what the die does ---

    def wear_every_other_part(self) -> None:
        """From stroke `WORN_AFTER` on, every other part is bad, so that a stale verdict is a wrong one."""

        def turn(outcome: Outcome) -> None:
            stroke = outcome.request.stroke
            self._set_die([stroke] if stroke % 2 else [])

        self._set_die([])
        self.on_outcome = turn

    def _set_die(self, regrinds: list[int]) -> None:
        path = self.folder / "capture" / "die.json"
        path.parent.mkdir(exist_ok=True)
        draft = path.with_suffix(".new")
        draft.write_text(json.dumps({"regrinds": regrinds}) + "\n", encoding="utf-8")
        draft.replace(path)

    # --- what was written down ---

    def ask(self, query: Query, question: Message, within_s: float = 20.0) -> Message:
        """An answer, also while the answerer is being started anew."""
        assert self._bus is not None
        end_s = time.monotonic() + within_s
        pause = threading.Event()
        while True:
            try:
                return self._bus.ask(query, question, timeout_s=5.0)
            except BusError:
                if time.monotonic() > end_s:
                    raise
            pause.wait(0.1)

    def books(self, within_s: float = 20.0) -> Books:
        """Everything about the cycles that have ended; the PLC makes no more strokes from now on."""
        self.stop_press()
        end_s = time.monotonic() + within_s
        pause = threading.Event()
        while True:
            books = self._read()
            told = {row.cycle_id: row.told_code is not None for row in books.records}
            is_whole = all(
                entry.outcome is not None and told.get(entry.request.cycle_id, False) >= entry.outcome.was_told
                for entry in books.journal
            )
            if (is_whole and len(told) >= len(books.journal)) or time.monotonic() > end_s:
                return books
            pause.wait(0.2)

    def stop_press(self) -> None:
        """No more strokes: the soft PLC goes, and what is in flight ends."""
        assert self._supervisor is not None
        os.kill(self.pid("plc-sim"), signal.SIGTERM)
        end_s = time.monotonic() + 5.0
        pause = threading.Event()
        while not self._supervisor.is_done("plc-sim"):
            assert time.monotonic() < end_s, "the soft PLC does not stop"
            pause.wait(0.05)

    def _read(self) -> Books:
        entries: dict[str, JournalEntry] = {}
        since = ""
        while True:
            answer = self.ask(JOURNAL, AskJournal(since_utc=since))
            assert isinstance(answer, Journal)
            fresh = [entry for entry in answer.entries if entry.request.cycle_id not in entries]
            entries |= {entry.request.cycle_id: entry for entry in fresh}
            if not fresh:
                break
            since = fresh[-1].accepted_utc
        records = self.ask(RECORDS, AskRecords(last=10_000))
        assert isinstance(records, Records)
        capture = self.folder / "capture"
        return Books(
            journal=list(entries.values()),
            records=list(records.rows),
            believed=[line for line in json_lines(self.folder / "plc_sim" / "log.jsonl") if "ms" in line],
            truth={str(line["cycle_id"]): line for line in json_lines(capture / "truth.jsonl")},
        )

    def last_words(self) -> str:
        """The ends of all logs, for a test that fails."""
        words = []
        for path in sorted((self.folder / "log").glob("*.log")):
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()[-4:]
            words.append(f"--- {path.name}\n" + "\n".join(line[:400] for line in lines))
        return "\n".join(words)


def _is_measured(message: object) -> bool:
    return isinstance(message, Outcome) and message.was_told and message.code in MEASURED


def cycle_seconds(outcomes: Iterator[Outcome] | list[Outcome]) -> list[float]:
    """Measure to finished of the parts that were told. [s]"""
    return [outcome.cycle_seconds for outcome in outcomes if outcome.was_told]
