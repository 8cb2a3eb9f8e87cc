"""What the runner and `offline` expect of a service: messages in, messages out.

A handler gathers, calls core and yields; whoever runs the service publishes each message at
the moment it is yielded. All handlers of one service run on one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, TypeVar

from wearline.messages import Message
from wearline.topics import Query, Topic

A = TypeVar("A", bound=Message)


class Asker(Protocol):
    """Asks other services; the bus live, files offline."""

    def ask(self, query: Query, question: Message, argument: str = "", timeout_s: float = 1.0) -> Message:
        """The typed answer (``query.answer``).

        Raises:
            BusError: nobody answered in time, or the answerer refused (its sentence is the text).
        """
        ...


@dataclass(frozen=True)
class Health:
    """How a service is, for its ServiceState."""

    status: str = "ready"
    """starting, ready, degraded or stopping."""
    detail: str = ""
    values: Mapping[str, float | int | str | bool | None] = field(default_factory=dict)


def _nobody_to_wake() -> None:
    """Offline there is no loop that sleeps."""


class Service:
    """Base of the five services; override what applies."""

    name: ClassVar[str]
    wake: Callable[[], None] = staticmethod(_nobody_to_wake)
    """Set by the runner before `start`: call it from any thread and `tick` runs at once."""
    instance: str = ""
    """Set by the runner before `start`: tells this replica from the others of its service."""
    tick_s: float | None = None
    """Period of `tick`; None = no tick. [s]"""

    def start(self, asker: Asker) -> Iterable[Message]:
        """Once, when the bus is open; keep `asker` for later."""
        return ()

    def handlers(self) -> Mapping[Topic, Callable[[Any], Iterable[Message]]]:
        """Topic -> on_<message>."""
        return {}

    def answers(self) -> Mapping[Query, Callable[[Any], Message]]:
        """Query -> the method that answers it; an error it raises becomes the asker's BusError."""
        return {}

    def tick(self, now_s: float) -> Iterable[Message]:
        """Every `tick_s`, with the monotonic clock. [s]"""
        return ()

    def on_alive(self, service: str, is_alive: bool) -> Iterable[Message]:
        """A service of the cell came (also those that were there before) or went."""
        return ()

    def on_replicas(self, live: frozenset[str]) -> Iterable[Message]:
        """The replicas of this service that are alive, itself included, whenever they change."""
        return ()

    def health(self) -> Health:
        """Asked about once a second."""
        return Health()

    def close(self) -> None:
        """Release devices and files; called once, always."""
