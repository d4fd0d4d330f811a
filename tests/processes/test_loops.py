import itertools
from collections.abc import Iterator
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.clock import DOUBTED_S, WallClock
from firmware.executive import Executive, Task
from firmware.follower.core import FollowerCore
from firmware.follower.loop import FollowerLoop
from firmware.follower.settings import FollowerSettings
from firmware.leader.worker import ThreadWorker
from firmware.ports import ModemPort, SensorPort, SensorStep
from firmware.soundings import Odometry, Ping
from firmware.vehicle_loop import VehicleLoop, Work
from host_tools.mission import deployed
from host_tools.nodes import FollowerNode
from host_tools.processes import vehicle as vehicle_process
from host_tools.scenario import named_scenario
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.acoustics import Delivery, Water, WaterSettings
from protocol.modems.base import ModemStatus
from protocol.modems.loopback import LoopbackMedium, LoopbackModem
from protocol.schedule import Slots, SlotSettings
from protocol.settings import replace


def odometry(time_s: float) -> Odometry:
    return Odometry(
        time_s=time_s,
        velocity_north_mps=1.0,
        velocity_east_mps=0.0,
        yaw_rad=0.0,
        depth_m=10.0,
    )


class Notebook:
    def __init__(self) -> None:
        self.times_s: list[float] = []

    def receive_odometry(self, odometry: Odometry) -> None:
        self.times_s.append(odometry.time_s)

    def receive_ping(self, ping: Ping) -> None:
        raise AssertionError(f"there is no {ping}")


def loopback() -> tuple[list[Delivery], LoopbackModem]:
    water = Water(
        WaterSettings(loss=0.0), np.random.default_rng(1), lambda node, _: (100.0 * node, 0.0, 0.0)
    )
    deliveries: list[Delivery] = []
    return deliveries, LoopbackMedium(water, deliveries.append).modem(1)


def test_sensors_are_fed_up_to_now_and_no_further() -> None:
    steps: Iterator[SensorStep] = ((odometry(k * 0.25), None) for k in range(9))
    port, core = SensorPort(steps), Notebook()
    port.feed(core, 0.5)
    assert core.times_s == [0.0, 0.25, 0.5]
    port.feed(core, 0.6)
    assert core.times_s == [0.0, 0.25, 0.5]
    port.feed(core, 99.0)
    port.feed(core, 100.0)
    assert core.times_s == [k * 0.25 for k in range(9)]


class Sensor:
    """Gives steps as they are measured, four a second, and none in advance."""

    def __init__(self, stamps_s: list[float]) -> None:
        self._stamps_s, self._given, self.now_s = stamps_s, 0, 0.0

    def __iter__(self) -> "Sensor":
        return self

    def __next__(self) -> SensorStep:
        if self._given > 4 * self.now_s:
            raise StopIteration
        self._given += 1
        return odometry(self._stamps_s[self._given - 1]), None


@pytest.mark.parametrize("wild", [1, 16, 200])
@pytest.mark.parametrize("ahead_s", [3.0, 1e5, np.inf])
def test_stamps_from_the_future_end_with_the_sensors_error(wild: int, ahead_s: float) -> None:
    stamps_s = [0.25 * k + (ahead_s if 40 <= k < 40 + wild else 0.0) for k in range(400)]
    sensor, core = Sensor(stamps_s), Notebook()
    port = SensorPort(sensor)
    for quarter in range(400):
        sensor.now_s = quarter / 4
        port.feed(core, sensor.now_s)
    assert core.times_s[-(360 - wild) :] == stamps_s[40 + wild :]
    dropped = port.counters["steps_from_the_future"]
    assert len(core.times_s) + dropped == 400
    assert dropped == wild or ahead_s == 3.0


def test_steps_read_in_advance_are_not_lost_while_a_clock_is_set_back() -> None:
    steps: Iterator[SensorStep] = ((odometry(k * 0.25), None) for k in range(4000))
    port, core = SensorPort(steps), Notebook()
    for quarter in (*range(800), *range(40, 3000)):
        port.feed(core, quarter / 4)
    assert core.times_s == [k * 0.25 for k in range(3000)]
    assert not port.counters


def test_a_step_without_a_time_costs_none_of_those_before_it() -> None:
    stamps_s = [0.0, 5.0, 5.5, np.nan, 6.0]
    port, core = SensorPort((odometry(time_s), None) for time_s in stamps_s), Notebook()
    for quarter in range(40):
        port.feed(core, quarter / 4)
    assert np.array_equal(core.times_s, stamps_s, equal_nan=True)
    assert not port.counters


def test_what_goes_wrong_in_one_task_does_not_stop_the_others(
    caplog: pytest.LogCaptureFixture,
) -> None:
    ran: list[str] = []

    def fail(now_s: float) -> None:
        raise ValueError(f"at {now_s}")

    executive = Executive(
        (
            Task(name="bad", period_s=1.0, deadline_s=1.0, work=fail),
            Task(name="good", period_s=1.0, deadline_s=1.0, work=lambda _: ran.append("good")),
        ),
        lambda: 0.0,
    )
    executive.step(0.0)
    assert ran == ["good"]
    assert executive.counters == {"bad_failed": 1}
    assert "bad failed at 0.000 s" in caplog.text


