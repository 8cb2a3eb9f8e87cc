"""Which replica measures a frame: all rank themselves alike, so that nobody has to be asked."""

from __future__ import annotations

import hashlib
from collections.abc import Collection


def ranked(cycle_id: str, live: Collection[str]) -> list[str]:
    """The replicas in the order in which they answer for this cycle.

    Rendezvous hashing (Thaler and Ravishankar 1998, doi 10.1109/90.663936): when one goes, only its own
    cycles move to others.
    """
    return sorted(live, key=lambda instance: hashlib.sha256(f"{cycle_id}/{instance}".encode()).digest())
