"""Several replicas of reconstruct: one measures, one stands by, and a frame that ends two of them ends no third."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import yaml

from tests.contract.conftest import Heard, free_port
from tests.metrology.chains import comb_calibration
from tests.metrology.renderer import Comb, draw, plate
from wearline.bus import Bus, open_router
from wearline.config import load_cell
from wearline.messages import Frame, LinePoints, Message
from wearline.offline import Chain
from wearline.topics import ARTIFACT, LINE_POINTS, RECIPE
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.core.ranking import ranked
from wearline_reconstruct.drivers.artifact_cache import ArtifactCache
from wearline_reconstruct.service import Reconstruct

NAMES = ("a", "b", "c")
PLATES = (0.0, 0.0, 3.0, 3.0, 6.0, 6.0)


def black(cycle_id: str) -> Frame:
    """A frame that is refused at once: who answers is what counts here."""
    return Chain().frame(np.zeros((8, 8), np.uint8)).replace(cycle_id=cycle_id)


class Replicas:
    """Services that hear all that any of them says, on a clock that stands still."""

    def __init__(self, names: Iterable[str] = NAMES) -> None:
        self.now_s = 100.0
        self.services: dict[str, Reconstruct] = {}
        self.said: list[tuple[str, str]] = []
        for name in names:
            service = Reconstruct("test", ReconstructSettings(), ArtifactCache(None), clock=lambda: self.now_s)
            list(service.start(Chain()))
            service.instance = name
            self.services[name] = service
        self.tell_alive()

    def tell_alive(self) -> None:
        for name in tuple(self.services):
            self._take(name, self.services[name].on_replicas(frozenset(self.services)))

    def _take(self, name: str, messages: Iterable[Message]) -> None:
        for message in messages:
            if isinstance(message, LinePoints):
                self.said.append((name, message.cycle_id))
                for other, service in self.services.items():
                    if other != name:
                        list(service.on_line_points(message))

    def show(self, cycle_id: str, deaf: str = "") -> None:
        """The frame reaches all of them before the first answer does."""
        answers = [(name, list(s.on_frame(black(cycle_id)))) for name, s in self.services.items() if name != deaf]
        for name, messages in answers:
            self._take(name, messages)

    def later(self, seconds: float) -> None:
        self.now_s += seconds
        for name, service in tuple(self.services.items()):
            self._take(name, service.tick(self.now_s))


def test_each_frame_is_measured_once_and_the_load_spreads() -> None:
    replicas = Replicas()
    cycles = [f"cycle-{n}" for n in range(60)]
    for cycle in cycles:
        replicas.show(cycle)
    replicas.later(10.0)
    assert [cycle for _, cycle in replicas.said] == cycles
    shares = [sum(name == who for who, _ in replicas.said) for name in NAMES]
    assert min(shares) >= 10, shares


def test_the_second_steps_in_when_the_first_is_late() -> None:
    replicas = Replicas()
    first, second, _ = ranked("x", NAMES)
    replicas.show("x", deaf=first)
    replicas.later(0.3)
    assert replicas.said == []
    replicas.later(0.2)
    assert replicas.said == [(second, "x")]
    replicas.later(10.0)
    assert len(replicas.said) == 1


def test_the_second_steps_in_at_once_when_the_first_goes() -> None:
    replicas = Replicas()
    first, second, _ = ranked("x", NAMES)
    replicas.show("x", deaf=first)
    del replicas.services[first]
    replicas.tell_alive()
    assert replicas.said == [(second, "x")]


def test_nobody_steps_in_for_the_second() -> None:
    replicas = Replicas()
    first, second, _ = ranked("x", NAMES)
    replicas.show("x", deaf=first)
    del replicas.services[first], replicas.services[second]
    replicas.tell_alive()
    replicas.later(10.0)
    assert replicas.said == []


def test_only_the_cycles_of_the_one_that_went_move() -> None:
    before = {f"c{n}": ranked(f"c{n}", NAMES)[0] for n in range(100)}
    after = {cycle: ranked(cycle, ("a", "b"))[0] for cycle in before}
    assert all(after[cycle] == who for cycle, who in before.items() if who != "c")


def test_alone_it_measures_every_frame_even_before_it_hears_its_own_token() -> None:
    replicas = Replicas(("a",))
    list(replicas.services["a"].on_replicas(frozenset()))
    replicas.show("x")
    assert replicas.said == [("a", "x")]


def test_a_hung_replica_in_a_process_of_its_own_costs_no_frame(tmp_path: Path) -> None:
    comb = Comb()
    chain = Chain(calibration=comb_calibration(comb, PLATES))
    picture = draw(comb, plate(2.0), 70)[0]
    path = tmp_path / "cell.yaml"
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    path.write_text(yaml.safe_dump({"cell": "c1", "data_dir": ".", "router": {"endpoint": endpoint}}))
    router = open_router(load_cell(path))
    judge, capture, alive, heard = Bus("c1", "judge", endpoint), Bus("c1", "capture", endpoint), Heard(), Heard()
    command = [sys.executable, "-m", "wearline", "run", "reconstruct", "--config", str(path)]
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for bus in (judge, capture):
            bus.open(timeout_s=10.0)
        judge.answer(RECIPE, lambda question: chain.ask(RECIPE, question))
        judge.answer(ARTIFACT, lambda question: chain.ask(ARTIFACT, question))
        judge.subscribe(LINE_POINTS, lambda points: heard(points.cycle_id))
        capture.watch_alive(alive)
        processes += [subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) for _ in range(2)]
        live = alive.wait_for(lambda items: bool(items) and len(items[-1][1]) == 2, within_s=30.0)[-1][1]
        hung = next(iter(sorted(live)))
        ours = [n for n in range(40) if ranked(f"cycle-{n}", live)[0] == hung][:2]
        assert len(ours) == 2
        cycles = [f"cycle-{n}" for n in ours]
        capture.publish(chain.frame(picture).replace(cycle_id=cycles[0]))
        heard.wait_for(lambda items: items == cycles[:1])
        os.kill(int(hung.split("-")[0]), signal.SIGSTOP)
        capture.publish(chain.frame(picture).replace(cycle_id=cycles[1]))
        heard.wait_for(lambda items: items == cycles, within_s=2.0)
    finally:
        for process in processes:
            process.kill()
            process.wait()
        judge.close()
        capture.close()
        router.close()  # type: ignore[no-untyped-call]
