"""docs/reference/process-image.md, made from the tables.

After a wanted change of a table: ``python tests/unit/fieldbus/reference_page.py`` and commit what it wrote.
"""

from __future__ import annotations

from pathlib import Path

from wearline_fieldbus.core.profiles import PROFILES
from wearline_fieldbus.core.tia import reference_page

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "process-image.md"

if __name__ == "__main__":
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(reference_page(PROFILES), encoding="utf-8")
