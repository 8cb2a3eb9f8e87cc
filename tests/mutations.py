"""Break the product on purpose, one promise at a time, and see a test go red: ``make mutations``.

Each mutation replaces one piece of text in a copy of the tree and runs the tests that must object. A
mutation whose text is no longer found is an error too: the list must follow the code.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TIMEOUT_S = 300.0


@dataclass(frozen=True)
class Mutation:
    """One promise broken."""

    promise: str
    """What is broken, in words."""
    path: str
    old: str
    new: str
    tests: tuple[str, ...]
    """Arguments of pytest."""


RECONSTRUCT = "services/reconstruct/wearline_reconstruct"
JUDGE = "services/judge/wearline_judge"
FIELDBUS = "services/fieldbus/wearline_fieldbus"
HMI = "services/hmi/wearline_hmi"

MUTATIONS: tuple[Mutation, ...] = (
    Mutation(
        "two laser lines swap their numbers",
        f"{RECONSTRUCT}/core/chain.py",
        "line, along = number[keep], found.peaks.along[keep].astype(np.int64)",
        "line, along = np.array([*range(3), 4, 3, *range(5, 99)])[number[keep]], "
        "found.peaks.along[keep].astype(np.int64)",
        ("tests/metrology/test_heights.py", "tests/unit/reconstruct"),
    ),
    Mutation(
        "a service publishes under another's name",
        "wearline/bus.py",
        "if topic.publisher == service}",
        "if True}",
        ("tests/contract",),
    ),
    Mutation(
        "an unknown field of a message is accepted",
        "wearline/messages.py",
        'frozen=True, extra="forbid", use_attribute_docstrings=True, arbitrary_types_allowed=True',
        'frozen=True, extra="ignore", use_attribute_docstrings=True, arbitrary_types_allowed=True',
        ("tests/contract",),
    ),
    Mutation(
        "an array of another dtype is accepted",
        "wearline/messages.py",
        "if value.dtype != np.dtype(self.dtype):",
        "if False:",
        ("tests/contract",),
    ),
    Mutation(
        "fieldbus believes a verdict with another measure number",
        f"{FIELDBUS}/core/handshake.py",
        "lambda m: _of_cycle(m, lambda told, mine: told.measure_number == mine.measure_number)",
        "lambda m: True",
        ("tests/unit/fieldbus",),
    ),
    Mutation(
        "the PLC believes a result that echoes another measure number",
        f"{FIELDBUS}/core/soft_plc.py",
        'not self._settings.numbered or response["echo"] == self.measure_number',
        "True",
        ("tests/unit/fieldbus",),
    ),
    Mutation(
        "a request is published before it is in the journal",
        f"{FIELDBUS}/core/handshake.py",
        "self._out += [RecordAccepted(cycle), PublishRequest(cycle.request)]",
        "self._out += [PublishRequest(cycle.request), RecordAccepted(cycle)]",
        ("tests/unit/fieldbus/test_handshake.py",),
    ),
    Mutation(
        "to the PLC: a hung server holds an exchange for ever",
        f"{FIELDBUS}/drivers/s7.py",
        "        left_s = self.deadline_s - time.monotonic()\n",
        "        left_s = 5.0\n",
        ("tests/unit/fieldbus/test_s7.py",),
    ),
    Mutation(
        "to the PLC: what was meant for a lost connection is written on the next one",
        f"{FIELDBUS}/drivers/plc.py",
        "is_current = wanted.connection == self._connection",
        "is_current = True",
        ("tests/unit/fieldbus/test_s7.py",),
    ),
    Mutation(
        "to the PLC: a result is written after its time has gone",
        f"{FIELDBUS}/drivers/plc.py",
        "is_late = wanted.not_after_s is not None and self._clock() > wanted.not_after_s",
        "is_late = False",
        ("tests/unit/fieldbus/test_s7.py",),
    ),
    Mutation(
        "to the PLC: after a timeout the connection goes on",
        f"{FIELDBUS}/drivers/s7.py",
        '            self.close()\n            raise DeviceError(\n                f"DB{self._settings.db} {what}',
        '            raise DeviceError(\n                f"DB{self._settings.db} {what}',
        ("tests/unit/fieldbus/test_s7.py",),
    ),
    Mutation(
        "to the PLC: a torn line of the journal swallows the next one",
        f"{FIELDBUS}/drivers/journal.py",
        "            os.truncate(self._path(number), whole)\n",
        "            pass\n",
        ("tests/unit/fieldbus/test_journal.py",),
    ),
    Mutation(
        "to the PLC: a journal entry is not synced",
        f"{FIELDBUS}/drivers/journal.py",
        "            done += self._disk.write(self._file, content[done:])\n        self._disk.sync(self._file)\n",
        "            done += self._disk.write(self._file, content[done:])\n",
        ("tests/unit/fieldbus/test_journal.py",),
    ),
    Mutation(
        "to the PLC: bytes that somebody else wrote stay",
        f"{FIELDBUS}/core/handshake.py",
        '    "response_is_disturbed": _response_is_disturbed,\n',
        '    "response_is_disturbed": lambda m: False,\n',
        ("tests/unit/fieldbus/test_handshake.py",),
    ),
    Mutation(
        "to the PLC: a torn request of the extended profile is read",
        f"{FIELDBUS}/core/extended.py",
        'if asked["sequence"] != asked["sequence_end"]:',
        "if False:",
        ("tests/unit/fieldbus/test_extended.py",),
    ),
    Mutation(
        "to the PLC: the extended profile writes a result after three seconds",
        f"{FIELDBUS}/core/extended.py",
        "        self._result_token = self._write(start, block, not_after_s)\n",
        "        self._result_token = self._write(start, block, not_after_s + 10.0)\n",
        ("tests/unit/fieldbus/test_extended.py",),
    ),
    Mutation(
        "to the PLC: the function block takes the result of another part",
        f"{FIELDBUS}/core/tia.py",
        "#Wl.measure_finished AND WORD_TO_UINT(#Wl.echo) = #number",
        "#Wl.measure_finished",
        ("tests/unit/fieldbus/test_tia.py::test_the_function_block_believes_nothing_that_is_not_proven",),
    ),
    Mutation(
        "to the PLC: a Modbus client sets Passed",
        f"{FIELDBUS}/drivers/modbus_protocol.py",
        "    if start not in area.writable or start + count - 1 not in area.writable:\n",
        "    if 2 * (start + count) > len(area.image):\n",
        ("tests/unit/fieldbus/test_modbus.py",),
    ),
    Mutation(
        "to the PLC: pipelined Modbus requests are answered once",
        f"{FIELDBUS}/drivers/modbus.py",
        "                for frame in frames(received):\n                    client.sendall(",
        "                for frame in frames(received)[-1:]:\n                    client.sendall(",
        ("tests/unit/fieldbus/test_modbus.py",),
    ),
    Mutation(
        "to the PLC: a bouncing input counts",
        f"{FIELDBUS}/drivers/modbus_protocol.py",
        "            if times >= self._reads:\n",
        "            if True:\n",
        ("tests/unit/fieldbus/test_modbus.py",),
    ),
    Mutation(
        "a verdict is published before its record is written",
        f"{JUDGE}/service/judge.py",
        "        if self._recording is not None:\n            verdict = self._recording.verdict(verdict)\n"
        "        self._note(verdict.cycle_id)\n        yield verdict\n",
        "        yield verdict\n        if self._recording is not None:\n"
        "            verdict = self._recording.verdict(verdict)\n        self._note(verdict.cycle_id)\n",
        ("tests/unit/judge/test_service.py",),
    ),
    Mutation(
        "a simulated verdict is accepted from a real cell",
        f"{JUDGE}/service/judge.py",
        "if points.is_simulated and not self._accepts_simulated:",
        "if False:",
        ("tests/unit/judge/test_service.py",),
    ),
    Mutation(
        "a cycle is judged twice",
        f"{JUDGE}/service/judge.py",
        "if self._was_judged(points.cycle_id):",
        "if False:",
        ("tests/unit/judge/test_service.py",),
    ),
    Mutation(
        "a part that was measured by another recipe is judged",
        f"{JUDGE}/service/judge.py",
        "if points.recipe_hash != known.recipe_hash:",
        "if False:",
        ("tests/unit/judge/test_service.py",),
    ),
    Mutation(
        "a verdict that is not on disk is told as Passed",
        f"{JUDGE}/service/recording.py",
        "verdict = _unmeasured(verdict, ResultCode.DISK, str(error))",
        "pass",
        ("tests/unit/judge/test_service.py",),
    ),
    Mutation(
        "a cycle that was never judged gets no record",
        f"{JUDGE}/service/recording.py",
        "        self._append(Cycle(verdict, outcome, self._utc(), self._clock()))\n        return verdict\n",
        "        return verdict\n",
        ("tests/unit/judge/test_service.py",),
    ),
    Mutation(
        "an altered record is not found",
        f"{JUDGE}/drivers/chain.py",
        "if entry.digest != digest(number, entry.kind, entry.cycle_id, entry.utc, entry.body, previous):",
        "if False:",
        ("tests/unit/judge/test_records.py",),
    ),
    Mutation(
        "a chain that was made anew without the key is not found",
        f"{JUDGE}/drivers/chain.py",
        "if not hmac.compare_digest(expected, point.signature):",
        "if False:",
        ("tests/unit/judge/test_records.py",),
    ),
    Mutation(
        "a service of the die does not start its trend anew",
        f"{JUDGE}/drivers/records.py",
        "        if done.kind != _GOES_ON:\n            self._since[done.object_index] = number\n",
        "",
        ("tests/unit/judge/test_records.py",),
    ),
    Mutation(
        "frames of bad parts go before those of good ones",
        f"{JUDGE}/drivers/frames.py",
        "        for kind in Class:\n            kept = self._kept[kind]\n            while kept and used",
        "        for kind in reversed(Class):\n            kept = self._kept[kind]\n            while kept and used",
        ("tests/unit/judge/test_stores.py",),
    ),
    Mutation(
        "a suspicious golden frame is taken",
        f"{JUDGE}/core/teaching.py",
        "_check_fit(samples, found, settings, bool(scale))",
        "pass",
        ("tests/unit/judge/test_core.py",),
    ),
    Mutation(
        "a damaged backup is restored",
        f"{JUDGE}/drivers/backup.py",
        "if _sha256(staged / name) != expected:",
        "if False:",
        ("tests/unit/judge/test_archives.py",),
    ),
    Mutation(
        "a row that contradicts its verdict is imported",
        f"{JUDGE}/drivers/tables_io.py",
        'raise wrong(f"{name} is {row[name]}, its verdict says {made[name]}")',
        "pass",
        ("tests/unit/judge/test_archives.py",),
    ),
    Mutation(
        "a verdict that does not follow from its frame replays as equal",
        f"{JUDGE}/commands/replay.py",
        "return [] if recorded == computed else [",
        "return [] if recorded == computed or True else [",
        ("tests/unit/judge/test_commands.py",),
    ),
    Mutation(
        "a shift that the surface does not determine is believed",
        f"{JUDGE}/core/registration.py",
        "enough = sigmas <= (settings.shift_sigma_max_mm if is_in_mm else settings.shift_sigma_max_mm * 10.0)",
        "enough = sigmas <= np.inf",
        ("tests/metrology/test_judge_registration.py", "-k", "determine"),
    ),
    Mutation(
        "a part turned in plane stays turned",
        f"{JUDGE}/core/registration.py",
        "self.dx - self.turn * cells.y - self.tilt_y",
        "self.dx - self.tilt_y",
        ("tests/metrology/test_judge_registration.py", "-k", "pose6 or pose7"),
    ),
    Mutation(
        "a registration eats wear",
        f"{JUDGE}/core/registration.py",
        "    return inside * inside\n",
        "    return np.ones_like(inside)\n",
        ("tests/metrology/test_judge_registration.py", "-k", "wear"),
    ),
    Mutation(
        "what was not seen is compared",
        f"{JUDGE}/core/comparison.py",
        "enough = seen >= BLOCK_SEEN",
        "enough = seen >= 0",
        ("tests/metrology/test_judge_comparison.py", "-k", "not_seen"),
    ),
    Mutation(
        "noise is believed as stated, whatever neighbouring lines show",
        f"{JUDGE}/core/comparison.py",
        "(scatter - 1.0) * np.minimum(noise2, usual)",
        "0.0 * scatter",
        ("tests/metrology/test_judge_comparison.py", "-k", "uncertainty"),
    ),
    Mutation(
        "a forecast is given before the slope is known",
        f"{JUDGE}/core/forecast.py",
        "slope > settings.identifiable * slope_sigma",
        "slope > 0.0",
        ("tests/unit/judge/test_forecast.py",),
    ),
    Mutation(
        "a forecast forgets that rates change",
        f"{JUDGE}/core/forecast.py",
        "self._exponents, self._growth = exponents, rates * scale * reached",
        "self._exponents, self._growth = exponents, rates * 1e-9",
        ("tests/metrology/test_wear_forecast.py",),
    ),
    Mutation(
        "a chip is taken for wear",
        f"{JUDGE}/core/forecast.py",
        "found.append(Jump(int(strokes[at]), float(size[at]), sigma))",
        "pass",
        ("tests/unit/judge/test_forecast.py",),
    ),
    Mutation(
        "a change of coil restarts the trend",
        f"{JUDGE}/core/forecast.py",
        'RESTARTS = ("regrind", "polish", "insert", "die_change")',
        'RESTARTS = ("regrind", "polish", "insert", "die_change", "coil_change")',
        ("tests/unit/judge/test_forecast.py",),
    ),
    Mutation(
        "drift of the gauge is taken for wear",
        f"{JUDGE}/core/forecast.py",
        "die, die_sigma = whole - gauge,",
        "die, die_sigma = whole,",
        ("tests/unit/judge/test_forecast.py",),
    ),
    Mutation(
        "an alarm goes before anybody has seen it",
        f"{JUDGE}/core/alarms.py",
        "if level == alarm.level or alarm.needs_person:",
        "if level == alarm.level:",
        ("tests/unit/judge/test_alarms.py",),
    ),
    Mutation(
        "the wear map forgets the means it is about",
        f"{JUDGE}/core/wear_map.py",
        "strokes2=wear.strokes2 + has * from_stroke * (stroke - mean_stroke),",
        "strokes2=wear.strokes2 + has * from_stroke * from_stroke,",
        ("tests/unit/judge/test_wear_map.py",),
    ),
    Mutation(
        "Nelson's rule 5 forgets the side",
        f"{JUDGE}/core/charts.py",
        "np.count_nonzero(sign * three > 2.0) >= 2",
        "np.count_nonzero(np.abs(three) > 2.0) >= 2",
        ("tests/unit/judge/test_charts.py",),
    ),
    Mutation(
        "a CUSUM dates a change by its signal",
        f"{JUDGE}/core/charts.py",
        "return int(zeros[-1]) + 1 if zeros.size else 0",
        "return at",
        ("tests/unit/judge/test_charts.py",),
    ),
    Mutation(
        "a gauge with a bias is capable",
        f"{JUDGE}/core/capability.py",
        "(0.1 * tolerance_mm - abs(bias)) / (3.0 * sigma)",
        "(0.1 * tolerance_mm) / (3.0 * sigma)",
        ("tests/unit/judge/test_capability.py",),
    ),
    Mutation(
        "%GRR counts the parts in",
        f"{JUDGE}/core/capability.py",
        "grr = float(np.sqrt(within))",
        "grr = float(np.sqrt(between))",
        ("tests/unit/judge/test_capability.py",),
    ),
    Mutation(
        "a tilted plate is not flat",
        f"{JUDGE}/core/capability.py",
        "        residual = (cloud - centre) @ normal\n",
        "        residual = cloud[:, 2] - centre[2] + 0.0 * normal[2]\n",
        ("tests/unit/judge/test_capability.py",),
    ),
    Mutation(
        "a verdict whose outcome came first is not shown",
        f"{HMI}/core/state.py",
        "if state.verdict is not None and (index > 0 or",
        "if state.verdict is not None and (True or",
        ("tests/unit/hmi/test_state.py",),
    ),
    Mutation(
        "an old verdict stays green on the screen",
        f"{HMI}/core/words.py",
        'replace(sign, colour="grey") if is_stale else sign',
        "sign",
        ("tests/unit/hmi/test_words.py",),
    ),
    Mutation(
        "a lost service stays green on the screen",
        f"{HMI}/core/words.py",
        "if seen.is_alive is False or age_s > STATE_LOST_S:",
        "if False:",
        ("tests/unit/hmi/test_words.py",),
    ),
    Mutation(
        "operators may export production records",
        f"{HMI}/core/rights.py",
        "Item.PRODUCT_VIEW: (_V, _V, _V, _F)",
        "Item.PRODUCT_VIEW: (_V, _F, _V, _F)",
        ("tests/unit/hmi/test_rights.py",),
    ),
    Mutation(
        "an unknown name is told from a wrong password by its time",
        f"{HMI}/drivers/hashing.py",
        "self._argon2.verify(known or self._nobody, password) and known is not None",
        "known is not None and self._argon2.verify(known, password)",
        ("tests/unit/hmi/test_gate.py",),
    ),
    Mutation(
        "wrong passwords make nobody wait",
        f"{HMI}/core/passwords.py",
        "if failures <= FREE_TRIES or",
        "if True or",
        ("tests/unit/hmi",),
    ),
    Mutation(
        "polling keeps a forgotten session open",
        f"{HMI}/drivers/accounts.py",
        "if is_active and now_s - active_s > ACTIVITY_S:",
        "if now_s - active_s > ACTIVITY_S:",
        ("tests/unit/hmi/test_accounts.py",),
    ),
    Mutation(
        "a login keeps the session that was there before",
        f"{HMI}/pages/gate.py",
        "        if isinstance(visitor, Visitor) and visitor.session:\n"
        "            accounts.close_session(visitor.session)\n",
        "",
        ("tests/unit/hmi/test_gate.py",),
    ),
    Mutation(
        "another site may post for somebody",
        f"{HMI}/pages/shield.py",
        'return None if is_own_origin(origin, host) else "the request comes from another site"',
        "return None",
        ("tests/unit/hmi/test_shield.py",),
    ),
    Mutation(
        "a session that ended goes on as a viewer",
        f"{HMI}/pages/gate.py",
        "return None if found is None or found.session != visitor.session else found",
        "return found",
        ("tests/unit/hmi/test_gate.py",),
    ),
    Mutation(
        "a part id becomes a formula in a spreadsheet",
        f"{HMI}/core/table.py",
        "if text.lstrip()[:1] in",
        "if False and text.lstrip()[:1] in",
        ("tests/unit/hmi/test_events_tables.py",),
    ),
)


def is_noticed(mutation: Mutation) -> tuple[bool, str]:
    """Whether a test objects, and the first one that does."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        listed = subprocess.run(
            ["git", "ls-files", "-z", "wearline", "services", "tests", "deploy", "pyproject.toml"],
            cwd=ROOT, capture_output=True, check=True,
        ).stdout  # fmt: skip
        for name in listed.decode().split("\0"):
            source = ROOT / name
            if name and source.is_file():
                target = tree / name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read_bytes())
        broken = tree / mutation.path
        text = broken.read_text(encoding="utf-8")
        if text.count(mutation.old) != 1:
            raise SystemExit(f"{mutation.path}: found {text.count(mutation.old)} times: {mutation.old!r}")
        broken.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
        # Before what is installed, so that the broken copy is what runs; also in processes that a test starts.
        roots = [tree, *sorted((tree / "services").iterdir())]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, roots))}
        run = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", *mutation.tests],
            cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S,
        )  # fmt: skip
        first = next((line for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))), "")
        # 1: a test failed; anything else (no test found, a broken import) would prove nothing.
        return run.returncode == 1 and first.startswith("FAILED"), first.split(" - ")[0].removeprefix("FAILED ")


def main(argv: Sequence[str] | None = None) -> int:
    """Try every mutation whose promise contains the given word; 1 when one survives."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("word", nargs="?", default="")
    wanted = parser.parse_args(argv).word
    survivors = 0
    chosen = [mutation for mutation in MUTATIONS if wanted in mutation.promise]
    for mutation in chosen:
        noticed, first = is_noticed(mutation)
        survivors += not noticed
        print(f"{'red' if noticed else 'SURVIVES':<8}  {mutation.promise}\n          {first}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} mutations turned a test red")
    return 1 if survivors or not chosen else 0


if __name__ == "__main__":
    sys.exit(main())
