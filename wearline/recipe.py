"""What is wanted of one object; a YAML file with a committed schema."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wearline.errors import RecipeError


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class Limits(_Section):
    """What a part may show before it fails; None = not limited."""

    mean_error_mm: float | None = Field(default=None, gt=0)
    """On the thesis' mean error: mean absolute deviation over the deviating area. [mm]"""
    max_error_mm: float | None = Field(default=None, gt=0)
    """On the largest absolute deviation. [mm]"""
    area_mm2: float | None = Field(default=None, gt=0)
    """On the deviating area. [mm^2]"""


class Zone(_Section):
    """A polygon on the part, in sensor pixels, with limits of its own."""

    name: str = Field(min_length=1, max_length=32)
    polygon_px: tuple[tuple[float, float], ...] = Field(min_length=3)
    """(x, y) corners. [px]"""
    precision_mm: float | None = Field(default=None, gt=0)
    limits: Limits = Limits()


class LineConstraint(_Section):
    """A correction by hand: the stripe through this pixel bears this line number."""

    row_px: float
    col_px: float
    line: int = Field(ge=0)


class Recipe(_Section):
    """All that is wanted of one object."""

    roi: tuple[int, int, int, int] | None = None
    """x, y, width, height on the sensor; None = whole frame. [px]"""
    orientation: Literal["horizontal", "vertical"] = "horizontal"
    """How the laser lines run on the sensor."""
    mm_per_pixel: float | None = Field(default=None, gt=0)
    """Lateral scale where the calibration has none. [mm/px]"""
    precision_mm: float = Field(default=0.05, gt=0)
    """Deviation above which a point counts as deviating. [mm]"""
    area_floor_mm2: float = Field(default=20.0, ge=0)
    """A region below this area cannot fail a part. [mm^2]"""
    limits: Limits = Limits()
    zones: tuple[Zone, ...] = ()
    datum_zones: tuple[Zone, ...] = ()
    """Where the registration looks; empty = everywhere, with a bounded in-plane shift."""
    guard_band: float = Field(default=0.0, ge=0, le=3)
    """Half width of UNSURE about a limit, in standard uncertainties (ISO 14253-1)."""
    unsure_as: Literal["FAILED", "PASSED"] = "FAILED"
    """What the PLC is told of UNSURE."""
    coverage_min: float = Field(default=0.7, ge=0, le=1)
    """Below this share of the template's points a part is NOT_MEASURED."""
    method: Literal["wearline", "thesis"] = "wearline"
    hdr: Literal["off", "bracket", "saturation"] = "off"
    line_constraints: tuple[LineConstraint, ...] = ()
    exposure_us: float = Field(default=10000.0, gt=0)
    """[us]"""
    gain_db: float = 0.0


def parse_recipe(text: str, where: str = "recipe") -> Recipe:
    """Read a recipe from YAML text.

    Raises:
        RecipeError: not YAML, an unknown key, or a value out of range, with its place.
    """
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise RecipeError(f"not YAML ({' '.join(str(error).split())})", where, "mend the syntax") from error
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise RecipeError("a recipe is a mapping of settings", where, "write 'name: value' lines")
    try:
        return Recipe(**{str(k): v for k, v in content.items()})
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise RecipeError(f"{place}: {first['msg']}", where, "docs/reference lists the settings") from error


def load_recipe(path: Path | None) -> Recipe:
    """The recipe in a file, or the default one for None.

    Raises:
        RecipeError: unreadable or invalid.
    """
    if path is None:
        return Recipe()
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"cannot be read ({error})", str(path), "name an existing YAML file") from error
    return parse_recipe(text, str(path))


def dump_recipe(recipe: Recipe) -> str:
    """YAML of all settings, in a fixed order."""
    return yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=True)


def recipe_hash(recipe: Recipe) -> str:
    """sha256 over the canonical form, hex; equal settings have equal hashes."""
    return hashlib.sha256(recipe.model_dump_json().encode()).hexdigest()