def test_a_task_that_fails_all_day_is_counted_and_told_once_a_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(now_s: float) -> None:
        raise ValueError(f"at {now_s}")

    executive = Executive(
        (Task(name="bad", period_s=0.25, deadline_s=1.0, work=fail),), lambda: 0.0
    )
    for quarter in range(4 * 600):
        executive.step(quarter / 4)
    assert executive.counters == {"bad_failed": 2400}
    assert len(caplog.records) == 10


def test_tasks_keep_their_periods_and_late_ones_are_counted() -> None:
    ran: list[float] = []
    clock = iter([0.0, 0.1, 10.0, 10.5, 20.0, 20.1])
    executive = Executive(
        (Task(name="slow", period_s=1.0, deadline_s=0.2, work=ran.append),), lambda: next(clock)
    )
    for now_s in (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0):
        executive.step(now_s)
    assert ran == [0.0, 1.0, 2.0]
    assert executive.counters == {"slow_overran": 1}


def test_a_clock_that_is_set_back_stops_no_task() -> None:
    ran: list[float] = []
    executive = Executive(
        (Task(name="work", period_s=1.0, deadline_s=1.0, work=ran.append),), lambda: 0.0
    )
    for now_s in (3600.0, 3601.0, 2.0, 2.5, 3.0):
        executive.step(now_s)
    assert ran == [3600.0, 3601.0, 2.0, 3.0]


def test_a_core_is_not_asked_for_frames_while_its_port_is_away() -> None:
    _, modem = loopback()
    asked: list[float] = []
    port = ModemPort(modem)
    up = ModemStatus(is_up=False)
    modem.status = lambda: up  # type: ignore[method-assign]
    port.speak(asked.append, now_s=1.0)
    assert asked == []
    up = ModemStatus(is_up=True)
    port.speak(asked.append, now_s=2.0)
    assert asked == [2.0]


@pytest.mark.parametrize(("lead_s", "start_s"), [(0.0, 1.0), (2.3, 4.0)])
def test_a_modem_is_told_how_late_the_loop_is(lead_s: float, start_s: float) -> None:
    stopwatch = [7.0]
    modem, asked = MagicMock(lead_s=lead_s, frames_per_packet=1), MagicMock()
    asked.poll.return_value = b"frame"

    class Slow(VehicleLoop):
        def _tasks(self) -> tuple[Work, ...]:
            return (("work", 1.0, self._work), ("speak", 1.0, self._speak))

        def _work(self, now_s: float) -> None:
            stopwatch[0] += 0.6 * now_s

    Slow(asked, modem, iter(()), lambda: stopwatch[0]).step(1.0)
    asked.poll.assert_called_once_with(start_s)
    modem.send.assert_called_once_with(b"frame", pytest.approx(1.6), start_s)
    modem.poll.assert_called_once_with(pytest.approx(1.6))


def test_the_loop_says_what_the_simulators_node_says() -> None:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 1.2, "beams": 24})
    site = place_survey(open_terrain(None), scenario, 1)
    vehicles = [SimulatedVehicle(scenario, site.seabed, 1, 1) for _ in range(2)]
    cores = [
        FollowerCore(
            1, 0, deployed(vehicle), settings=FollowerSettings(), slots=Slots(SlotSettings())
        )
        for vehicle in vehicles
    ]
    node = FollowerNode(cores[0], vehicles[0].steps())
    deliveries, modem = loopback()
    loop = FollowerLoop(cores[1], modem, vehicles[1].steps(), lambda: 0.0)
    expected = []
    for step in range(289):
        now_s = step * 0.25
        frame = node.tick(now_s)
        expected += [] if frame is None else [frame]
        loop.step(now_s)
    modem.poll(1e9)
    assert expected
    assert [delivery.frame for delivery in deliveries] == expected
    assert loop.status()["modem_sent"] == len(expected)
    assert not [name for name in loop.status() if name.endswith(("failed", "overran"))]


class Batch:
    sheet = type("Sheet", (), {"id": 7})

    def __init__(self, outcome: object) -> None:
        self.outcome = outcome

    def run(self) -> object:
        return self.outcome


def test_the_worker_takes_one_batch_at_a_time() -> None:
    worker = ThreadWorker()
    for outcome in ("a", "b"):
        batch = Batch(outcome)
        assert worker.is_free
        worker.give(batch)  # type: ignore[arg-type]
        assert not worker.is_free
        while not worker.is_free:
            finished = worker.take()
            if finished is not None:
                assert finished.findings == outcome
    worker.close()


