"""A pytest plugin (``-p tests.proof.without``): the handshake without the guards of WEARLINE_WITHOUT_GUARDS."""

from __future__ import annotations

import os

from tests.proof.promela import guards, without
from wearline_fieldbus.core import handshake

NUMBERS = {int(number) for number in os.environ.get("WEARLINE_WITHOUT_GUARDS", "").split(",") if number}
_TABLE, _READY = without([guard for guard in guards() if guard.number in NUMBERS])

# Before any test imports them.
vars(handshake)["TABLE"] = _TABLE
vars(handshake)["READY"] = {name: text for name, text in handshake.READY.items() if name in _READY}
_defaults = handshake.Handshake.__init__.__kwdefaults__
assert _defaults is not None
_defaults["table"], _defaults["ready"] = _TABLE, _READY
