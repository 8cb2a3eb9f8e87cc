"""The measurement screen: the part in three dimensions, mode, object, template, result and counts."""

from __future__ import annotations

from nicegui import ui
from nicegui.element import Element

from wearline.messages import DoMeasure, ObjectList, Ping, SelectObject, SetMode, Teach
from wearline.topics import DO_MEASURE, MODE, RECIPE_LIST, SELECT_OBJECT, TEACH
from wearline_hmi.core import rights
from wearline_hmi.core.rights import Deed
from wearline_hmi.core.state import CellState, current_object
from wearline_hmi.core.words import DASH, header_words, mm_text, pass_rate_text
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.live import Surface
from wearline_hmi.pages.parts import Button, Choice, Column, Rows, Select, confirmed, panel, set_text, text_element
from wearline_hmi.pages.views import last_part, map_choice, renew_surface, surface_words

TEMPLATE_SOURCES = (("next", "from the next parts"), ("3", "from the last 3 parts"), ("5", "from the last 5 parts"))
PAINTINGS = (("surface", "surface"), ("mesh", "mesh"), ("flat", "colour map"))


def build_measurement(page: Frame) -> None:
    """The screen ``/measurement``."""
    with Element("div").classes("grid-measurement"):
        _maps(page)
        with Element("div").classes("area-side stack"):
            _control(page)
            last_part(page, "fit")
            _counts(page)
        with Element("div").classes("area-below"):
            _regions(page)
            _zones(page)


def _maps(page: Frame) -> None:
    say = page.look.say
    with panel(say("Part in three dimensions"), "area-maps") as box:
        with box.default_slot.children[0]:
            note = ui.label().classes("age")
        surface = Surface(surface_words(say))
        with Element("div").classes("toolbar"):
            map_choice(page, surface)
            Choice(say("Drawing"), [(key, say(text)) for key, text in PAINTINGS], "surface", surface.paint, "painting")
            ruler = Button(say("Ruler"), classes="ruler")
            ruler.press(False)

            def measure_lengths() -> None:
                is_on = not surface.props.get("ruler", False)
                surface.props["ruler"] = is_on
                surface.update()
                ruler.press(is_on)

            ruler.on("click", measure_lengths)
    renew_surface(page, surface, note)


def why_not(page: Frame, deed: Deed) -> str:
    """What an account lacks for a deed; empty when nothing."""
    return "" if page.may(deed) else page.look.say("Log in with the rights for this.")


def _control(page: Frame) -> None:
    say, service = page.look.say, page.service

    async def set_mode(mode: str) -> None:
        shown = header_words(service.snapshot, service.clock()).mode.word
        modes.show(shown)
        if mode == shown:
            return
        question = say("In manual mode the PLC gets no results. Change the mode?")
        if mode == "manual" and not await confirmed(say, question, say("Manual mode")):
            return
        await page.command(rights.SET_MODE, MODE, SetMode(mode=mode), mode)

    async def measure() -> None:
        await page.command(rights.MEASURE_BY_HAND, DO_MEASURE, DoMeasure(), "")

    async def select_object(wanted: str) -> None:
        index = int(wanted)
        if index != current_object(service.snapshot):
            await page.command(rights.SELECT_OBJECT, SELECT_OBJECT, SelectObject(object_index=index), str(index))

    async def teach() -> None:
        index = current_object(service.snapshot)
        if index is None:
            ui.notify(say("No object is selected."), type="negative")
            return
        cycles = tuple(
            row.cycle_id for row in service.snapshot.strokes if row.object_index == index and row.mean_mm is not None
        )
        chosen = () if source.value == "next" else cycles[: int(source.value)]
        question = say("The new template is what all parts of object {n} are compared with. Make it?", n=index)
        if await confirmed(say, question, say("Make template")):
            await page.command(
                rights.MAKE_TEMPLATE, TEACH, Teach(object_index=index, cycle_ids=chosen),
                f"object {index}, {len(chosen) or 'next'} parts", timeout_s=20.0,
            )  # fmt: skip

    with panel(say("Operation"), "control"), Element("div").classes("form"):
        guarded_mode = page.guarded(rights.SET_MODE, lambda event: set_mode(event))
        modes = Choice(say("Mode"), [("auto", say("auto")), ("manual", say("manual"))], "", guarded_mode, "mode")
        by_hand = Button(say("Measure"), page.guarded(rights.MEASURE_BY_HAND, measure), "main wide")
        objects = Select(say("Object"), [], "", page.guarded(rights.SELECT_OBJECT, select_object))
        source = Select(say("Template"), [(key, say(text)) for key, text in TEMPLATE_SOURCES], "next")
        template = Button(say("Make template"), page.guarded(rights.MAKE_TEMPLATE, teach), "wide")
        note = text_element("p", "", "hint")
    names: list[tuple[str, str]] = []

    async def load() -> None:
        answer = await page.ask(RECIPE_LIST, Ping())
        if isinstance(answer, ObjectList):
            names[:] = [
                (str(entry.object_index), f"{entry.object_index} {entry.object_name}") for entry in answer.objects
            ]

    def renew(state: CellState, now_s: float) -> None:
        mode = header_words(state, now_s).mode.word
        modes.show(mode)
        index = current_object(state)
        known = "" if index is None else str(index)
        unnamed = [] if known in {key for key, _ in names} else [(known, known or DASH)]
        objects.show([*names, *unnamed], known)
        for button in modes.buttons.values():
            button.enable(page.may(rights.SET_MODE), why_not(page, rights.SET_MODE))
        is_manual = mode == "manual"
        reason = why_not(page, rights.MEASURE_BY_HAND) or ("" if is_manual else say("Only in manual mode."))
        by_hand.enable(not reason, reason)
        template.enable(page.may(rights.MAKE_TEMPLATE), why_not(page, rights.MAKE_TEMPLATE))
        is_fixed = not page.may(rights.SELECT_OBJECT) or not is_manual
        if objects.box.props.get("disabled", False) is not is_fixed:
            objects.box.props["disabled"] = is_fixed
            objects.box.update()
        set_text(
            note,
            why_not(page, rights.MEASURE_BY_HAND) or ("" if is_manual else say("In automatic mode the PLC measures.")),
        )

    page.renewed_by(renew)
    ui.timer(0.1, load, once=True)


