"""One topic has one publisher, and each service speaks under its own name only."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.contract.examples import OUTCOME, REQUEST, VERDICT
from wearline import messages as m
from wearline.bus import Bus
from wearline.errors import BusError, MessageError
from wearline.topics import EVENTS, QUERIES, SERVICES, STATES, TOPICS, Delivery, Query, alive_key


def test_every_key_has_one_publisher() -> None:
    keys = Counter(topic.key("c1") for topic in TOPICS)
    assert set(keys.values()) == {1}
    for topic in TOPICS:
        assert topic.publisher in SERVICES
        assert topic.key("c1").split("/")[:3] == ["wearline", "c1", topic.publisher]


def test_a_message_says_its_topic() -> None:
    """The bus finds the topic by the message: one service never publishes one message on two topics."""
    pairs = Counter((topic.publisher, topic.message) for topic in TOPICS)
    assert set(pairs.values()) == {1}


def test_every_service_has_state_and_event() -> None:
    assert set(STATES) == set(EVENTS) == set(SERVICES)


def test_no_query_lives_on_a_topics_key() -> None:
    published = {topic.key("c1") for topic in TOPICS} | {alive_key("c1", service, "1-ab") for service in SERVICES}
    assert not published & {query.key("c1") for query in QUERIES}
    assert len({query.key("c1") for query in QUERIES}) == len(QUERIES)


def test_what_may_not_be_lost_is_kept() -> None:
    kept = {topic.message for topic in TOPICS if topic.delivery is Delivery.KEPT}
    assert {m.MeasureRequest, m.Verdict, m.Outcome, m.Event} == kept


@pytest.mark.parametrize(
    ("service", "message"),
    [
        ("hmi", VERDICT),
        ("capture", REQUEST),
        ("judge", OUTCOME),
        ("demo", REQUEST),
        ("hmi", m.ServiceState(service="judge", status="ready", pid=1, uptime_s=0.0, version="")),
        ("hmi", m.Event(service="fieldbus", level="info", text="", utc="")),
    ],
)
def test_nobody_publishes_for_another(service: str, message: m.Message) -> None:
    with pytest.raises(MessageError, match=f"{service} may not"):
        Bus("c1", service, "tcp/127.0.0.1:1").publish(message)


@pytest.mark.parametrize("query", QUERIES, ids=lambda query: query.name)
def test_nobody_answers_for_another(query: Query) -> None:
    for service in SERVICES:
        if service != query.answerer:
            with pytest.raises(MessageError, match=f"{service} may not answer"):
                Bus("c1", service, "tcp/127.0.0.1:1").answer(query, lambda question: m.Done(ok=True))


def test_a_closed_bus_says_so() -> None:
    bus = Bus("c1", "fieldbus", "tcp/127.0.0.1:1")
    with pytest.raises(BusError, match="not open"):
        bus.publish(REQUEST)
    bus.close()
    bus.close()
