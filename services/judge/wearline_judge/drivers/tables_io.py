"""Records as CSV and Parquet, one row per cycle, and back: checked to the last row before one is written."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from wearline.errors import RecordError
from wearline.messages import Outcome, Verdict
from wearline_judge.drivers.records import Cycle, record_of, told_of

_TEXT, _INT, _FLOAT, _BOOL = "string", "int64", "float64", "bool"
COLUMNS: dict[str, str] = {
    "record": _INT, "cycle_id": _TEXT, "utc": _TEXT, "monotonic_s": _FLOAT, "object_index": _INT, "part_id": _TEXT,
    "stroke": _INT, "measure_number": _INT, "decision": _TEXT, "code": _INT, "reason": _TEXT,
    "mean_error_mm": _FLOAT, "max_error_mm": _FLOAT, "wear_mm": _FLOAT, "deviating_area_mm2": _FLOAT,
    "coverage": _FLOAT, "is_simulated": _BOOL, "frame_hash": _TEXT, "calibration_hash": _TEXT, "template_hash": _TEXT,
    "recipe_hash": _TEXT, "code_version": _TEXT, "told_code": _INT, "told_utc": _TEXT, "cycle_seconds": _FLOAT,
    "verdict_json": _TEXT, "outcome_json": _TEXT,
}  # fmt: skip
"""Name -> type; what a spreadsheet wants first, the whole messages last."""
_COMPARED = ("object_index", "stroke", "decision", "code", "mean_error_mm", "max_error_mm", "wear_mm", "coverage")
_AT_ONCE = 1000


def row_of(number: int, cycle: Cycle) -> dict[str, Any]:
    """One row of a file."""
    assert cycle.verdict is not None
    told: dict[str, Any] = {"told_code": None, "told_utc": None, "cycle_seconds": None}
    if cycle.outcome is not None:
        told = told_of(cycle.outcome)
        if told["told_utc"] is not None:
            told["told_utc"] = told["told_utc"].isoformat(timespec="milliseconds")
    found = {
        "record": number,
        "utc": cycle.utc.isoformat(timespec="milliseconds"),
        "monotonic_s": cycle.monotonic_s,
        **record_of(cycle.verdict),
        **told,
        "verdict_json": cycle.verdict.model_dump_json(),
        "outcome_json": "" if cycle.outcome is None else cycle.outcome.model_dump_json(),
    }
    return {name: found[name] for name in COLUMNS}


def write_csv(path: Path, rows: Iterable[dict[str, Any]]) -> int:
    """Write rows; returns how many. Empty = no value."""
    count = 0
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(COLUMNS))
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {k: "" if v is None else str(v).lower() if isinstance(v, bool) else v for k, v in row.items()}
            )
            count += 1
    return count


def write_parquet(path: Path, rows: Iterable[dict[str, Any]]) -> int:
    """Write rows in groups; returns how many."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {_TEXT: pa.string(), _INT: pa.int64(), _FLOAT: pa.float64(), _BOOL: pa.bool_()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    count = 0
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for group in _groups(rows):
            writer.write_table(pa.Table.from_pylist(group, schema=schema))
            count += len(group)
    return count


def _groups(rows: Iterable[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    group: list[dict[str, Any]] = []
    for row in rows:
        group.append(row)
        if len(group) == _AT_ONCE:
            yield group
            group = []
    if group:
        yield group


def read_cycles(path: Path) -> list[Cycle]:
    """All cycles of a file, checked.

    Raises:
        RecordError: no such file, a column is missing, or a row is not what a cell wrote; the row is named.
    """
    try:
        rows = list(_parquet(path) if path.suffix == ".parquet" else _csv(path))
    except (OSError, ValueError, csv.Error) as error:
        raise RecordError(
            f"cannot be read ({' '.join(str(error).split())})", str(path), "name a file of 'wearline export'"
        ) from error
    cycles: list[Cycle] = []
    seen: set[str] = set()
    for number, row in enumerate(rows, 2 if path.suffix != ".parquet" else 1):
        where = f"{path}, row {number}"
        cycle = _cycle(row, where)
        if cycle.cycle_id in seen:
            raise RecordError(f"cycle {cycle.cycle_id} is there twice", where, "remove one; nothing was imported")
        seen.add(cycle.cycle_id)
        cycles.append(cycle)
    return cycles


def _cycle(row: dict[str, Any], where: str) -> Cycle:
    def wrong(what: str) -> RecordError:
        return RecordError(what, where, "export it again; nothing was imported")

    try:
        verdict = Verdict.model_validate_json(row["verdict_json"])
        outcome = Outcome.model_validate_json(row["outcome_json"]) if row["outcome_json"] else None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise wrong(f"{error.title} {place}: {first['msg']}") from error
    try:
        utc, monotonic_s = datetime.fromisoformat(str(row["utc"])), float(row["monotonic_s"])
    except ValueError as error:
        raise wrong(f"utc or monotonic_s is none ({error})") from error
    if utc.tzinfo is None:
        raise wrong("utc has no time zone")
    if outcome is not None and outcome.cycle_id != verdict.cycle_id:
        raise wrong("verdict and outcome are of different cycles")
    made = record_of(verdict)
    for name in _COMPARED:
        if str(made[name] if made[name] is not None else "") != str(row[name] if row[name] is not None else ""):
            raise wrong(f"{name} is {row[name]}, its verdict says {made[name]}")
    return Cycle(verdict, outcome, utc, monotonic_s)


def _csv(path: Path) -> Iterator[dict[str, Any]]:
    csv.field_size_limit(1 << 24)
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file, strict=True)
        _check_columns(reader.fieldnames or ())
        for row in reader:
            if None in row or None in row.values():
                raise ValueError(f"line {reader.line_num} has another number of columns")
            yield row


def _parquet(path: Path) -> Iterator[dict[str, Any]]:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        _check_columns(file.schema_arrow.names)
        for batch in file.iter_batches(_AT_ONCE):
            yield from batch.to_pylist()


def _check_columns(found: Iterable[str]) -> None:
    missing = [name for name in COLUMNS if name not in set(found)]
    if missing:
        raise ValueError(f"it has no column {missing[0]}")