def _counts(page: Frame) -> None:
    say = page.look.say
    with panel(say("Counts"), "counts"), Element("dl").classes("figures padded"):
        figures = {}
        for key, name in (
            ("passed", "Passed"), ("failed", "Failed"), ("not_measured", "Not measured"), ("total", "All"),
            ("rate", "Pass rate"),
        ):  # fmt: skip
            text_element("dt", say(name))
            figures[key] = Element("dd")

    def renew(state: CellState, now_s: float) -> None:
        known = state.records_at_s is not None
        for key in ("passed", "failed", "not_measured", "total"):
            set_text(figures[key], str(getattr(state, key)) if known else DASH)
        set_text(figures["rate"], pass_rate_text(state, say))

    page.renewed_by(renew)


def _regions(page: Frame) -> None:
    say = page.look.say
    with panel(say("Deviating regions of the last part")):
        rows = Rows(
            [
                Column("area", say("Area [mm²]"), True), Column("mean", say("Mean [mm]"), True),
                Column("max", say("Max [mm]"), True), Column("sigma", say("Uncertainty [mm]"), True),
                Column("volume", say("Volume [mm³]"), True), Column("place", say("At column, row [px]"), True),
            ],
            say("Deviating regions of the last part"), say("No region deviates"),
        )  # fmt: skip

    def renew(state: CellState, now_s: float) -> None:
        regions = () if state.verdict is None else state.verdict.regions
        rows.show(
            [
                {
                    "id": str(number),
                    "area": DASH if region.area_mm2 is None else say.number(f"{region.area_mm2:.1f}"),
                    "mean": mm_text(region.mean_mm, say=say),
                    "max": mm_text(region.max_mm, sign=True, say=say),
                    "sigma": mm_text(region.sigma_mm, say=say),
                    "volume": DASH if region.volume_mm3 is None else say.number(f"{region.volume_mm3:.2f}"),
                    "place": f"{region.col_px:.0f}, {region.row_px:.0f}",
                }
                for number, region in enumerate(regions, 1)
            ]
        )

    page.renewed_by(renew)


def _zones(page: Frame) -> None:
    say = page.look.say
    with panel(say("Zones of the last part")):
        rows = Rows(
            [
                Column("name", say("Zone")), Column("state", say("State")), Column("mean", say("Mean [mm]"), True),
                Column("max", say("Max [mm]"), True), Column("wear", say("Wear [mm]"), True),
                Column("coverage", say("Coverage"), True),
            ],
            say("Zones of the last part"), say("The recipe names no zones"),
        )  # fmt: skip

    def renew(state: CellState, now_s: float) -> None:
        zones = () if state.verdict is None else state.verdict.zones
        rows.show(
            [
                {
                    "id": zone.name,
                    "name": zone.name,
                    "state": {
                        "colour": "green" if zone.is_within else "red",
                        "icon": "check" if zone.is_within else "cross",
                        "word": say("within") if zone.is_within else say("beyond"),
                        "title": "",
                    },
                    "mean": mm_text(zone.mean_error_mm, say=say),
                    "max": mm_text(zone.max_error_mm, sign=True, say=say),
                    "wear": mm_text(zone.wear_mm, say=say),
                    "coverage": say.number(f"{100 * zone.coverage:.1f} %"),
                }
                for zone in zones
            ]
        )

    page.renewed_by(renew)
