"""Who may say and hear what on the bus of a cell: one table, and the router's access rules made from it.

The rules deny by default: where all is allowed that is not denied, a put on a wildcard (``wearline/c1/*/verdict``)
slips past every denial. A participant is known by the common name ``<service>.<cell>`` of its certificate; replicas
share one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from wearline.topics import (
    ACKNOWLEDGE,
    ARTIFACT,
    DIE_EVENT,
    DO_MEASURE,
    EVENTS,
    EXPOSED,
    FRAME,
    JOURNAL,
    LINE_POINTS,
    MEASURE,
    MODE,
    OUTCOME,
    PREVIEW,
    RECIPE,
    RECIPE_LIST,
    RECORDS,
    SELECT_OBJECT,
    SERVICES,
    SET_CAMERA,
    STATES,
    TEACH,
    VERDICT,
    VIEW,
    WEAR_MAP,
    Query,
    Topic,
    alive_key,
)

HEARS: dict[str, tuple[Topic, ...]] = {
    "capture": (MEASURE,),
    # Its own, too: replicas listen whether the first of them has answered.
    "reconstruct": (MEASURE, FRAME, LINE_POINTS),
    "judge": (MEASURE, FRAME, LINE_POINTS, OUTCOME),
    "fieldbus": (EXPOSED, VERDICT, *STATES.values()),
    "hmi": (MEASURE, PREVIEW, VERDICT, VIEW, OUTCOME, *STATES.values(), *EVENTS.values()),
}
"""Topics that a service may subscribe to."""

ASKS: dict[str, tuple[Query, ...]] = {
    "capture": (),
    "reconstruct": (RECIPE, ARTIFACT),
    "judge": (JOURNAL,),
    "fieldbus": (RECIPE, RECORDS),
    "hmi": (
        RECIPE, RECIPE_LIST, RECORDS, WEAR_MAP, TEACH, DIE_EVENT, ACKNOWLEDGE, DO_MEASURE, SELECT_OBJECT, MODE,
        SET_CAMERA,
    ),
}  # fmt: skip
"""Questions and commands that a service may put to another."""


def common_name(participant: str, cell: str) -> str:
    """What the certificate of a service, or of the ``router``, is issued to."""
    return f"{participant}.{cell}"


def access_control(cell: str) -> dict[str, Any]:
    """The section ``access_control`` of a cell's router."""
    everything = f"wearline/{cell}/**"
    rules = [
        # What somebody wants to hear or is ready to answer is no secret inside a cell.
        _rule("wanted", "egress", [everything, f"{everything}/@adv/**"], "declare_subscriber", "declare_queryable"),
    ]
    policies = []
    for service in SERVICES:
        own = [f"wearline/{cell}/{service}/**", f"wearline/{cell}/{service}/**/@adv/**"]
        heard = _keys_heard(cell, service)
        asked = [query.key(cell) for query in ASKS[service]]
        alive = [alive_key(cell, "*")]
        of_service = [
            _rule(
                f"{service}-says", "ingress", own,
                "put", "delete", "reply", "declare_queryable", "liveliness_token",
            ),
            _rule(f"{service}-is-asked", "egress", own, "query"),
            # To subscribe to what is kept is to ask for it, too.
            _rule(f"{service}-listens", "ingress", heard, "declare_subscriber", "query"),
            _rule(f"{service}-hears", "egress", heard, "put", "delete", "reply"),
            _rule(
                f"{service}-watches", "ingress", [*alive, *_adv(heard)],
                "declare_liveliness_subscriber", "liveliness_query",
            ),
            _rule(f"{service}-sees", "egress", [*alive, *_adv(heard)], "liveliness_token"),
            # A subscriber shows itself to the publisher whose cache it uses.
            _rule(f"{service}-shows", "ingress", _adv(heard), "liveliness_token"),
            _rule(f"{service}-asks", "ingress", asked, "query"),
            _rule(f"{service}-is-told", "egress", asked, "reply"),
        ]  # fmt: skip
        of_service = [rule for rule in of_service if rule["key_exprs"]]
        rules += of_service
        policies.append(
            {
                "id": service,
                "rules": ["wanted", *(rule["id"] for rule in of_service)],
                "subjects": [common_name(service, cell)],
            }
        )
    subjects = [
        {"id": common_name(service, cell), "cert_common_names": [common_name(service, cell)]} for service in SERVICES
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _keys_heard(cell: str, service: str) -> list[str]:
    """Keys of the topics that a service hears, and of the caches beside them."""
    plain = [topic.key(cell) for topic in HEARS[service]]
    # `**` does not reach into a chunk that starts with @.
    return [key for name in plain for key in (name, f"{name}/@adv/**")]


def _adv(keys: Iterable[str]) -> list[str]:
    return [key for key in keys if key.endswith("/@adv/**")]


def _rule(name: str, flow: str, keys: list[str], *messages: str) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "key_exprs": keys, "messages": list(messages)}
