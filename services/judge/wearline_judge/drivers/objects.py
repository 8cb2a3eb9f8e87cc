"""The object list: which recipe, calibration and template rule each object, with versions, release and rollback.

One JSON file, replaced as a whole and synced, so that the judge and `wearline recipe` may both
use it: writers take a lock, readers see the old list or the new one.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wearline.errors import RecordError, UsageError


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Version(_Part):
    """One set of references; never changed once written."""

    version: int = Field(ge=1)
    recipe_hash: str
    calibration_hash: str
    template_hash: str
    """Empty: not taught yet."""
    utc: str
    person: str = ""
    note: str = ""


class Listed(_Part):
    """One object."""

    name: str
    versions: tuple[Version, ...] = ()
    released: tuple[int, ...] = ()
    """Versions in the order of their release; the last one rules, rollback takes it away."""

    @property
    def ruling(self) -> Version | None:
        """What is released now."""
        return next((v for v in self.versions if self.released and v.version == self.released[-1]), None)


class _File(_Part):
    format: str = "wearline.objects.v1"
    objects: dict[int, Listed] = {}


class ObjectFile:
    """The list on disk; read anew whenever the file has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int, int] | None = None
        self._known = _File()

    def objects(self) -> dict[int, Listed]:
        """Object index -> object.

        Raises:
            RecordError: the file is damaged or unreadable.
        """
        return self._read().objects

    def add(
        self, index: int, name: str, recipe_hash: str, calibration_hash: str, template_hash: str, utc: str,
        person: str = "", note: str = "", release: bool = True,
    ) -> Version:  # fmt: skip
        """Append a version, and release it.

        Raises:
            RecordError: the file cannot be read or written.
        """
        with self._changing() as content:
            old = content.objects.get(index, Listed(name=name))
            version = Version(
                version=max((v.version for v in old.versions), default=0) + 1, recipe_hash=recipe_hash,
                calibration_hash=calibration_hash, template_hash=template_hash, utc=utc, person=person, note=note,
            )  # fmt: skip
            released = (*old.released, version.version) if release else old.released
            self._write(content, index, Listed(name=name, versions=(*old.versions, version), released=released))
        return version

    def release(self, index: int, version: int) -> Version:
        """Let a version rule.

        Raises:
            UsageError: there is no such object or version.
            RecordError: the file cannot be read or written.
        """
        with self._changing() as content:
            old = self._one(content, index)
            found = next((v for v in old.versions if v.version == version), None)
            if found is None:
                known = ", ".join(str(v.version) for v in old.versions)
                raise UsageError(f"has no version {version}", f"object {index}", f"it has {known}")
            if old.ruling != found:
                self._write(content, index, old.model_copy(update={"released": (*old.released, version)}))
        return found

    def rollback(self, index: int) -> Version:
        """Let the version rule that ruled before.

        Raises:
            UsageError: there is no such object, or nothing was released before.
            RecordError: the file cannot be read or written.
        """
        with self._changing() as content:
            old = self._one(content, index)
            if len(old.released) < 2:
                raise UsageError("was released no more than once", f"object {index}", "release a version by its number")
            new = old.model_copy(update={"released": old.released[:-1]})
            self._write(content, index, new)
            ruling = new.ruling
        if ruling is None:
            raise RecordError("names a version that is not in it", str(self._path), "restore a backup")
        return ruling

    def _one(self, content: _File, index: int) -> Listed:
        if index not in content.objects:
            raise UsageError("is not in the object list", f"object {index}", "see 'wearline recipe list'")
        return content.objects[index]

    def _read(self) -> _File:
        try:
            found = self._path.stat()
            seen = (found.st_mtime_ns, found.st_size, found.st_ino)
            if seen != self._seen:
                self._known = _File.model_validate_json(self._path.read_bytes())
                self._seen = seen
        except FileNotFoundError:
            self._known, self._seen = _File(), None
        except OSError as error:
            raise RecordError(f"cannot be read ({error.strerror})", str(self._path), "check its rights") from error
        except ValidationError as error:
            raise RecordError("is no object list", str(self._path), "restore a backup") from error
        return self._known

    @contextmanager
    def _changing(self) -> Iterator[_File]:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.with_suffix(".lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield self._read()
        except OSError as error:
            raise RecordError(
                f"cannot be written ({error.strerror})", str(self._path), "check its rights and free space"
            ) from error

    def _write(self, content: _File, index: int, listed: Listed) -> None:
        new = content.model_copy(update={"objects": {**content.objects, index: listed}})
        durable_write(self._path, new.model_dump_json(indent=1).encode())


def durable_write(path: Path, content: bytes) -> None:
    """Replace a file as a whole; it is on disk when this returns."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    with draft.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
