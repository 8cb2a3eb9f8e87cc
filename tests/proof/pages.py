"""What is generated of docs/explanation/handshake-proof.md (the machine) and docs/reference/handshake-proof.md.

After a wanted change of the table: ``python -m tests.proof.pages`` and commit what it wrote.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from tests.proof.mutations import RESULTS
from tests.proof.promela import is_modelled
from wearline_fieldbus.core.handshake import READY, TABLE, State

DOCS = Path(__file__).resolve().parents[2] / "docs"
HANDSHAKE = DOCS / "explanation" / "handshake-proof.md"
PROOF = DOCS / "reference" / "handshake-proof.md"
START, END = "<!-- machine -->\n", "<!-- end of machine -->"


def machine() -> str:
    """The states, a diagram of what leads from one to the other, and every row."""
    rows = [row for row in TABLE if is_modelled(row)]
    lines = ["| State | |", "|---|---|"]
    lines += [f"| **{state}** | {meaning} |" for state, meaning in _meanings()]
    lines += ["", "```mermaid", "stateDiagram-v2", "    [*] --> down"]
    arrows = {
        (state, row.target, row.event.__name__)
        for row in rows
        for state in row.states
        if row.target not in (None, state)
    }
    pairs = sorted({(source, target) for source, target, _ in arrows}, key=str)
    for source, target in pairs:
        events = ", ".join(sorted(event for a, b, event in arrows if (a, b) == (source, target)))
        lines.append(f"    {source} --> {target}: {events}")
    lines += ["```", "", "| In | Event | if | then | next |", "|---|---|---|---|---|"]
    for row in rows:
        states = "any" if len(row.states) == len(State) else ", ".join(row.states)
        guards = " and ".join(f"`{name}`" for name in row.guards) or "-"
        lines.append(f"| {states} | {row.event.__name__} | {guards} | `{row.effect}` | {row.target or ''} |")
    lines += ["", "Ready needs all of: " + ", ".join(f"`{name}`" for name in READY) + ".", ""]
    return "\n".join(lines)


def _meanings() -> Iterable[tuple[str, str]]:
    source = (DOCS.parent / "services/fieldbus/wearline_fieldbus/core/handshake.py").read_text(encoding="utf-8")
    body = source[source.index("class State(") :].splitlines()
    for line, after in pairwise(body):
        name, _, value = line.strip().partition(" = ")
        if name in State.__members__ and value == f'"{State[name]}"':
            yield State[name], after.strip().strip('"')


def handshake_page(text: str) -> str:
    """The page with its machine made anew."""
    head, _, rest = text.partition(START)
    return f"{head}{START}{machine()}{END}{rest.partition(END)[2]}"


def proof_page() -> str:
    """Every left-out guard and who objects, from the last whole run of ``make handshake-mutations``."""
    verdicts = json.loads(RESULTS.read_text(encoding="utf-8"))
    killed = [verdict for verdict in verdicts if verdict["killed_by"]]
    by_model = sum(verdict["killed_by"].startswith("model") for verdict in killed)
    pairs = sum(" AND " in verdict["guard"] for verdict in killed)
    lines = [
        "# How strong the proof of the handshake is",
        "",
        "Every guard of the handshake's table and of Ready was left out in turn. The model (exhaustive,",
        "`tests/proof/cell.pml`), the random walk of the real code and its unit tests then had to object. A guard for",
        "which another one stands in was left out together with that one. Made by `make handshake-mutations` and",
        "`python -m tests.proof.pages`; what is proven, and under which assumptions, says",
        "[what is proven](../explanation/handshake-proof.md).",
        "",
        f"**{len(killed)} of {len(verdicts)}** were objected to: {by_model} by the model, {len(killed) - by_model}",
        f"by tests of the real code; {pairs} of them only in a pair. Where nobody objected, the last column says",
        "what was tried; such a guard may be redundant, or the tests too weak: only the whole run tells.",
        "",
        "| Left out | Objects | What it says |",
        "|---|---|---|",
    ]
    for verdict in verdicts:
        cells = [verdict["guard"], verdict["killed_by"] or "**nobody**", verdict["objection"] or ""]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    HANDSHAKE.write_text(handshake_page(HANDSHAKE.read_text(encoding="utf-8")), encoding="utf-8")
    if RESULTS.is_file():
        PROOF.write_text(proof_page(), encoding="utf-8")
