"""A cell's records, references and frames, opened beside a judge that may be running."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from wearline.config import CellSettings, load_cell, validated
from wearline.errors import UsageError
from wearline.messages import Frame, LinePoints, ResultCode, Verdict, View
from wearline.offline import Chain
from wearline.recipe import Recipe
from wearline_judge.config import JudgeSettings
from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.frames import FrameStore
from wearline_judge.drivers.objects import ObjectFile
from wearline_judge.drivers.records import RecordStore
from wearline_judge.service import open_records

OF_THE_FRAME = (
    ResultCode.PASSED, ResultCode.FAILED, ResultCode.UNSURE, ResultCode.COVERAGE, ResultCode.BAD_FRAME,
    ResultCode.REGISTRATION,
)  # fmt: skip
"""Codes that follow from frame and references alone."""


@dataclass
class StoredCell:
    """What is needed to look at a recorded cycle again."""

    cell: CellSettings
    settings: JudgeSettings
    folder: Path
    records: RecordStore
    blobs: BlobStore
    objects: ObjectFile
    frames: FrameStore
    _chains: dict[tuple[str, ...], Chain] = field(default_factory=dict)

    def verdict(self, cycle_id: str) -> Verdict:
        """The recorded verdict of a cycle.

        Raises:
            UsageError: there is none.
        """
        found = self.records.verdict(cycle_id)
        if found is None:
            raise UsageError("has no record", f"cycle {cycle_id}", "the production screen lists the cycles")
        return found

    def computed(
        self, recorded: Verdict, recipe: Recipe | None = None, template_hash: str | None = None
    ) -> tuple[Frame, Verdict, LinePoints, View | None]:
        """Judge the stored frame of a cycle again: by its own references, or by others.

        Raises:
            UsageError: the verdict did not follow from a frame.
            RecordError: frame or references are not here any more.
        """
        if recorded.code not in OF_THE_FRAME or not recorded.frame_hash:
            raise UsageError(
                f"was not judged by its frame ({recorded.reason})", f"cycle {recorded.cycle_id}",
                "there is nothing to compute again",
            )  # fmt: skip
        pixels = self.frames.get(recorded.frame_hash)
        chain = self._chain(recorded, recipe, recorded.template_hash if template_hash is None else template_hash)
        frame = chain.frame(pixels, recorded.request)
        return frame, *chain.judged(frame)

    def _chain(self, recorded: Verdict, recipe: Recipe | None, template_hash: str) -> Chain:
        ruling = recipe or self.blobs.recipe(recorded.recipe_hash)
        key = (
            ruling.model_dump_json(), recorded.calibration_hash, template_hash, str(recorded.request.object_index),
            str(recorded.is_simulated),
        )  # fmt: skip
        if key not in self._chains:
            self._chains[key] = Chain(
                ruling,
                self.blobs.artifact(recorded.calibration_hash) if recorded.calibration_hash else None,
                self.blobs.artifact(template_hash) if template_hash else None,
                object_index=recorded.request.object_index,
                is_simulated=recorded.is_simulated,
            )
        return self._chains[key]

    def close(self) -> None:
        """Give all back."""
        for chain in self._chains.values():
            chain.close()
        self.records.close()


@contextmanager
def stored_cell(config: Path) -> Iterator[StoredCell]:
    """Open what a cell.yaml names.

    Raises:
        ConfigError, RecordError: it cannot be obeyed, or there are no records.
    """
    cell = load_cell(config)
    settings = validated(JudgeSettings, cell.judge, f"{config}: judge")
    folder = cell.data_folder("judge")
    found = StoredCell(
        cell, settings, folder, open_records(cell, settings, must_exist=True), BlobStore(folder),
        ObjectFile(folder / "objects.json"),
        FrameStore(folder / "frames", settings.model_copy(update={"frames_quota_mb": 0.0})),
    )  # fmt: skip
    try:
        yield found
    finally:
        found.close()
