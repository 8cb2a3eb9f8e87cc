"""Frames, references and the object list on disk."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from wearline.artifact import content_hash
from wearline.errors import RecordError, UsageError
from wearline.recipe import Recipe
from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.frames import Class, FrameSettings, FrameStore, pixel_hash
from wearline_judge.drivers.objects import ObjectFile


def image(seed: int) -> NDArray[np.uint8]:
    """Noise: a PNG of some 10 kB."""
    return np.random.default_rng(seed).integers(0, 256, (100, 100)).astype(np.uint8)


def stored(folder: Path) -> dict[str, list[str]]:
    return {kind.value: sorted(p.stem for p in (folder / kind.value).glob("*/*.png")) for kind in Class}


def put(store: FrameStore, *frames: tuple[int, Class]) -> None:
    for seed, kind in frames:
        store.put(image(seed), kind)
        # The order of age is that of storing; the queue must not overflow.
        while not store._jobs.empty():
            os.sched_yield()


def test_frames_come_back_as_they_were(tmp_path: Path) -> None:
    store = FrameStore(tmp_path, FrameSettings())
    put(store, (1, Class.PASSED), (2, Class.FAILED))
    store.close()
    again = FrameStore(tmp_path, FrameSettings())
    assert np.array_equal(again.get(pixel_hash(image(1))), image(1))
    assert np.array_equal(again.get(pixel_hash(image(2))), image(2))
    with pytest.raises(RecordError, match="not stored"):
        again.get("0" * 64)
    with pytest.raises(RecordError, match="not stored"):
        again.get("../../objects")
    again.close()


def test_the_oldest_passed_goes_first_and_failed_is_kept_longest(tmp_path: Path) -> None:
    # Room for four frames of 10 kB.
    store = FrameStore(tmp_path, FrameSettings(frames_quota_mb=0.045))
    put(store, (1, Class.FAILED), (2, Class.NOT_MEASURED), (3, Class.PASSED), (4, Class.PASSED), (5, Class.FAILED))
    store.close()
    names = {seed: pixel_hash(image(seed)) for seed in range(9)}
    assert stored(tmp_path) == {
        "passed": [names[4]], "not_measured": [names[2]], "failed": sorted([names[1], names[5]]),
    }  # fmt: skip
    # What is there from before counts too, by its age.
    for age, seed in enumerate((5, 2, 1)):
        kind = "not_measured" if seed == 2 else "failed"
        os.utime(tmp_path / kind / names[seed][:2] / f"{names[seed]}.png", (1e9 + age, 1e9 + age))
    again = FrameStore(tmp_path, FrameSettings(frames_quota_mb=0.045))
    put(again, (6, Class.FAILED), (7, Class.FAILED), (8, Class.FAILED))
    again.close()
    assert stored(tmp_path)["failed"] == sorted(names[n] for n in (1, 6, 7, 8))
    assert stored(tmp_path)["passed"] == stored(tmp_path)["not_measured"] == []


def test_frames_give_way_when_the_disk_is_low(tmp_path: Path) -> None:
    low: list[bool] = []
    store = FrameStore(tmp_path, FrameSettings(), lambda: bool(low) and bool(low.pop()))
    put(store, (1, Class.PASSED), (2, Class.PASSED), (3, Class.FAILED))
    deadline = time.monotonic() + 20.0
    while len(stored(tmp_path)["failed"]) < 1 and time.monotonic() < deadline:
        os.sched_yield()
    low.extend([False, True, True])
    put(store, (4, Class.FAILED))
    store.close()
    names = {seed: pixel_hash(image(seed)) for seed in range(9)}
    assert store.left_out == 1
    assert stored(tmp_path) == {"passed": [names[2]], "not_measured": [], "failed": [names[3]]}


def test_a_store_that_cannot_keep_up_leaves_frames_out_and_never_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    gate = threading.Event()
    monkeypatch.setattr(FrameStore, "_store", lambda *_: gate.wait(20.0))
    store = FrameStore(tmp_path, FrameSettings())
    for seed in range(12):
        store.put(image(seed), Class.PASSED)
    assert store.left_out in (3, 4)
    gate.set()
    store.close()


def test_no_quota_keeps_no_frames(tmp_path: Path) -> None:
    store = FrameStore(tmp_path, FrameSettings(frames_quota_mb=0))
    store.put(image(1), Class.FAILED)
    store.close()
    assert list(tmp_path.iterdir()) == []


def test_artifacts_and_recipes_are_named_by_their_content(tmp_path: Path) -> None:
    blobs = BlobStore(tmp_path)
    name = blobs.put_artifact(b"content")
    assert name == content_hash(b"content") and blobs.artifact(name) == b"content"
    (tmp_path / "artifacts" / name).write_bytes(b"altered")
    with pytest.raises(RecordError, match="was altered"):
        blobs.artifact(name)
    assert blobs.put_artifact(b"content") == name and blobs.artifact(name) == b"content"
    recipe = Recipe(precision_mm=0.07)
    known = blobs.put_recipe(recipe)
    assert blobs.recipe(known) == recipe
    (tmp_path / "recipes" / f"{known}.yaml").write_text("precision_mm: 0.5\n")
    with pytest.raises(RecordError, match="was altered"):
        blobs.recipe(known)
    for wrong in ("", "0" * 64, "../chain"):
        with pytest.raises(RecordError, match="is not here"):
            blobs.artifact(wrong)


def test_versions_are_released_and_rolled_back(tmp_path: Path) -> None:
    objects, reader = ObjectFile(tmp_path / "objects.json"), ObjectFile(tmp_path / "objects.json")
    assert reader.objects() == {}
    add: Callable[..., object] = lambda template, **more: objects.add(3, "tray", "r", "c", template, "", **more)  # noqa: E731
    add("t1")
    add("t2", release=False)
    assert reader.objects()[3].ruling == reader.objects()[3].versions[0]
    objects.release(3, 2)
    add("t3")
    assert [v.template_hash for v in reader.objects()[3].versions] == ["t1", "t2", "t3"]
    assert reader.objects()[3].released == (1, 2, 3)
    assert objects.rollback(3).version == 2 and objects.rollback(3).version == 1
    with pytest.raises(UsageError, match="no more than once"):
        objects.rollback(3)
    with pytest.raises(UsageError, match="has no version 9; it has 1, 2, 3"):
        objects.release(3, 9)
    with pytest.raises(UsageError, match="object 4"):
        objects.release(4, 1)


def test_a_damaged_object_list_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "objects.json"
    path.write_text('{"format": "wearline.objects.v1", "objects": {"1": {"nam')
    with pytest.raises(RecordError, match=r"objects\.json: is no object list"):
        ObjectFile(path).objects()
    with pytest.raises(RecordError):
        ObjectFile(path).add(1, "tray", "r", "c", "t", "")
    assert path.read_text().endswith('"nam')


def test_writers_at_the_same_time_lose_nothing(tmp_path: Path) -> None:
    children = []
    for writer in range(4):
        child = os.fork()
        if child == 0:
            try:
                own = ObjectFile(tmp_path / "objects.json")
                for turn in range(10):
                    own.add(writer, "tray", f"r{turn}", "c", "t", "")
            finally:
                os._exit(0)
        children.append(child)
    for child in children:
        assert os.waitpid(child, 0)[1] == 0
    found = ObjectFile(tmp_path / "objects.json").objects()
    assert {index: len(entry.versions) for index, entry in found.items()} == dict.fromkeys(range(4), 10)
