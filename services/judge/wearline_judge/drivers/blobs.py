"""Calibrations, templates and recipes by content hash: immutable, written once, never removed while listed."""

from __future__ import annotations

from pathlib import Path

from wearline.artifact import content_hash
from wearline.errors import RecordError
from wearline.recipe import Recipe, dump_recipe, parse_recipe, recipe_hash
from wearline_judge.drivers.objects import durable_write


class BlobStore:
    """Two folders: ``artifacts/<sha256>`` and ``recipes/<hash>.yaml``."""

    def __init__(self, folder: Path) -> None:
        self._artifacts, self._recipes = folder / "artifacts", folder / "recipes"

    def put_artifact(self, content: bytes) -> str:
        """Keep a file's bytes and return their hash.

        Raises:
            RecordError: it cannot be written.
        """
        name = content_hash(content)
        self._put(self._artifacts / name, content)
        return name

    def artifact(self, name: str) -> bytes:
        """The bytes of that hash.

        Raises:
            RecordError: it is not here, or was altered.
        """
        content = self._get(self._artifacts / name, f"artifact {name[:12] or '(none)'}")
        if content_hash(content) != name:
            raise RecordError("was altered on disk", f"artifact {name[:12]}", "restore a backup, or add it again")
        return content

    def put_recipe(self, recipe: Recipe) -> str:
        """Keep a recipe and return its hash.

        Raises:
            RecordError: it cannot be written.
        """
        name = recipe_hash(recipe)
        self._put(self._recipes / f"{name}.yaml", dump_recipe(recipe).encode())
        return name

    def recipe(self, name: str) -> Recipe:
        """The recipe of that hash.

        Raises:
            RecordError: it is not here, or was altered.
            RecipeError: it cannot be read by this version.
        """
        content = self._get(self._recipes / f"{name}.yaml", f"recipe {name[:12]}")
        recipe = parse_recipe(content.decode("utf-8", "replace"), f"recipe {name[:12]}")
        if recipe_hash(recipe) != name:
            raise RecordError("was altered on disk", f"recipe {name[:12]}", "restore a backup, or add it again")
        return recipe

    def _get(self, path: Path, what: str) -> bytes:
        if not path.stem.isalnum():
            raise RecordError("is not here", what, "add it with 'wearline recipe add'")
        try:
            return path.read_bytes()
        except OSError as error:
            raise RecordError("is not here", what, "add it with 'wearline recipe add', or restore a backup") from error

    def _put(self, path: Path, content: bytes) -> None:
        try:
            if path.exists() and path.read_bytes() == content:
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            durable_write(path, content)
        except OSError as error:
            raise RecordError(
                f"cannot be written ({error.strerror})", str(path), "check its rights and free space"
            ) from error
