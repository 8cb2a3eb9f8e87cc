"""Maps on their way to the browser: plain bytes beside a few figures."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from wearline.messages import View, WearMap

WEAR_MAPS = ("frequency", "growth")


@dataclass(frozen=True)
class MapScale:
    """Colour scale of one map."""

    low_mm: float
    high_mm: float
    kind: str
    """height (sequential), signed (diverging about 0) or size (from 0)."""
    relief: float
    """Exaggeration of heights that makes the relief legible."""
    unit: str = "mm"
    """Of the map's values."""


@dataclass(frozen=True)
class ViewHeader:
    """What the browser must know before it fetches the bytes."""

    cycle_id: str
    stroke: int
    names: tuple[str, ...]
    rows: int
    cols: int
    step: float
    """Between two elements, in mm where the scale is known, else px."""
    unit: str
    scales: tuple[MapScale, ...]
    measured_share: float
    """Share of the elements of the standard that the measured map has too, 0-1."""


def nice_above(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten that is not below `value` (> 0)."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(decade * m for m in (1.0, 2.0, 5.0, 10.0) if decade * m >= value * (1 - 1e-6))


def _span(values: NDArray[np.float32], low: float, high: float) -> tuple[float, float]:
    seen = values[np.isfinite(values)]
    if seen.size == 0:
        return 0.0, 0.0
    a, b = np.percentile(seen, [low, high])
    return float(a), float(b)


def scale_of(name: str, values_mm: NDArray[np.float32], width: float) -> MapScale:
    """Colour scale and relief of one map [row, col]; `width` is the longer side of the map in its unit.

    Difference and error share a floor of 0.1 mm, so that noise does not look like wear.
    """
    low, high = _span(values_mm, 0.5, 99.5)
    if name == "difference":
        top = nice_above(max(abs(low), abs(high), 0.1))
        low, high, kind = -top, top, "signed"
    elif name == "error":
        low, high, kind = 0.0, nice_above(max(high, 0.1)), "size"
    else:
        if high - low < 0.1:
            middle = 0.5 * (low + high)
            low, high = middle - 0.05, middle + 0.05
        kind = "height"
    # What is left of a difference is mostly noise: a lower relief keeps it from looking like rock.
    wanted = (0.06 if kind == "signed" else 0.18) * width / (high - low)
    relief = nice_above(wanted) if wanted > 1.0 else 1.0
    return MapScale(low, high, kind, min(relief, 1000.0))


def view_header(view: View) -> ViewHeader:
    """Names, size and scales of the maps of one view; standard and measured share one scale."""
    maps = view.maps_mm
    _, rows, cols = maps.shape
    step = view.step_px * (view.mm_per_pixel or 1.0)
    width = step * max(rows, cols, 1)
    scales = [scale_of(name, maps[i], width) for i, name in enumerate(view.names)]
    names = list(view.names)
    share = 0.0
    if "standard" in names and "measured" in names:
        standard, measured = names.index("standard"), names.index("measured")
        scales[measured] = scales[standard]
        wanted = np.isfinite(maps[standard])
        if wanted.any():
            share = float(np.isfinite(maps[measured])[wanted].mean())
    unit = "mm" if view.mm_per_pixel else "px"
    return ViewHeader(view.cycle_id, view.stroke, view.names, rows, cols, step, unit, tuple(scales), share)


def wear_map_header(wear_map: WearMap, mm_per_pixel: float | None) -> ViewHeader:
    """Share of the parts that deviate [%] and growth of wear [mm per 1000 strokes], over squares of the part."""
    shares, slopes = _wear_maps(wear_map)
    rows, cols = shares.shape
    top_share = float(np.nanmax(shares, initial=0.0))
    top_slope = float(np.nanmax(np.abs(slopes), initial=0.0))
    scales = (
        MapScale(0.0, nice_above(max(top_share, 10.0)), "size", 1.0, "%"),
        MapScale(-nice_above(max(top_slope, 0.01)), nice_above(max(top_slope, 0.01)), "signed", 1.0, "mm/1000"),
    )
    step = wear_map.square_px * (mm_per_pixel or 1.0)
    key = f"{wear_map.object_index}-{wear_map.parts}"
    return ViewHeader(key, wear_map.parts, WEAR_MAPS, rows, cols, step, "mm" if mm_per_pixel else "px", scales, 1.0)


def wear_map_bytes(wear_map: WearMap) -> bytes:
    """float32, little-endian, [map, row, col] in the units of the header; NaN = no part was seen there."""
    return np.ascontiguousarray(np.stack(_wear_maps(wear_map)), dtype="<f4").tobytes()


def _wear_maps(wear_map: WearMap) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    maps = dict(zip(wear_map.names, wear_map.maps, strict=True))
    return 100.0 * maps["error_share"], maps["slope_mm_per_kilostroke"]


def header_json(header: ViewHeader) -> dict[str, object]:
    """As JSON values for the browser."""
    return asdict(header)


def view_bytes(view: View) -> bytes:
    """float32, little-endian, [map, row, col]; NaN = not measured."""
    return np.ascontiguousarray(view.maps_mm, dtype="<f4").tobytes()
