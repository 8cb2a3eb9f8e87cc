"""The one table of what is said where.

A key is ``wearline/<cell>/<publisher>/<name>``, so that an access rule is "each service puts
only under its own name".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from wearline import messages as m

SERVICES = ("capture", "reconstruct", "judge", "fieldbus", "hmi")


class Delivery(StrEnum):
    """What may happen to a message on its way."""

    EVERY = "every"
    """Nothing may be lost: blocking congestion control."""
    KEPT = "kept"
    """As EVERY, and recovered after a link loss and for late joiners (cache and heartbeat)."""
    LATEST = "latest"
    """Only the newest counts: dropped under congestion."""


@dataclass(frozen=True)
class Topic:
    """One row of the table; ``rate_hz`` is what a healthy cell shows (0: on demand)."""

    name: str
    publisher: str
    message: type[m.Message]
    delivery: Delivery
    rate_hz: float = 0.0
    keep_s: float | None = None
    """KEPT only: what is older is not told to late joiners; None = the newest, whatever their age. [s]"""

    def key(self, cell: str) -> str:
        return f"wearline/{cell}/{self.publisher}/{self.name}"


# A camera that joins late must not take a picture for a stroke that has gone.
MEASURE = Topic("measure", "fieldbus", m.MeasureRequest, Delivery.KEPT, keep_s=1.0)
FRAME = Topic("frame", "capture", m.Frame, Delivery.EVERY)
EXPOSED = Topic("exposed", "capture", m.Exposed, Delivery.EVERY)
PREVIEW = Topic("preview", "capture", m.Preview, Delivery.LATEST, 3.0)
LINE_POINTS = Topic("line_points", "reconstruct", m.LinePoints, Delivery.EVERY)
VERDICT = Topic("verdict", "judge", m.Verdict, Delivery.KEPT)
VIEW = Topic("view", "judge", m.View, Delivery.LATEST)
OUTCOME = Topic("outcome", "fieldbus", m.Outcome, Delivery.KEPT)
STATES = {s: Topic("state", s, m.ServiceState, Delivery.LATEST, 1.0) for s in SERVICES}
EVENTS = {s: Topic("event", s, m.Event, Delivery.KEPT) for s in SERVICES}

TOPICS: tuple[Topic, ...] = (
    MEASURE, FRAME, EXPOSED, PREVIEW, LINE_POINTS, VERDICT, VIEW, OUTCOME, *STATES.values(), *EVENTS.values(),
)  # fmt: skip


@dataclass(frozen=True)
class Query:
    """A question with a typed answer; ``name`` may end in ``/**`` where the key carries an argument."""

    name: str
    answerer: str
    ask: type[m.Message]
    answer: type[m.Message]

    def key(self, cell: str, argument: str = "") -> str:
        name = self.name.removesuffix("**") + argument if argument else self.name
        return f"wearline/{cell}/{self.answerer}/{name}"


RECIPE = Query("recipe/**", "judge", m.AskRecipe, m.ObjectRecipe)
RECIPE_LIST = Query("recipe_list", "judge", m.Ping, m.ObjectList)
ARTIFACT = Query("artifact/**", "judge", m.AskArtifact, m.Artifact)
RECORDS = Query("records", "judge", m.AskRecords, m.Records)
TEACH = Query("do/teach", "judge", m.Teach, m.Done)
DIE_EVENT = Query("do/die_event", "judge", m.DieEvent, m.Done)
ACKNOWLEDGE = Query("do/acknowledge", "judge", m.Acknowledge, m.Done)
WEAR_MAP = Query("wear_map", "judge", m.AskWearMap, m.WearMap)
DO_MEASURE = Query("do/measure", "fieldbus", m.DoMeasure, m.Done)
SELECT_OBJECT = Query("do/select_object", "fieldbus", m.SelectObject, m.Done)
MODE = Query("do/mode", "fieldbus", m.SetMode, m.Done)
JOURNAL = Query("do/journal", "fieldbus", m.AskJournal, m.Journal)
SET_CAMERA = Query("do/set", "capture", m.SetCamera, m.Done)

QUERIES: tuple[Query, ...] = (
    RECIPE, RECIPE_LIST, ARTIFACT, RECORDS, TEACH, DIE_EVENT, ACKNOWLEDGE, WEAR_MAP, DO_MEASURE, SELECT_OBJECT, MODE,
    JOURNAL, SET_CAMERA,
)  # fmt: skip


def alive_key(cell: str, service: str, instance: str = "*") -> str:
    """The liveliness token that stands beside a service's state, one for each replica; ``*`` = all of them."""
    return f"wearline/{cell}/{service}/alive/{instance}"
