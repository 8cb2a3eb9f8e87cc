"""``rejudge``, ``backup``, ``restore``, ``export`` and ``import`` on a cell that has recorded."""

from __future__ import annotations

import csv
import json
import re
import shutil
import sqlite3
import tarfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.unit.judge.rendered import cell_file, usage
from tests.unit.judge.test_records import KEY, cycles, utc
from wearline.cli import main
from wearline.messages import AskRecords, Decision, DieEvent, Verdict
from wearline_judge.core.pictures import colours, levels_of, tiff16
from wearline_judge.drivers.backup import copy_tables
from wearline_judge.drivers.chain import key_of
from wearline_judge.drivers.lock import FolderLock
from wearline_judge.drivers.records import RecordStore, open_engine, sqlite_url

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Recorded = tuple[Path, Verdict]
Capture = pytest.CaptureFixture[str]


def done(capsys: Capture, *arguments: str) -> str:
    capsys.readouterr()
    assert main([*arguments]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out


def store_of(config: Path) -> RecordStore:
    folder = config.parent / "run" / "judge"
    return RecordStore(sqlite_url(folder / "records.db"), key_of(folder / "chain.key"), must_exist=True)


def test_another_recipe_judges_the_recorded_parts(recorded: Recorded, capsys: Capture) -> None:
    config, _ = recorded
    lenient = config.parent / "lenient.yaml"
    lenient.write_text("mm_per_pixel: 0.1\nlimits: {mean_error_mm: 0.5}\n")
    out = done(capsys, "rejudge", "--config", str(config), "--recipe", str(lenient))
    assert "stroke 8, cycle c-8: FAILED -> PASSED" in out
    assert "2 parts judged again, 1 would have been judged otherwise" in out
    assert "left out: 1 (not judged by a frame)" in out
    told = [
        json.loads(line)
        for line in done(capsys, "rejudge", "--config", str(config), "--recipe", str(lenient), "--json").splitlines()
    ]
    assert [(t["stroke"], t["recorded"], t["rejudged"]) for t in told] == [
        (8, "FAILED", "PASSED"), (9, "PASSED", "PASSED"),
    ]  # fmt: skip
    shutil.rmtree(config.parent / "run" / "judge" / "frames")
    assert "left out: 2 (frame or references" in done(
        capsys, "rejudge", "--config", str(config), "--recipe", str(lenient), "--last", "3"
    )
    assert "no such records" in usage(
        capsys, "rejudge", "--config", str(config), "--recipe", str(lenient), "--object", "5"
    )


def test_a_backup_of_a_running_cell_brings_everything_back(recorded: Recorded, tmp_path: Path, capsys: Capture) -> None:
    config, verdict = recorded
    run = tmp_path / "run"
    (run / "hmi").mkdir()
    users = sqlite3.connect(run / "hmi" / "users.db")
    users.execute("CREATE TABLE person (name TEXT)")
    users.execute("INSERT INTO person VALUES ('ada')")
    users.commit()
    (run / "fieldbus").mkdir()
    (run / "fieldbus" / "journal-1").write_text("accepted\n")
    running = FolderLock(run / "judge")
    writer = store_of(config)
    archive = tmp_path / "b.tar.gz"
    out = done(capsys, "backup", "--config", str(config), "--out", str(archive))
    assert "5 entries of the chain, checked after writing" in out
    assert archive.stat().st_mode & 0o777 == 0o600
    writer.append(cycles(range(100, 103)))
    writer.close()
    users.close()
    assert "is used by a running judge" in usage(capsys, "restore", str(archive), "--config", str(config))
    running.close()
    shutil.rmtree(run / "judge" / "artifacts")
    out = done(capsys, "restore", str(archive), "--config", str(config))
    assert "5 entries" in out and "before-restore-" in out
    back = store_of(config)
    assert back.counts() == {Decision.FAILED: 1, Decision.PASSED: 1, Decision.NOT_MEASURED: 1}
    assert back.verdict("c-8") == verdict
    back.close()
    assert sqlite3.connect(run / "hmi" / "users.db").execute("SELECT name FROM person").fetchall() == [("ada",)]
    assert (run / "fieldbus" / "journal-1").read_text() == "accepted\n"
    assert "equal bit for bit" in done(capsys, "replay", "c-8", "--config", str(config))
    (aside,) = run.glob("before-restore-*")
    assert (aside / "judge" / "records.db").exists() and not (aside / "judge" / "frames").exists()


def test_a_backup_that_is_not_sound_is_refused_before_anything_is_touched(
    recorded: Recorded, tmp_path: Path, capsys: Capture
) -> None:
    config, _ = recorded
    archive = tmp_path / "b.tar"
    done(capsys, "backup", "--config", str(config), "--out", str(archive))
    before = {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()}

    def refused(path: Path) -> str:
        said = usage(capsys, "restore", str(path), "--config", str(config))
        assert {p: p.read_bytes() for p in before} == before
        return said

    content = archive.read_bytes()
    place = content.index(b'"objects"')
    damaged = tmp_path / "damaged.tar"
    damaged.write_bytes(content[:place] + b"X" + content[place + 1 :])
    assert "is damaged (judge/objects.json)" in refused(damaged)
    damaged.write_bytes(content[: len(content) // 2])
    assert "damaged.tar: is " in refused(damaged)
    damaged.write_text("no archive")
    assert "is no backup" in refused(damaged)
    assert "is no backup" in refused(tmp_path / "absent.tar")
    evil = tmp_path / "evil.tar"
    with tarfile.open(evil, "w") as made:
        made.add(config, "../../outside.yaml")
    assert "is no backup" in refused(evil) and not (tmp_path.parent / "outside.yaml").exists()
    other = tmp_path / "other" / "cell.yaml"
    other.parent.mkdir()
    other.write_text(yaml.safe_dump({"cell": "elsewhere", "data_dir": "run"}))
    assert "is of cell test, not elsewhere" in usage(capsys, "restore", str(archive), "--config", str(other))


def test_records_with_an_altered_entry_make_no_backup(recorded: Recorded, tmp_path: Path, capsys: Capture) -> None:
    config, _ = recorded
    store = store_of(config)
    store.append(cycles(range(100, 200)))
    store.close()
    engine = open_engine(sqlite_url(tmp_path / "run" / "judge" / "records.db"))
    with engine.begin() as db:
        db.exec_driver_sql("UPDATE entry SET utc = '2030' WHERE number = 3")
    engine.dispose()
    said = usage(capsys, "backup", "--config", str(config), "--out", str(tmp_path / "b.tar"))
    assert "entry 3" in said and not (tmp_path / "b.tar").exists()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_tables_are_copied_from_one_kind_of_database_to_the_other(
    database: Callable[[str], str], tmp_path: Path
) -> None:
    start = database("source")
    source = RecordStore(start, KEY)
    source.append(cycles(range(1, 601)))
    source.append_die_event(DieEvent(object_index=1, kind="polish"), 600, utc(600))
    source.append(cycles(range(601, 700)))
    middle, end = sqlite_url(tmp_path / "middle.db"), database("end")
    for old, new in ((start, middle), (middle, end)):
        left, right = open_engine(old), open_engine(new)
        copy_tables(left, right)
        left.dispose()
        right.dispose()
    copied = RecordStore(end, KEY)
    assert list(copied.verified()) == list(source.verified())
    assert copied.rows(AskRecords(last=5)) == source.rows(AskRecords(last=5)) and copied.wear_bins(
        1
    ) == source.wear_bins(1)
    copied.close()
    source.close()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_records_go_out_and_come_back(recorded: Recorded, tmp_path: Path, capsys: Capture, kind: str) -> None:
    config, verdict = recorded
    file = tmp_path / f"records.{kind}"
    assert "3 records" in done(capsys, "export", "records", "--config", str(config), "--out", str(file))
    if kind == "csv":
        rows = list(csv.DictReader(file.open(newline="")))
        assert [r["cycle_id"] for r in rows] == ["c-8", "c-9", "c-10"]
        assert float(rows[0]["mean_error_mm"]) == verdict.mean_error_mm and rows[2]["mean_error_mm"] == ""
        assert rows[0]["told_code"] == "2" and rows[2]["told_code"] == "" and rows[0]["is_simulated"] == "true"
    else:
        import pyarrow.parquet as pq

        table = pq.read_table(file)
        assert table.column("mean_error_mm").to_pylist()[0] == verdict.mean_error_mm
        assert str(table.schema.field("wear_mm").type) == "double"
    (tmp_path / "new").mkdir()
    fresh = cell_file(tmp_path / "new")
    assert "3 records imported, 0" in done(capsys, "import", str(file), "--config", str(fresh))
    assert "0 records imported, 3" in done(capsys, "import", str(file), "--config", str(fresh))
    old, new = store_of(config), store_of(fresh)
    assert [r.replace(record_id=0) for r in new.rows(AskRecords(last=9))] == [
        r.replace(record_id=0) for r in old.rows(AskRecords(last=9))
    ]
    assert new.verdict("c-8") == verdict and len(list(new.verified())) == 5
    old.close()
    new.close()
    assert "1 records" in done(capsys, "export", "records", "--config", str(config), "--out", str(file), "--last", "1")


def test_a_file_with_a_wrong_row_is_refused_whole(recorded: Recorded, tmp_path: Path, capsys: Capture) -> None:
    config, _ = recorded
    file = tmp_path / "records.csv"
    done(capsys, "export", "records", "--config", str(config), "--out", str(file))
    good = file.read_text()
    (tmp_path / "new").mkdir()
    fresh = cell_file(tmp_path / "new")

    def refused(text: str) -> str:
        file.write_text(text)
        said = usage(capsys, "import", str(file), "--config", str(fresh))
        assert not (tmp_path / "new" / "run" / "judge" / "records.db").exists()
        return said

    lines = good.splitlines(keepends=True)
    assert "row 3: decision is FAILED, its verdict says PASSED" in refused(
        lines[0] + lines[1] + lines[2].replace(",PASSED,", ",FAILED,", 1) + lines[3]
    )
    assert "row 3: cycle c-8 is there twice" in refused("".join([lines[0], lines[1], lines[1]]))
    assert "row 2: Verdict" in refused(lines[0] + lines[1].replace("measure_number", "measure_count", 1))
    assert "another number of columns" in refused(lines[0] + "1,2,3\n")
    assert "has no column" in refused("a,b\n1,2\n")
    assert "cannot be read" in refused(good[: len(good) // 2])
    assert "cannot be read" in usage(capsys, "import", str(tmp_path / "absent.parquet"), "--config", str(fresh))
    file.write_text(good)
    done(capsys, "import", str(file), "--config", str(fresh))
    older = re.sub(r"c-(8|9|10)\b", r"old-\1", good)
    older = re.sub(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\.\d\d\d\+00:00,", "2020-01-01T00:00:00.000+00:00,", older)
    file.write_text(older)
    assert "is older than the newest record of object 1" in usage(capsys, "import", str(file), "--config", str(fresh))


def test_maps_go_out_as_points_and_as_16_bit_pictures(recorded: Recorded, tmp_path: Path, capsys: Capture) -> None:
    config, verdict = recorded
    tif, points = tmp_path / "m.tif", tmp_path / "m.ply"
    done(capsys, "export", "map", "c-8", "--config", str(config), "--out", str(tif), "--map", "difference")
    image = cv2.imread(str(tif), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.dtype == np.uint16 and image.shape == (480, 640)
    found = re.search(rb"mm = (-?[\d.]+) \+ \(value - 1\) \* ([\d.]+)", tif.read_bytes())
    assert found is not None
    offset, step = (float(v) for v in found.groups())
    away = np.where(image > 0, offset + (image.astype(float) - 1.0) * step, np.nan)
    # The flake of 0.25 mm about (200, 250), and nothing far from it.
    assert np.nanmedian(away[230:270, 160:240]) == pytest.approx(0.25, abs=0.03)
    assert np.nanmedian(away[230:270, 400:480]) == pytest.approx(0.0, abs=0.03)
    assert (image == 0).any()
    assert "points, mm" in done(capsys, "export", "map", "c-8", "--config", str(config), "--out", str(points))
    head, body = points.read_bytes().split(b"end_header\n", 1)
    count = int(re.search(rb"element vertex (\d+)", head)[1])  # type: ignore[index]
    vertices = np.frombuffer(body, "<f4").reshape(count, 3)
    assert np.isfinite(vertices).all() and count > 200_000
    assert vertices[:, 0].min() >= 0.0 and 60.0 < vertices[:, 0].max() <= 64.0
    assert 0.8 < vertices[:, 2].min() < vertices[:, 2].max() < 3.2
    done(capsys, "export", "map", "c-9", "--config", str(config), "--out", str(tif), "--map", "standard")
    assert "is no .ply or .tif" in usage(
        capsys, "export", "map", "c-8", "--config", str(config), "--out", str(tmp_path / "m.stl")
    )
    assert "CYCLE_ID: is missing" in usage(capsys, "export", "map", "--config", str(config), "--out", str(tif))
    assert verdict.cycle_id == "c-8"


def test_a_part_has_a_report(recorded: Recorded, tmp_path: Path, capsys: Capture) -> None:
    config, _ = recorded
    report = tmp_path / "part.pdf"
    done(capsys, "export", "report", "c-8", "--config", str(config), "--out", str(report))
    content = report.read_bytes()
    assert content.startswith(b"%PDF-") and content.rstrip().endswith(b"%%EOF")
    assert content.count(b"/Subtype /Image") == 4 and content.count(b"/Type /Page\n") == 1
    done(capsys, "export", "report", "c-10", "--config", str(config), "--out", str(report))
    assert report.read_bytes().count(b"/Subtype /Image") == 0
    shutil.rmtree(config.parent / "run" / "judge" / "frames")
    assert "without pictures" in done(capsys, "export", "report", "c-8", "--config", str(config), "--out", str(report))


def test_a_map_keeps_its_micrometres() -> None:
    rng = np.random.default_rng(3)
    field = rng.uniform(-2.0, 9.0, (7, 11)).astype(np.float32)
    field[2, 3] = np.nan
    content = tiff16(field)
    levels = levels_of(field)
    back = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert back is not None and back[2, 3] == 0
    known = np.isfinite(field)
    restored = levels.offset_mm + (back[known].astype(float) - 1.0) * levels.step_mm
    assert np.max(np.abs(restored - field[known])) <= 0.0006
    assert levels_of(np.full((2, 2), np.nan, np.float32)).step_mm == 0.001
    assert levels_of(np.array([[0.0, 200.0]], np.float32)).step_mm == pytest.approx(200 / 65534)


def test_colours_run_from_blue_over_grey_to_red() -> None:
    rgb = colours(np.array([[-1.0, 0.0, 1.0, np.nan]], np.float32), -1.0, 1.0)[0]
    assert rgb[0][2] > rgb[0][0] and rgb[2][0] > rgb[2][2] and len(set(rgb[1].tolist())) == 1
    assert rgb[3].max() < 60
