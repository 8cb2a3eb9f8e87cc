"""Table 5.2 of the thesis: who may do what. One role more, the viewer, may look and change nothing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum


class Role(StrEnum):
    """User groups."""

    VIEWER = "viewer"
    """Nobody logged in, where cell.yaml allows to look without it."""
    OPERATOR = "operator"
    MAINTENANCE = "maintenance"
    ADMINISTRATOR = "administrator"


ACCOUNT_ROLES = (Role.OPERATOR, Role.MAINTENANCE, Role.ADMINISTRATOR)


class Item(StrEnum):
    """Rows of the table."""

    CAMERA_CONTROL = "Camera control"
    USER_CONTROL = "User control"
    LOG = "Log"
    MEASURE = "Measure"
    CALIBRATION = "Calibration"
    CAMERA_VIEW = "Camera view"
    PRODUCT_VIEW = "Product view"
    SETTINGS = "Settings"
    HELP = "Help"


class Access(IntEnum):
    """Cells of the table, each with what the one before allows."""

    NONE = 0
    OWN = 1
    """User control only: the own account, no access to others."""
    VIEW = 2
    PART = 3
    """Settings only: the access to inputs and outputs."""
    FULL = 4


_N, _O, _V, _P, _F = Access.NONE, Access.OWN, Access.VIEW, Access.PART, Access.FULL

TABLE: dict[Item, dict[Role, Access]] = {
    item: dict(zip(Role, cells, strict=True))
    for item, cells in {
        # viewer, operator, maintenance, administrator
        Item.CAMERA_CONTROL: (_N, _V, _F, _F),
        Item.USER_CONTROL: (_N, _O, _O, _F),
        Item.LOG: (_V, _V, _F, _F),
        Item.MEASURE: (_V, _F, _F, _F),
        Item.CALIBRATION: (_N, _N, _F, _F),
        Item.CAMERA_VIEW: (_V, _V, _F, _F),
        Item.PRODUCT_VIEW: (_V, _V, _V, _F),
        Item.SETTINGS: (_N, _N, _P, _F),
        Item.HELP: (_F, _F, _F, _F),
    }.items()
}


@dataclass(frozen=True)
class Deed:
    """Something that can be done or looked at, and what it needs."""

    name: str
    """As the audit log writes it."""
    item: Item
    needs: Access


LOOK_AT_MEASURING = Deed("look at measuring", Item.MEASURE, Access.VIEW)
LOOK_AT_CAMERA = Deed("look at the camera", Item.CAMERA_VIEW, Access.VIEW)
LOOK_AT_PRODUCTION = Deed("look at production", Item.PRODUCT_VIEW, Access.VIEW)
LOOK_AT_LOG = Deed("look at the log", Item.LOG, Access.VIEW)
LOOK_AT_SETTINGS = Deed("look at the settings", Item.SETTINGS, Access.PART)
LOOK_AT_CALIBRATION = Deed("look at calibrating", Item.CALIBRATION, Access.VIEW)
LOOK_AT_USERS = Deed("look at the users", Item.USER_CONTROL, Access.FULL)
READ_HELP = Deed("read the help", Item.HELP, Access.VIEW)

SET_CAMERA = Deed("set the camera", Item.CAMERA_CONTROL, Access.FULL)
SAVE_PICTURE = Deed("save a camera picture", Item.CAMERA_VIEW, Access.FULL)
MEASURE_BY_HAND = Deed("measure by hand", Item.MEASURE, Access.FULL)
SET_MODE = Deed("set the mode", Item.MEASURE, Access.FULL)
SELECT_OBJECT = Deed("select an object", Item.MEASURE, Access.FULL)
MAKE_TEMPLATE = Deed("make a template", Item.CALIBRATION, Access.FULL)
"""Sampling a standard object is a maintenance task."""
CALIBRATE = Deed("calibrate", Item.CALIBRATION, Access.FULL)
LOG_DIE_SERVICE = Deed("log a die service", Item.CALIBRATION, Access.FULL)
"""It sets the point from which wear counts, as a template sets what it is compared with."""
ACKNOWLEDGE_ALARM = Deed("acknowledge an alarm", Item.LOG, Access.FULL)
"""Who answers for the die; an operator sees it and calls."""
EXPORT_PRODUCTION = Deed("export production records", Item.PRODUCT_VIEW, Access.FULL)
EXPORT_LOG = Deed("export the log", Item.LOG, Access.FULL)
WATCH_SIGNALS = Deed("watch inputs and outputs", Item.SETTINGS, Access.PART)
MANAGE_USERS = Deed("manage users", Item.USER_CONTROL, Access.FULL)
OWN_PASSWORD = Deed("change the own password", Item.USER_CONTROL, Access.OWN)

DEEDS: tuple[Deed, ...] = (
    LOOK_AT_MEASURING, LOOK_AT_CAMERA, LOOK_AT_PRODUCTION, LOOK_AT_LOG, LOOK_AT_SETTINGS, LOOK_AT_CALIBRATION,
    LOOK_AT_USERS, READ_HELP, SET_CAMERA, SAVE_PICTURE, MEASURE_BY_HAND, SET_MODE, SELECT_OBJECT, MAKE_TEMPLATE,
    CALIBRATE, LOG_DIE_SERVICE, ACKNOWLEDGE_ALARM, EXPORT_PRODUCTION,
    EXPORT_LOG, WATCH_SIGNALS, MANAGE_USERS, OWN_PASSWORD,
)  # fmt: skip


def may(role: Role, deed: Deed) -> bool:
    """Whether the table allows it."""
    return TABLE[deed.item][role] >= deed.needs
