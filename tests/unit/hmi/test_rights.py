"""Table 5.2 of the thesis, cell by cell."""

from __future__ import annotations

import pytest

from wearline_hmi.core import rights as r
from wearline_hmi.core.rights import Access, Deed, Item, Role

# As printed in the thesis: item, operators, maintenance, administrators.
THESIS = """
Camera control | View only           | Full access         | Full access
User control   | No access to others | No access to others | Full access
Log            | View only           | Full access         | Full access
Measure        | Full access         | Full access         | Full access
Calibration    | No access           | Full access         | Full access
Camera view    | View only           | Full access         | Full access
Product view   | View only           | View only           | Full access
Settings       | No access           | Part of parameters  | Full access
Help           | Full access         | Full access         | Full access
"""
WORDS = {
    "No access": Access.NONE,
    "No access to others": Access.OWN,
    "View only": Access.VIEW,
    "Part of parameters": Access.PART,
    "Full access": Access.FULL,
}
CELLS = [
    (Item(row[0]), role, WORDS[cell])
    for row in ([part.strip() for part in line.split("|")] for line in THESIS.strip().splitlines())
    for role, cell in zip((Role.OPERATOR, Role.MAINTENANCE, Role.ADMINISTRATOR), row[1:], strict=True)
]


@pytest.mark.parametrize(("item", "role", "access"), CELLS)
def test_each_cell_is_that_of_the_thesis(item: Item, role: Role, access: Access) -> None:
    assert r.TABLE[item][role] is access
    for needs in Access:
        assert r.may(role, Deed("x", item, needs)) == (access >= needs)


def test_the_table_is_whole() -> None:
    assert len(CELLS) == 27
    assert set(r.TABLE) == set(Item)
    assert all(set(row) == set(Role) for row in r.TABLE.values())


def test_a_viewer_changes_nothing_and_sees_no_more_than_an_operator() -> None:
    looks = {d for d in r.DEEDS if d.needs <= Access.VIEW and d.needs > Access.OWN}
    for deed in r.DEEDS:
        if r.may(Role.VIEWER, deed):
            assert deed in looks
            assert r.may(Role.OPERATOR, deed)


@pytest.mark.parametrize(
    ("deed", "least"),
    [
        (r.MEASURE_BY_HAND, Role.OPERATOR), (r.SET_MODE, Role.OPERATOR), (r.SELECT_OBJECT, Role.OPERATOR),
        (r.OWN_PASSWORD, Role.OPERATOR), (r.SET_CAMERA, Role.MAINTENANCE), (r.SAVE_PICTURE, Role.MAINTENANCE),
        (r.MAKE_TEMPLATE, Role.MAINTENANCE), (r.CALIBRATE, Role.MAINTENANCE), (r.LOG_DIE_SERVICE, Role.MAINTENANCE),
        (r.ACKNOWLEDGE_ALARM, Role.MAINTENANCE),
        (r.EXPORT_LOG, Role.MAINTENANCE), (r.WATCH_SIGNALS, Role.MAINTENANCE),
        (r.EXPORT_PRODUCTION, Role.ADMINISTRATOR), (r.MANAGE_USERS, Role.ADMINISTRATOR),
    ],
)  # fmt: skip
def test_each_deed_begins_at_the_group_that_the_thesis_names(deed: Deed, least: Role) -> None:
    order = list(Role)
    assert [role for role in Role if r.may(role, deed)] == order[order.index(least) :]
