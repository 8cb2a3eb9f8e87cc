"""The Promela model of a cell: `cell.pml` with the gateway's rows generated from the handshake's own table.

A row becomes one guarded command; guards and effects keep their names, and `cell.pml` says what they mean to the model.
Each guard of the table is wrapped, so that it can be left out without compiling anew (environment ``WITHOUT``).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from wearline_fieldbus.core.cycle import Event
from wearline_fieldbus.core.handshake import READY, TABLE, Row, State

SOURCE = Path(__file__).with_name("cell.pml")
BY_HAND = frozenset({"MeasureWanted", "ModeWanted", "ObjectWanted", "ObjectChecked"})
"""Events that the model leaves out: a measurement by hand tells the PLC nothing, the object's check delays Ready."""
MANUAL = frozenset({"verdict_is_manual", "entry_is_manual", "manual_is_due"})
"""Guards of rows that serve a measurement by hand alone."""
PARAMETERS: Mapping[str, int] = {
    "FAULTS": 2,
    "NUMBERED": 1,
    "STRICT": 0,
    "CUT": 0,
    "LATE": 0,
    "TORN": 0,
    "KILL": 0,
    "HANG": 0,
    "PLC_RESTART": 0,
    "MIX": 0,
    "CAMERA": 0,
    "OBJECT": 0,
    "JUDGE": 0,
    "DISK": 0,
    "PAUSE": 1,
    "HASTY": 0,
    "FORGETS": 0,
    "BLIND_TO_CODE": 0,
    "WIRES": 0,
}
"""How many faults, which kinds there are, what the PLC does, and which assumptions hold; `cell.pml` obeys them."""


@dataclass(frozen=True)
class Guard:
    """One place of the table where a guard stands."""

    number: int
    row: int | None
    """Index in TABLE; None = one of READY."""
    name: str

    def __str__(self) -> str:
        if self.row is None:
            return f"Ready: {self.name}"
        row = TABLE[self.row]
        return f"{'|'.join(row.states)} + {row.event.__name__} -> {row.effect}: {self.name}"


def guards() -> tuple[Guard, ...]:
    """Every guard of TABLE and READY, numbered from 1."""
    places = [(index, name) for index, row in enumerate(TABLE) for name in row.guards]
    places_ready: list[tuple[int | None, str]] = [(None, name) for name in READY]
    return tuple(Guard(n, row, name) for n, (row, name) in enumerate([*places, *places_ready], start=1))


def without(left_out: Iterable[Guard]) -> tuple[tuple[Row, ...], tuple[str, ...]]:
    """TABLE and READY of the real code with these guards left out."""
    gone = {(guard.row, guard.name) for guard in left_out}
    table = tuple(
        replace(row, guards=tuple(name for name in row.guards if (index, name) not in gone))
        for index, row in enumerate(TABLE)
    )
    return table, tuple(name for name in READY if (None, name) not in gone)


def is_modelled(row: Row) -> bool:
    """Whether the row is one of the PLC's handshake, and not of a measurement by hand."""
    return row.event.__name__ not in BY_HAND and not MANUAL.intersection(row.guards)


def model_text(parts: int = 2, inbox: int = 1) -> str:
    """The whole model for so many parts; all other parameters and left-out guards are read when pan starts."""
    wrapped = {(guard.row, guard.name): f"G({guard.number}, {guard.name})" for guard in guards()}
    states = "\n".join(f"#define {state.name} {n}" for n, state in enumerate(State))
    kinds = [kind.__name__.upper() for kind in get_args(Event)]
    events = "\n".join(f"#define {kind} {n}" for n, kind in enumerate(kinds, start=1))
    ready = " && ".join(wrapped[None, name] for name in READY)
    rows = "\n".join(_row_text(index, row, wrapped) for index, row in enumerate(TABLE) if is_modelled(row))
    text = SOURCE.read_text(encoding="utf-8")
    for mark, content in {
        "//PARAMETERS": _parameters({"PARTS": parts, "INBOX": inbox}),
        "//STATES": states,
        "//EVENTS": events,
        "//READY": f"#define is_ready ({ready})",
        "//TABLE": rows,
    }.items():
        if text.count(mark) != 1:
            raise RuntimeError(f"{SOURCE.name}: {mark} stands {text.count(mark)} times")
        text = text.replace(mark, content)
    return text


def _row_text(index: int, row: Row, wrapped: Mapping[tuple[int | None, str], str]) -> str:
    where = " || ".join(f"st == {state.name}" for state in row.states)
    conditions = ["hit == 0", f"e_kind == {row.event.__name__.upper()}", f"({where})"]
    conditions += [wrapped[index, name] for name in row.guards]
    target = f" st = {row.target.name};" if row.target is not None else ""
    then = f"hit = {index + 1};{target} {row.effect}()"
    return f"    if\n    :: {' && '.join(conditions)} ->\n       {then}\n    :: else\n    fi;"


def _parameters(sizes: Mapping[str, int]) -> str:
    names = list(PARAMETERS)
    reading = "\n".join(f'    parameter[{n}] = asked("{name}", {PARAMETERS[name]});' for n, name in enumerate(names))
    return "\n".join(
        [
            *(f"#define {name} {value}" for name, value in sizes.items()),
            *(f"#define {name} c_expr{{ parameter[{n}] }}" for n, name in enumerate(names)),
            "#define G(n, guard) (c_expr{ without[n] } || (guard))",
            "c_decl {",
            f"static int parameter[{len(names)}], without[{len(guards()) + 1}];",
            "static int asked(const char *name, int otherwise) {",
            "    const char *value = getenv(name);",
            "    return value ? atoi(value) : otherwise;",
            "}",
            "__attribute__((constructor)) static void read_environment(void) {",
            reading,
            '    const char *at = getenv("WITHOUT");',
            "    while (at && *at) {",
            "        without[atoi(at)] = 1;",
            "        at = strchr(at, ',');",
            "        at = at ? at + 1 : 0;",
            "    }",
            "}",
            "}",
        ]
    )


def meant(text: str) -> tuple[dict[str, str], dict[str, str]]:
    """Guards (macros) and effects (inlines) that `cell.pml` gives a meaning, each with its text."""
    macros = dict(re.findall(r"^#define (\w+) (.+)$", text, re.MULTILINE))
    inlines = dict(re.findall(r"^inline (\w+)\([^)]*\) (\{.*?\}$|\{.*?^\})", text, re.MULTILINE | re.DOTALL))
    return macros, inlines