def test_a_vehicle_whose_report_fails_sails_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    stepped: list[float] = []
    loop = type("Loop", (), {"step": staticmethod(stepped.append)})()
    monkeypatch.setattr(vehicle_process, "_report", full)
    aboard = vehicle_process.Aboard(loop, None, None, None, None)  # type: ignore[arg-type]
    vehicle_process._sail(aboard, iter([1.0, 1.25, 2.0]), on_wall=False)
    assert stepped == [1.0, 1.25, 2.0]
    assert "no space left on device" in caplog.text


class Wall:
    """A computer's clock in true time, wrong by what is set; it sleeps by a monotonic one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, utc_s: float) -> None:
        self.true_s = utc_s
        self.errors: list[tuple[float, float]] = []  # from when, how wrong
        monkeypatch.setattr("firmware.clock.time.clock_gettime", lambda _: self.utc_s)
        monkeypatch.setattr("firmware.clock.time.sleep", self.sleep)

    @property
    def utc_s(self) -> float:
        past = [wrong_s for from_s, wrong_s in self.errors if from_s <= self.true_s]
        return self.true_s + (past[-1] if past else 0.0)

    def sleep(self, wait_s: float) -> None:
        self.true_s += wait_s

    def ticks(self, clock: WallClock) -> Iterator[tuple[float, float]]:
        """Yield each tick with the true time at which it came; the work takes 10 ms."""
        for now_s in clock.ticks(0.25):
            yield now_s, self.true_s
            self.true_s += 0.01


def test_the_wall_clock_leaves_out_the_ticks_that_a_busy_loop_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = Wall(monkeypatch, 1000.0)
    clock = WallClock(start_utc_s=1000.25, end_s=2.0)
    seen = []
    for now_s, _ in wall.ticks(clock):
        seen.append(now_s)
        wall.true_s += 0.8 if now_s == 0.5 else 0.0
    assert seen == [0.0, 0.25, 0.5, 1.5, 1.75, 2.0]
    assert clock.status() == {"clock_ticks_skipped": 3, "clock_set_back": 0}


@pytest.mark.parametrize("back_s", [0.6, 120.0, 3600.0])
def test_a_wall_clock_that_is_set_back_goes_on_from_what_it_shows(
    monkeypatch: pytest.MonkeyPatch, back_s: float
) -> None:
    wall = Wall(monkeypatch, 10_000.0)
    wall.errors = [(10_010.1, -back_s)]
    clock = WallClock(start_utc_s=5000.0)
    came = list(itertools.islice(wall.ticks(clock), 80))
    apart_s = np.diff([true_s for _, true_s in came])
    assert apart_s.max() <= 0.75
    for now_s, true_s in came[42:]:
        assert now_s == pytest.approx(true_s - back_s - 5000.0, abs=0.02)
    assert clock.status() == {"clock_ticks_skipped": 0, "clock_set_back": 1}


def test_a_wall_clock_that_leaps_ahead_gives_no_burst_and_no_tick_of_the_past(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = Wall(monkeypatch, 1000.0)
    wall.errors = [(1005.1, 3600.0), (1006.0, 0.0)]
    clock = WallClock(start_utc_s=1000.0)
    came = list(itertools.islice(wall.ticks(clock), 60))
    for now_s, true_s in came:
        wrong_s = 3600.0 if 1005.1 <= true_s < 1006.0 else 0.0
        assert now_s == pytest.approx(true_s + wrong_s - 1000.0, abs=0.02)
    assert np.diff([true_s for _, true_s in came]).min() > 0.2
    assert clock.status() == {"clock_ticks_skipped": 4 * 3600, "clock_set_back": 1}


@pytest.mark.parametrize("from_s", [1005.1, 1005.255])  # while the loop sleeps, and while it works
def test_a_wall_clock_that_leaps_past_the_end_and_is_set_right_ends_nothing(
    monkeypatch: pytest.MonkeyPatch, from_s: float
) -> None:
    wall = Wall(monkeypatch, 1000.0)
    wall.errors = [(from_s, 1e8), (1010.0, 0.0)]
    seen = [now_s for now_s, _ in wall.ticks(WallClock(start_utc_s=1000.0, end_s=60.0))]
    assert seen[-1] == 60.0
    assert np.diff(seen).min() == 0.25
    assert np.diff(seen).max() < 6.0


def test_a_wall_clock_that_stays_past_the_end_ends_the_mission(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = Wall(monkeypatch, 1000.0)
    wall.errors = [(1005.1, 1e8)]
    seen = [now_s for now_s, _ in wall.ticks(WallClock(start_utc_s=1000.0, end_s=60.0))]
    assert seen[-1] == 5.0
    assert wall.true_s == pytest.approx(1005.0 + DOUBTED_S, abs=1.0)


def test_a_wall_clock_waits_for_the_start_and_for_a_clock_that_is_slewed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = Wall(monkeypatch, 1000.0)
    wall.errors = [(1100.0 + k, -0.001 * k) for k in range(10)]
    clock = WallClock(start_utc_s=1060.0, end_s=60.0)
    assert [now_s for now_s, _ in wall.ticks(clock)] == [k * 0.25 for k in range(241)]
    assert clock.status() == {"clock_ticks_skipped": 0, "clock_set_back": 0}
