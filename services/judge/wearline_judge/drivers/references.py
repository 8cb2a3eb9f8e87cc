"""Where the judge finds recipe, calibration and template of an object: its own store live, the asker offline."""

from __future__ import annotations

from typing import Protocol

from wearline.artifact import content_hash
from wearline.errors import RecordError
from wearline.messages import Artifact, AskArtifact, AskRecipe, ObjectEntry, ObjectRecipe
from wearline.recipe import dump_recipe
from wearline.service import Asker
from wearline.topics import ARTIFACT, RECIPE
from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.objects import ObjectFile


class References(Protocol):
    """What rules an object, and the files that it names."""

    def object_recipe(self, index: int) -> ObjectRecipe:
        """The released recipe with its references.

        Raises:
            WearlineError: the object is not in the list, or its recipe cannot be read.
        """
        ...

    def artifact(self, name: str) -> bytes:
        """The bytes of that hash.

        Raises:
            WearlineError: it is not there.
        """
        ...


class StoredReferences:
    """The object list and the store on this disk."""

    def __init__(self, objects: ObjectFile, blobs: BlobStore) -> None:
        self._objects, self._blobs = objects, blobs
        self._answers: dict[tuple[int, int], ObjectRecipe] = {}

    def object_recipe(self, index: int) -> ObjectRecipe:
        listed = self._objects.objects().get(index)
        ruling = listed.ruling if listed else None
        if listed is None or ruling is None:
            raise RecordError(
                "is not in the object list" if listed is None else "has no released version", f"object {index}",
                "add it with 'wearline recipe add'" if listed is None else "release one with 'wearline recipe release'",
            )  # fmt: skip
        known = self._answers.get((index, ruling.version))
        if known is None or known.recipe_hash != ruling.recipe_hash or known.object_name != listed.name:
            known = ObjectRecipe(
                object_index=index,
                object_name=listed.name,
                recipe_yaml=dump_recipe(self._blobs.recipe(ruling.recipe_hash)),
                recipe_hash=ruling.recipe_hash,
                calibration_hash=ruling.calibration_hash,
                template_hash=ruling.template_hash,
                version=ruling.version,
            )
            self._answers[index, ruling.version] = known
        return known

    def artifact(self, name: str) -> bytes:
        return self._blobs.artifact(name)

    def released(self) -> tuple[ObjectEntry, ...]:
        """All objects that have a released version, by index."""
        return tuple(
            ObjectEntry(
                object_index=index,
                object_name=listed.name,
                recipe_hash=ruling.recipe_hash,
                calibration_hash=ruling.calibration_hash,
                template_hash=ruling.template_hash,
                version=ruling.version,
            )
            for index, listed in sorted(self._objects.objects().items())
            if (ruling := listed.ruling) is not None
        )


class AskedReferences:
    """Whatever the asker answers (`wearline.offline`)."""

    def __init__(self, asker: Asker) -> None:
        self._asker = asker

    def object_recipe(self, index: int) -> ObjectRecipe:
        answer = self._asker.ask(RECIPE, AskRecipe(object_index=index), str(index))
        if not isinstance(answer, ObjectRecipe):
            raise RecordError("has no recipe", f"object {index}")
        return answer

    def artifact(self, name: str) -> bytes:
        answer = self._asker.ask(ARTIFACT, AskArtifact(content_hash=name), name)
        content = answer.content.tobytes() if isinstance(answer, Artifact) else b""
        if content_hash(content) != name:
            raise RecordError("came with other content", f"artifact {name[:12] or '(none)'}", "make it again")
        return content
