"""argon2id, one at a time: it is slow and hungry on purpose, and must not take the cell's processors."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

WAITING_MAX = 16
"""More logins at once than that are turned away."""


class Hasher:
    """Hashes and checks passwords on a thread of its own.

    19 MiB, two passes, one lane: the OWASP minimum, about 30 ms. More would be stolen from the measuring chain
    on the same machine; the pause after wrong passwords does the rest.
    """

    def __init__(self) -> None:
        self._argon2 = PasswordHasher(time_cost=2, memory_cost=19456, parallelism=1)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="argon2")
        self._waiting = 0
        # Checked for names that do not exist, so that the answer takes as long.
        self._nobody = self._argon2.hash("no password of anybody")

    async def hash(self, password: str) -> str:
        """The hash with its salt and parameters."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, self._argon2.hash, password)

    async def is_right(self, password: str, known: str | None) -> bool:
        """Whether it is the password of that hash; None (no such user) takes as long and is wrong.

        Raises:
            TimeoutError: too many are waiting already.
        """
        if self._waiting >= WAITING_MAX:
            raise TimeoutError("too many logins at once")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, self._check, password, known)
        finally:
            self._waiting -= 1

    def _check(self, password: str, known: str | None) -> bool:
        try:
            return self._argon2.verify(known or self._nobody, password) and known is not None
        except (VerificationError, InvalidHashError):
            return False

    def close(self) -> None:
        """End the thread; a check in hand is left."""
        self._thread.shutdown(wait=False, cancel_futures=True)
