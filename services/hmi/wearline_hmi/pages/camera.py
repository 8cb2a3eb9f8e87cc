"""The camera screen: live picture with ROI and two movable lines, histogram, focus, exposure and gain."""

from __future__ import annotations

from nicegui import ui
from nicegui.element import Element

from wearline.errors import RecipeError
from wearline.messages import AskRecipe, ObjectRecipe, SetCamera
from wearline.recipe import parse_recipe
from wearline.topics import RECIPE, SET_CAMERA
from wearline_hmi.core import rights
from wearline_hmi.core.language import Language
from wearline_hmi.core.state import CellState, current_object
from wearline_hmi.core.words import DASH, PREVIEW_STALE_S, STATE_LOST_S
from wearline_hmi.pages.frame import Frame
from wearline_hmi.pages.live import Brightness, LivePicture
from wearline_hmi.pages.measurement import why_not
from wearline_hmi.pages.parts import Button, Field, panel, set_text, text_element
from wearline_hmi.pages.views import picture_words


def build_camera(page: Frame) -> None:
    """The screen ``/camera``."""
    say = page.look.say
    with Element("div").classes("grid-camera"):
        with panel(say("Live picture"), "area-picture"):
            picture = LivePicture(picture_words(say), PREVIEW_STALE_S, "column")
        with Element("div").classes("area-side stack"):
            _settings(page)
            _last_frame(page)
        with panel(say("Brightness"), "area-bright"):
            Brightness(brightness_words(say), page.look.ink)
    _follow_recipe(page, picture)


def brightness_words(say: Language) -> dict[str, str]:
    """What the charts below the picture say."""
    return {
        "profiles": say("Brightness along the two lines"),
        "histogram": say("Histogram of the picture (logarithmic)"),
        "mean": say("Mean"),
        "saturated": say("Saturated"),
        "focus": say("Focus figure"),
        "best": say("Best so far"),
        "highest": say("highest"),
        "point": say.decimal_point,
    }


def _follow_recipe(page: Frame, picture: LivePicture) -> None:
    """Draw the ROI of the current object; the movable lines cross the laser lines."""
    shown: list[int | None] = [None]

    async def load(index: int) -> None:
        answer = await page.ask(RECIPE, AskRecipe(object_index=index), str(index))
        if isinstance(answer, ObjectRecipe):
            try:
                recipe = parse_recipe(answer.recipe_yaml)
            except RecipeError as error:
                ui.notify(str(error), type="negative")
                return
            picture.overlay(recipe.roi, "row" if recipe.orientation == "vertical" else "column")

    def renew(state: CellState, now_s: float) -> None:
        index = current_object(state)
        if index is not None and index != shown[0]:
            shown[0] = index
            ui.timer(0.05, lambda: load(index), once=True)

    page.renewed_by(renew)


def _settings(page: Frame) -> None:
    say = page.look.say

    async def apply() -> None:
        try:
            exposure_us, gain_db = (float(f.value.replace(",", ".")) for f in (exposure, gain))
            wanted = SetCamera(exposure_us=exposure_us, gain_db=gain_db)
        except ValueError:
            ui.notify(say("Exposure and gain are numbers, and the exposure is above 0."), type="negative")
            return
        before = _camera(page.service.snapshot)
        detail = f"exposure {before[0]} -> {exposure_us:g} us, gain {before[1]} -> {gain_db:g} dB"
        await page.command(rights.SET_CAMERA, SET_CAMERA, wanted, detail)

    with panel(say("Camera"), "control"), Element("div").classes("form"):
        exposure = Field(say("Exposure [µs]"), kind="text", inputmode="decimal")
        gain = Field(say("Gain [dB]"), kind="text", inputmode="decimal")
        button = Button(say("Set"), page.guarded(rights.SET_CAMERA, apply), "main wide")
        reason = why_not(page, rights.SET_CAMERA)
        button.enable(not reason, reason)
        hint = reason or say("Holds from the next picture until the service starts anew; the recipe keeps its own.")
        text_element("p", hint, "hint")
        if page.may(rights.SAVE_PICTURE):
            save = text_element("a", say("Save the picture"), "button wide")
            save.props["href"] = "/live/preview.jpg"
            save.props["download"] = "wearline-preview.jpg"
    for box in (exposure, gain):
        box.box.props["disabled"] = bool(reason)
    known: list[tuple[str, str]] = [("", "")]

    def renew(state: CellState, now_s: float) -> None:
        now = _camera(state)
        # What somebody is typing is not written over; another setting is shown.
        if now != known[0]:
            known[0] = now
            exposure.set(now[0])
            gain.set(now[1])

    page.renewed_by(renew)


def _camera(state: CellState) -> tuple[str, str]:
    """Exposure [us] and gain [dB] as capture tells them."""
    told = state.services["capture"].state
    values = {} if told is None else told.values
    exposure_us, gain_db = values.get("exposure_us"), values.get("gain_db")
    return tuple(f"{v:g}" if isinstance(v, int | float) else "" for v in (exposure_us, gain_db))  # type: ignore[return-value]


def _last_frame(page: Frame) -> None:
    say = page.look.say
    with panel(say("Last measured frame")), Element("div").classes("padded"):
        with Element("dl").classes("figures"):
            figures = {}
            for key, name in (
                ("camera", "Camera"), ("frames", "Frames taken"), ("refused", "Frames refused"),
                ("lines", "Lines seen"),
                ("spot", "Centre spot"), ("width", "Stripe width [px]"), ("saturated", "Saturated"),
                ("ambient", "Ambient light [DN]"), ("contrast", "Stripe contrast [DN]"),
            ):  # fmt: skip
                text_element("dt", say(name))
                figures[key] = Element("dd")
        sentences = text_element("p", "", "hint")

    def renew(state: CellState, now_s: float) -> None:
        seen = state.services["capture"]
        is_known = seen.state is not None and seen.at_s is not None and now_s - seen.at_s <= STATE_LOST_S
        values = seen.state.values if seen.state is not None and is_known else {}
        texts = {
            "camera": str(values.get("camera", DASH)),
            "frames": str(values.get("frames", DASH)),
            "refused": str(values.get("frames_refused", DASH)),
        }
        if state.verdict is not None:
            q = state.verdict.quality
            texts |= {
                "lines": str(q.lines_seen),
                "spot": say("found") if q.spot_found else say("not found"),
                "width": DASH if q.stripe_width_px is None else say.number(f"{q.stripe_width_px:.2f}"),
                "saturated": say.number(f"{100 * q.saturated_fraction:.2f} %"),
                "ambient": f"{q.ambient_dn:.0f}",
                "contrast": f"{q.contrast_dn:.0f}",
            }
            set_text(sentences, " ".join(q.sentences))
        for key, element in figures.items():
            set_text(element, texts.get(key, DASH))

    page.renewed_by(renew)
