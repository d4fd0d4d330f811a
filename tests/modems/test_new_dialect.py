"""A dialect is one file and one line: the file is `hexline.py`, the line is in the fixture."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from host_tools.emulators.ptys import PseudoPort
from protocol.errors import ConfigError
from protocol.modems.base import Modem, Reception
from protocol.modems.registry import DIALECTS, open_modem


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DIALECTS, "hexline", "tests.modems.hexline:open_hexline")


class Pond:
    """Two ports whose modems hear each other at once, and a driver on each."""

    def __init__(self, folder: Path) -> None:
        self.ports = [PseudoPort(9600, folder / name) for name in ("a", "b")]
        self.drivers = [open_modem(f"hexline://{port.name}") for port in self.ports]
        self._lines = [bytearray(), bytearray()]
        self._now_s = 0.0

    def run(self, steps: int = 60) -> None:
        for _ in range(steps):
            self._now_s += 0.1
            for driver in self.drivers:
                driver.poll(self._now_s)
            time.sleep(0.001)  # the kernel hands bytes across a little later
            for k in range(2):
                self._answer(k)

    def _answer(self, k: int) -> None:
        self._lines[k] += self.ports[k].read()
        *lines, self._lines[k] = self._lines[k].split(b"\n")
        for line in lines:
            self.ports[k].write(b"!\n" if line == b"?" else b".\n")
            if line != b"?":
                self.ports[1 - k].write(bytes(line) + b"\n")


@pytest.fixture
def pond(tmp_path: Path) -> Iterator[Pond]:
    made = Pond(tmp_path)
    yield made
    for driver in made.drivers:
        driver.close()
    for port in made.ports:
        port.close()


def heard(driver: Modem) -> list[bytes]:
    return [e.frame for e in iter(driver.next_event, None) if isinstance(e, Reception)]


def test_frames_pass_over_a_dialect_of_one_file_and_one_line(pond: Pond) -> None:
    frames = [bytes([n]) * 256 for n in range(5)]
    for frame in frames:
        pond.drivers[0].send(frame, 0.0)
    pond.ports[1].write(b"\xff\x00 no hex\n")
    pond.run()
    assert heard(pond.drivers[1]) == frames
    assert pond.drivers[0].status().sent == 5
    assert pond.drivers[1].status().discarded == 1


def test_a_new_dialect_keeps_its_queue_over_a_pulled_port(pond: Pond) -> None:
    pond.run()
    pond.ports[0].unplug()
    pond.run()
    pond.drivers[0].send(b"kept", 0.0)
    pond.run()
    assert heard(pond.drivers[1]) == []
    pond.ports[0].plug()
    pond.run(200)
    assert heard(pond.drivers[1]) == [b"kept"]
    assert pond.drivers[0].status().reopened == 1


def test_options_that_a_new_dialect_does_not_know_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown option 'rate'; known are baud, queue_frames"):
        open_modem(f"hexline://{tmp_path}/x?rate=4")
