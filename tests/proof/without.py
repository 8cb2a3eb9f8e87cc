"""A pytest plugin (``-p tests.proof.without``): the handshake without the guards of WEARLINE_WITHOUT_GUARDS."""

from __future__ import annotations

import os
from dataclasses import replace

from tests.proof.promela import guards
from wearline_fieldbus.core import handshake

LEFT_OUT = {int(number) for number in os.environ.get("WEARLINE_WITHOUT_GUARDS", "").split(",") if number}
_GONE = {(guard.row, guard.name) for guard in guards() if guard.number in LEFT_OUT}
_TABLE = tuple(
    replace(row, guards=tuple(name for name in row.guards if (index, name) not in _GONE))
    for index, row in enumerate(handshake.TABLE)
)
_READY = {name: text for name, text in handshake.READY.items() if (None, name) not in _GONE}

# Before any test imports them.
vars(handshake)["TABLE"] = _TABLE
_defaults = handshake.Handshake.__init__.__kwdefaults__
assert _defaults is not None
_defaults["table"], _defaults["ready"] = _TABLE, tuple(_READY)
if LEFT_OUT:
    vars(handshake)["READY"] = _READY
