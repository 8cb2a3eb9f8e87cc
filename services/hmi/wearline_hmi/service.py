"""The web interface as a service of the cell: messages in, snapshots for the web server out.

The runner's thread handles messages; the web server's thread reads `snapshot`, one immutable
object that is replaced as a whole, and asks other services on threads of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Protocol

from wearline.config import CellSettings
from wearline.errors import BusError
from wearline.messages import (
    AskRecords,
    AskWearMap,
    Event,
    Message,
    Outcome,
    Preview,
    Records,
    ServiceState,
    Verdict,
    View,
    WearMap,
)
from wearline.service import Asker, Health, Service
from wearline.topics import EVENTS, OUTCOME, PREVIEW, RECORDS, STATES, VERDICT, VIEW, WEAR_MAP, Query, Topic
from wearline_hmi.config import HmiSettings
from wearline_hmi.core import state as cell_state
from wearline_hmi.core.state import CellState
from wearline_hmi.drivers.event_log import EventLog

RECORDS_ASKED = 100
RECORDS_TIMEOUT_S = 0.5
HISTORY_S = 2.0
"""What arrives so soon after the start may be history that the bus kept for late joiners. [s]"""


class Web(Protocol):
    """A running web server."""

    address: str

    def is_running(self) -> bool: ...

    def close(self) -> None: ...


class HmiService(Service):
    """Keeps the newest snapshot of the cell and the web server that shows it.

    `open_web` starts the server for this service; it may raise `ConfigError`.
    """

    name: ClassVar[str] = "hmi"
    tick_s = 0.5

    def __init__(
        self,
        cell: CellSettings,
        settings: HmiSettings,
        open_web: Callable[[HmiService], Web] | None = None,
        clock: Callable[[], float] = time.monotonic,
        event_log: EventLog | None = None,
    ) -> None:
        self.cell, self.settings, self.clock = cell, settings, clock
        self.snapshot = CellState(settings.title or cell.cell)
        self.event_log = event_log
        self._open_web = open_web
        self._web: Web | None = None
        self._asker: Asker | None = None
        self._ask_at_s = 0.0
        self._asks_failed = 0
        self._joined_s = clock()

    def start(self, asker: Asker) -> Iterable[Message]:
        self._asker = asker
        if self._open_web is not None:
            self._web = self._open_web(self)
        self._joined_s = self.clock()
        return ()

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[Message]]]:
        table: dict[Topic, Callable[[Any], Iterable[Message]]] = {
            VERDICT: self.on_verdict,
            VIEW: self.on_view,
            OUTCOME: self.on_outcome,
            PREVIEW: self.on_preview,
        }
        table.update(dict.fromkeys(STATES.values(), self.on_state))
        table.update(dict.fromkeys(EVENTS.values(), self.on_event))
        return table

    def on_verdict(self, verdict: Verdict) -> Iterable[Message]:
        now_s = self.clock()
        at_s = now_s if now_s - self._joined_s > HISTORY_S else None
        self.snapshot = cell_state.with_verdict(self.snapshot, verdict, at_s)
        return ()

    def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 2.0) -> Message:
        """Ask another service, from any thread.

        Raises:
            BusError: nobody answered in time, or the answerer refused (its sentence is the text).
        """
        if self._asker is None:
            raise BusError("is not open yet", "bus of hmi", "try again in a moment")
        return self._asker.ask(query, question, argument, timeout_s)

    def on_view(self, view: View) -> Iterable[Message]:
        self.snapshot = cell_state.with_view(self.snapshot, view, self.clock())
        return ()

    def on_outcome(self, outcome: Outcome) -> Iterable[Message]:
        self.snapshot = cell_state.with_outcome(self.snapshot, outcome)
        # Judge's outcome entry follows this message; then the trend is complete.
        self._ask_at_s = min(self._ask_at_s, self.clock() + 0.5)
        return ()

    def on_preview(self, preview: Preview) -> Iterable[Message]:
        self.snapshot = cell_state.with_preview(self.snapshot, preview, self.clock())
        return ()

    def on_state(self, state: ServiceState) -> Iterable[Message]:
        self.snapshot = cell_state.with_service(self.snapshot, state, self.clock())
        return ()

    def on_event(self, event: Event) -> Iterable[Message]:
        self.snapshot = cell_state.with_event(self.snapshot, event)
        if self.event_log is not None:
            self.event_log.add(event)
        return ()

    def on_alive(self, service: str, is_alive: bool) -> Iterable[Message]:
        self.snapshot = cell_state.with_alive(self.snapshot, service, is_alive)
        return ()

    def tick(self, now_s: float) -> Iterable[Message]:
        clock_s = self.clock()
        if self._asker is None or clock_s < self._ask_at_s:
            return ()
        period_s = self.settings.records_period_s
        try:
            answer = self._asker.ask(RECORDS, AskRecords(last=RECORDS_ASKED), timeout_s=RECORDS_TIMEOUT_S)
        except BusError:
            # Judge may be away; its absence is shown by its own row, and its records by their age.
            self._asks_failed += 1
            self._ask_at_s = clock_s + period_s
            return ()
        if isinstance(answer, Records):
            self._asks_failed = 0
            self.snapshot = cell_state.with_records(self.snapshot, answer, clock_s)
            self._ask_wear_map()
        self._ask_at_s = clock_s + period_s
        return ()

    def _ask_wear_map(self) -> None:
        index = cell_state.current_object(self.snapshot)
        if self._asker is None or index is None:
            return
        try:
            answer = self._asker.ask(WEAR_MAP, AskWearMap(object_index=index), timeout_s=RECORDS_TIMEOUT_S)
        except BusError:
            # The records came a moment ago; the map is asked for again with the next ones.
            return
        if isinstance(answer, WearMap):
            self.snapshot = cell_state.with_wear_map(self.snapshot, answer)

    def health(self) -> Health:
        address = "" if self._web is None else self._web.address
        values: dict[str, float | int | str | bool | None] = {"address": address}
        if self._web is not None and not self._web.is_running():
            return Health("degraded", "the web server has stopped", values)
        if self._asks_failed >= 3:
            return Health("degraded", "judge gives no records", values)
        return Health("ready", address, values)

    def close(self) -> None:
        if self._web is not None:
            self._web.close()
        if self.event_log is not None:
            self.event_log.close()
