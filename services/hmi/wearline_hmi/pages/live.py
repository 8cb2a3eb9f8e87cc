"""The newest picture and maps as plain bytes over HTTP, and the elements that show them."""

from __future__ import annotations

from dataclasses import asdict

import nicegui.elements.scene  # noqa: F401  registers the three.js that surface.js imports
from fastapi import FastAPI, HTTPException
from fastapi.responses import Response
from nicegui.element import Element

from wearline_hmi.core.charts import Ink
from wearline_hmi.core.maps import ViewHeader, header_json, view_bytes, wear_map_bytes, wear_map_header
from wearline_hmi.service import HmiService


def add_live(app: FastAPI, service: HmiService) -> None:
    """The routes ``/live/...``."""

    @app.get("/live/preview.jpg")
    async def preview(have: int = -1) -> Response:
        """The newest camera picture; 204 where the caller has it already or there is none."""
        state = service.snapshot
        now_s = service.clock()
        headers = {"Cache-Control": "no-store"}
        if state.preview is None or state.preview_at_s is None or state.preview_heard_s is None:
            return Response(status_code=204, headers=headers)
        headers["X-Step"] = f"{state.preview.step_px:g}"
        headers["X-Serial"] = str(state.preview_serial)
        headers["X-Age-Ms"] = f"{1000 * (now_s - state.preview_at_s):.0f}"
        headers["X-Heard-Ms"] = f"{1000 * (now_s - state.preview_heard_s):.0f}"
        if have == state.preview_serial:
            return Response(status_code=204, headers=headers)
        return Response(state.preview.jpeg.tobytes(), media_type="image/jpeg", headers=headers)

    @app.get("/live/maps/{cycle_id}.bin")
    async def maps(cycle_id: str) -> Response:
        """float32, little-endian, [map, row, col] of one of the two newest views, else 404."""
        state = service.snapshot
        view = next((v for v in (state.view, state.view_before) if v is not None and v.cycle_id == cycle_id), None)
        if view is None:
            raise HTTPException(404, "newer strokes have replaced these maps")
        return Response(
            view_bytes(view),
            media_type="application/octet-stream",
            headers={"Cache-Control": "private, max-age=60, immutable"},
        )

    @app.get("/live/wear/{key}.bin", include_in_schema=False)
    async def wear(key: str) -> Response:
        """float32, little-endian, [map, row, col]: how often each square deviates and how its wear grows."""
        found = service.snapshot.wear_map
        if found is None or wear_map_header(found, None).cycle_id != key:
            raise HTTPException(404, "a newer map has replaced this one")
        return Response(
            wear_map_bytes(found), media_type="application/octet-stream", headers={"Cache-Control": "no-store"}
        )


class LivePicture(Element, component="live_picture.js"):
    """The camera picture, polled: the newest frame wins and its age is seen."""

    def __init__(self, words: dict[str, str], stale_s: float, across: str = "") -> None:
        """With `across` (column or row) two lines can be moved over it, whose brightness `Brightness` shows."""
        super().__init__()
        self._props["words"] = words
        self._props["stale-s"] = stale_s
        self._props["roi"] = None
        self._props["across"] = across

    def overlay(self, roi: tuple[int, int, int, int] | None, across: str) -> None:
        """Draw the ROI (x, y, width, height on the sensor [px]) and let the lines cross the laser lines."""
        self._props["roi"] = None if roi is None else list(roi)
        self._props["across"] = across
        self.update()


class Brightness(Element, component="brightness.js"):
    """Brightness along the two lines of the picture, histogram, saturation and focus; made in the browser."""

    def __init__(self, words: dict[str, str], ink: Ink) -> None:
        super().__init__()
        self._props["words"] = words
        self._props["ink"] = asdict(ink)


class Surface(Element, component="surface.js"):
    """One map as a surface; the browser fetches the bytes itself."""

    def __init__(self, words: dict[str, str]) -> None:
        super().__init__()
        self._props["words"] = words
        self._props["header"] = None
        self._props["map"] = ""
        self._props["painting"] = "surface"

    def show(self, header: ViewHeader, kind: str = "maps") -> None:
        """Show another view; `kind` is where its bytes are found below ``/live``."""
        if self._props["header"] is None or self._props["header"]["cycle_id"] != header.cycle_id:
            self._props["header"] = {**header_json(header), "url": f"/live/{kind}/{header.cycle_id}.bin"}
            self.update()

    def choose(self, name: str) -> None:
        """Show another map of the same view."""
        self._props["map"] = name
        self.update()

    def paint(self, how: str) -> None:
        """As surface, mesh or flat."""
        self._props["painting"] = how
        self.update()
