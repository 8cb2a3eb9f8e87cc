"""What is searched: promises that must hold, and assumptions left out, which must lead to a counterexample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

LINE = {"CUT": 1, "LATE": 1, "TORN": 1, "KILL": 1}
"""The connection ends; a write comes late or twice; a write or a read is torn; the gateway is killed."""
PLANT = {"PLC_RESTART": 1, "MIX": 1, "HANG": 1}
"""The PLC restarts; a verdict contradicts itself; the gateway stands still while time goes on."""
CELL = {"DISK": 1, "CAMERA": 1, "OBJECT": 1, "JUDGE": 1}
"""An entry cannot be written; camera stopped, object changed, judge lost while a cycle is under way."""
EVERYTHING = LINE | PLANT | CELL


@dataclass(frozen=True)
class Wanted:
    """One search."""

    name: str
    parameters: Mapping[str, int] = field(default_factory=dict)
    parts: int = 2
    is_liveness: bool = False
    violates: str = ""
    """Empty: it must hold. Else the promise that must be seen broken, as a part of pan's message."""


PASSED = "is_good"
"""Passed was believed for a part that is not good."""
OTHERS = "j_number"
"""Passed was believed that is not that of this Measure's record."""

DEFAULT = (
    Wanted("PLC may lose patience at any moment, no fault", {"FAULTS": 0}, parts=3),
    Wanted("PLC may lose patience, one cut or kill", {"FAULTS": 1, "CUT": 1, "KILL": 1}),
    Wanted("PLC waits 3 s, one fault of every kind", {"FAULTS": 1, "STRICT": 1, **EVERYTHING}),
    Wanted("no livelock, one cut or kill", {"FAULTS": 1, "STRICT": 1, "CUT": 1, "KILL": 1}, is_liveness=True),
    Wanted("not numbered, pause kept, no write comes late", {"NUMBERED": 0, "FAULTS": 1, "CUT": 1}),
    Wanted("4 + 4 wires, not sampled as one", {"NUMBERED": 0, "WIRES": 1, "FAULTS": 1, "STRICT": 1, "TORN": 1}),
    Wanted("not numbered, WITHOUT the pause", {"NUMBERED": 0, "FAULTS": 0, "PAUSE": 0}, violates=PASSED),
    Wanted("not numbered, PLC does not look at Ready", {"NUMBERED": 0, "FAULTS": 0, "HASTY": 1}, violates=PASSED),
    Wanted(
        "not numbered, a write comes LATE", {"NUMBERED": 0, "FAULTS": 1, "LATE": 1, "STRICT": 1}, violates="j_number"
    ),
    Wanted("numbers FORGOTTEN by a PLC restart", {"FAULTS": 1, "PLC_RESTART": 1, "FORGETS": 1}, violates=PASSED),
)
"""The default size: two parts (three without faults), one fault, every moment."""

LARGE = (
    Wanted("PLC may lose patience, one fault of every kind", {"FAULTS": 1, **EVERYTHING}),
    Wanted("PLC may lose patience, two faults: cut, kill", {"FAULTS": 2, "CUT": 1, "KILL": 1}),
    Wanted("PLC may lose patience, two faults: late, torn", {"FAULTS": 2, "LATE": 1, "TORN": 1}),
    Wanted("PLC waits 3 s, two faults of the line", {"FAULTS": 2, "STRICT": 1, **LINE}),
    Wanted("PLC may lose patience, one cut", {"FAULTS": 1, "CUT": 1}, parts=3),
    Wanted("PLC may lose patience, one kill", {"FAULTS": 1, "KILL": 1}, parts=3),
    Wanted("PLC may lose patience, one torn write or read", {"FAULTS": 1, "TORN": 1}, parts=3),
    Wanted("PLC waits 3 s, one fault of every kind", {"FAULTS": 1, "STRICT": 1, **EVERYTHING}, parts=3),
    Wanted("PLC waits 3 s, one cut or kill", {"FAULTS": 1, "STRICT": 1, "CUT": 1, "KILL": 1}, parts=4),
    Wanted(
        "no livelock, one cut, kill or PLC restart", {"FAULTS": 1, "STRICT": 1, "CUT": 1, "KILL": 1, "PLC_RESTART": 1},
        is_liveness=True,
    ),
    Wanted("4 + 4 wires, two not sampled as one", {"NUMBERED": 0, "WIRES": 1, "FAULTS": 2, "TORN": 1}),
    Wanted("not numbered, one cut or kill", {"NUMBERED": 0, "FAULTS": 1, "CUT": 1, "KILL": 1}),
    Wanted(
        "code not compared, a late write TORN", {"FAULTS": 2, "LATE": 1, "TORN": 1, "BLIND_TO_CODE": 1}, violates=OTHERS
    ),
)  # fmt: skip
"""The larger size, for ``make proof``."""
