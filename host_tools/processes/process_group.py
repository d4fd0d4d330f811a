"""All vehicles' processes: where they join, and the clock that is served to them in lock step."""

import contextlib
import select
import shutil
import socket
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

from host_tools.emulators.ptys import PseudoPort
from host_tools.processes.control import ControlLine, Done, End, Hello, Refused
from host_tools.processes.emulated_modems import EmulatedModems, ModemNode, address_of
from host_tools.processes.pace import Pace
from host_tools.processes.remote_node import RemoteNode
from host_tools.processes.served_clock import CLOCK_SCHEME
from protocol.acoustics import Water
from protocol.errors import ConfigError, RemoteProtocolError
from protocol.modems.serial_line import DEFAULT_BAUD
from protocol.vehicles import name_of

WAIT_S = 0.2
"""Of real time, between two looks at what else may have happened."""
PACED_WAIT_S, LATE_WAIT_S = 0.01, 0.0
BACKLOG = 8

OnWait = Callable[[Sequence[RemoteNode]], None]


class ProcessGroup:
    """Ports, control socket and nodes; the clock stands still while a process is down.

    on_wait is called now and then while processes are waited for, with those that are missing; it
    may raise to give up. With a pace time is real: nobody who is late or down is waited for.
    """

    def __init__(
        self,
        water: Water,
        mission: str,
        *,
        on_wait: OnWait,
        folder: Path | None = None,
        pace: Pace | None = None,
        modems: EmulatedModems | None = None,
    ) -> None:
        self.water, self.on_wait = water, on_wait
        self._mission, self._pace = mission, pace
        self._made = folder is None
        self.folder = Path(tempfile.mkdtemp(prefix="fathomlink-")) if folder is None else folder
        self._now_s = -1.0
        self._strangers: list[ControlLine] = []
        self._ended: set[int] = set()
        self._is_ending = False
        self._socket = self._listen()
        self._modems = modems
        self.nodes: dict[int, RemoteNode] = {}
        try:
            for vehicle in water.nodes:
                self.nodes[vehicle] = self._node(vehicle)
                self.nodes[vehicle].in_real_time = pace is not None
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "ProcessGroup":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def clock_url(self) -> str:
        """What a vehicle is given as --clock."""
        return f"{CLOCK_SCHEME}{self._socket_path}"

    def modem_url(self, vehicle: int) -> str:
        """Return what a vehicle is given as --modem."""
        scheme = "serial" if self._modems is None else self._modems.scheme
        options = "" if self._modems is None else f"?address={address_of(vehicle)}"
        return f"{scheme}://{self.nodes[vehicle].port.name}{options}"

    def missing(self) -> list[RemoteNode]:
        """Return the nodes whose processes are not there, and should be."""
        nodes = self.nodes.values()
        return [n for n in nodes if n.line is None and n.vehicle not in self._ended]

    def wait_for_all(self) -> None:
        """Wait until every vehicle's process is there."""
        while self.missing():
            self.look()

    def advance(self, now_s: float) -> None:
        """Serve a time to all processes at once: they work side by side."""
        if now_s != self._now_s:
            self._now_s = now_s
            for node in self.nodes.values():
                node.begin(now_s)

    def until_answered(self, node: RemoteNode) -> None:
        """Wait for a process's answer; while it is down, for it to come back."""
        is_over = False
        while not (node.is_answered or is_over):
            is_over = self._pace is not None and self._pace.is_over(self._now_s)
            self.look(LATE_WAIT_S if is_over else WAIT_S if self._pace is None else PACED_WAIT_S)

    def end(self) -> None:
        """Tell all processes that the mission is over, and wait for their files."""
        self._is_ending = True
        for node in self.nodes.values():
            if node.line is not None:
                node.line.send(End())
        while len(self._ended) < len(self.nodes):
            if self._pace is not None and len(self._ended) + len(self.missing()) == len(self.nodes):
                return
            self.look()

    def close(self) -> None:
        """Take the ports and the socket away."""
        for stranger in self._strangers:
            stranger.close()
        for node in self.nodes.values():
            node.leave()
            node.port.close()
        self._socket.close()
        self._socket_path.unlink(missing_ok=True)
        if self._made:
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def _socket_path(self) -> Path:
        return self.folder / "clock"

    def _node(self, vehicle: int) -> RemoteNode:
        baud = DEFAULT_BAUD if self._modems is None else self._modems.baud
        port = PseudoPort(baud, self.folder / name_of(vehicle).replace("_", "-"))
        drives = (self.advance, self.until_answered)
        if self._modems is not None:
            return ModemNode(vehicle, port, *drives, self._modems.bench.units[vehicle])
        return RemoteNode(
            vehicle, port, *drives, lambda: self._now_s >= self.water.transmitting_until_s(vehicle)
        )

    def _listen(self) -> socket.socket:
        with contextlib.ExitStack() as closing:
            listener = closing.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                if _is_left_behind(self._socket_path):
                    self._socket_path.unlink()
                listener.bind(str(self._socket_path))
            except OSError as error:
                raise ConfigError(
                    f"cannot make the clock's socket {self._socket_path}: {error}; "
                    "give --ports a short path to a folder of yours"
                ) from error
            listener.listen(BACKLOG)
            closing.pop_all()
        return listener

    def look(self, wait_s: float = WAIT_S) -> None:
        """Wait a moment for anything that a process says, and act on it."""
        lines = [n.line for n in self.nodes.values() if n.line is not None] + self._strangers
        waited: list[socket.socket | ControlLine] = [self._socket, *lines]
        ready = select.select(waited, [], [], wait_s)[0]
        if self._socket in ready:
            self._strangers.append(ControlLine(self._socket.accept()[0]))
        for node in self.nodes.values():
            if node.line is not None and node.line in ready:
                self._hear(node, node.line)
        for stranger in [line for line in self._strangers if line in ready]:
            self._meet(stranger)
        if not ready or self.missing():
            self.on_wait(self.missing())

    def _meet(self, stranger: ControlLine) -> None:
        """Let a new process join as the vehicle that it says it is."""
        self._strangers.remove(stranger)
        with contextlib.suppress(RemoteProtocolError):
            for message in stranger.receive():
                if isinstance(message, Hello):
                    reason = self._objection(message)
                    if reason is None:
                        self.nodes[message.vehicle].join(stranger)
                        if self._is_ending:
                            stranger.send(End())
                        return
                    stranger.send(Refused(reason=reason))
        stranger.close()

    def _objection(self, hello: Hello) -> str | None:
        node = self.nodes.get(hello.vehicle)
        if node is None:
            known = ", ".join(str(vehicle) for vehicle in self.nodes)
            return f"vehicle {hello.vehicle} is not in this mission; its vehicles are {known}"
        if node.line is not None or node.vehicle in self._ended:
            return f"{node.name} is already here; two vehicles need two numbers"
        if hello.mission != self._mission:
            return (
                f"{node.name} was started for another mission than the channel; give both the same "
                "--scenario, --terrain, --seed, --loss, --profile and --set"
            )
        return None

    def _hear(self, node: RemoteNode, line: ControlLine) -> None:
        try:
            messages = line.receive()
        except RemoteProtocolError:
            node.counters["control_errors"] += 1
            messages, line.is_open = [], False
        for message in messages:
            if isinstance(message, Done):
                node.answer(message)
            elif isinstance(message, End):
                self._ended.add(node.vehicle)
        if not line.is_open:
            node.leave()


def _is_left_behind(path: Path) -> bool:
    """Return whether a path is a socket at which nobody listens; ConfigError if somebody does."""
    if not path.is_socket():
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        try:
            line.connect(str(path))
        except OSError:
            return True
    raise ConfigError(f"a channel runs at {path.parent}; end it, or give --ports another folder")
