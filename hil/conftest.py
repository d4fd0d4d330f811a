"""Benches for the conformance suite: without hardware always, with hardware when it is named."""

import re
from collections.abc import Callable, Iterator

import pytest

from hil.benches import Bench, EmulatedBench, Ends, LoopbackBench, RealBench, SerialBench

KINDS = ("loopback", "serial", "micromodem", "nanomodem", "real")
COMMAND = (
    "pytest hil --modem-a 'micromodem:///dev/ttyUSB0?address=1'"
    " --modem-b 'micromodem:///dev/ttyUSB1?address=2'"
)
MUST_BE_ZERO = (
    "damaged_lines",
    "late",
    "undecodable",
    "settings_refused",
    "deaths",
    "failures",
    "clock_wrong",
)
"""Counters that no test of this suite may leave above zero."""

OpenEnds = Callable[..., Ends]


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("hil", "real modems on the bench")
    group.addoption("--modem-a", metavar="URL", help="the first modem, e.g. nanomodem:///dev/ttyA")
    group.addoption("--modem-b", metavar="URL", help="the second modem")


@pytest.fixture(
    params=[pytest.param(k, marks=pytest.mark.hil if k == "real" else ()) for k in KINDS]
)
def open_ends(request: pytest.FixtureRequest) -> Iterator[OpenEnds]:
    """Return a function that opens two ends, and hold their counters to zero afterwards."""
    opened: list[Ends] = []

    def open_them(loss: float = 0.0) -> Ends:
        opened.append(Ends(_bench(request, str(request.param), loss)))
        return opened[-1]

    yield open_them
    try:
        for ends in opened:
            assert_counters_are_clean(ends)
    finally:
        for ends in opened:
            ends.bench.close()


def assert_counters_are_clean(ends: Ends) -> None:
    for modem in ends.bench.modems:
        status = modem.status()
        assert (status.discarded, status.dropped_in, status.dropped_out) == (0, 0, 0), status
        wrong = {key: status.errors[key] for key in MUST_BE_ZERO if status.errors.get(key)}
        assert not wrong, f"{wrong}; notices: {dict(ends.notices)}"


def _bench(request: pytest.FixtureRequest, kind: str, loss: float) -> Bench:
    if kind == "loopback":
        return LoopbackBench(loss)
    if kind == "serial":
        return SerialBench()
    if kind != "real":
        return EmulatedBench(kind, loss)
    urls = [request.config.getoption(option) for option in ("--modem-a", "--modem-b")]
    if not all(isinstance(url, str) for url in urls):
        pytest.skip(f"no modems named; with two of them on the bench: {COMMAND}")
    found = [re.search(r"[?&]address=(\d+)", url) for url in urls]
    first, second = (int(match[1]) if match else 1 for match in found)
    if first == second:
        pytest.fail(f"both modems have address {first}; give each its own: {COMMAND}")
    return RealBench(urls[0], urls[1], second)
