"""The JSON schemas of all messages, one file each.

After a wanted change of a message: ``python tests/contract/message_schemas.py`` and commit what it wrote.
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path

from wearline import messages

FOLDER = Path(__file__).parent / "schemas"


def message_kinds() -> list[type[messages.Message]]:
    """Every message that may be sent or is part of one, in the order of their names."""
    kinds = [
        kind
        for _, kind in inspect.getmembers(messages, inspect.isclass)
        if issubclass(kind, messages.Message) and kind not in (messages.Message, messages.FromCycle)
    ]
    return sorted(kinds, key=lambda kind: kind.__name__)


def schema_of(kind: type[messages.Message]) -> str:
    """Its schema as it is committed."""
    return json.dumps(kind.model_json_schema(), indent=2, sort_keys=True, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for old in FOLDER.glob("*.json"):
        old.unlink()
    for wanted in message_kinds():
        (FOLDER / f"{wanted.__name__}.json").write_text(schema_of(wanted), encoding="utf-8")
