"""One link trial: faults, then quiet; what is believed is what was said, and all is well again."""

import numpy as np

from host_tools.faults.catalogue import plan_of
from host_tools.faults.computer import Program
from host_tools.faults.disk import Fate
from host_tools.faults.held import held_bytes
from host_tools.faults.link_programs import Ledger, LinkFollower, LinkLeader
from host_tools.faults.rig import RECOVERY_S, Outcome, Rig
from protocol.acoustics import WaterSettings
from protocol.modems.sealed import SealedModem
from protocol.schedule import Slots, SlotSettings

FIRST_S, SPAN_S = 45.0, 60.0
"""Faults begin within this of the trial, once the link has run for a sub-map."""
MOST_BYTES = 400_000
"""What queue, reassembly and seal of one vehicle may hold: ten transfers and as many events."""
LOOK_S = 60.0
EPOCHS = 16


class LinkTrial:
    """Both link programs under the plan of a seed."""

    def __init__(self, seed: int) -> None:
        self.plan = plan_of(seed, FIRST_S, SPAN_S)
        self.ledger = Ledger()
        self.most_bytes = 0
        self._slots = Slots(SlotSettings())
        self._rng = np.random.default_rng([seed, 0x11])
        self._lives = [0, 0]
        self.rig = Rig(
            seed,
            self.plan,
            WaterSettings(outlier_share=0.0),
            lambda vehicle, _: (600.0 * vehicle, 0.0, 10.0),
            self._start,
        )

    def run(self) -> Outcome:
        """Return what the trial came to."""
        return self.rig.outcome(self._sail, self._lost_fragments, self.ledger.violations)

    def _sail(self) -> float | None:
        """Return how long after the last fault a sub-map was complete and an answer heard."""
        last_s, now_s = self.plan.last_s, 0.0
        while now_s <= last_s + RECOVERY_S:
            self.ledger.now_s = now_s
            self.rig.step(now_s)
            if now_s % LOOK_S == 0.0:
                self._look()
            if now_s > last_s and min(self.ledger.completed_s, self.ledger.answered_s) > last_s:
                return now_s - last_s
            now_s += 1.0
        return None

    def _lost_fragments(self) -> list[str]:
        leader = self.rig.computers[0].program
        if isinstance(leader, LinkLeader):
            leader.reassembler.flush()
            leader.collect()
        lost = self.ledger.placed - self.ledger.closed
        return [f"{lost} accepted fragments came out of no transfer"] if lost else []

    def _look(self) -> None:
        for vehicle, computer in enumerate(self.rig.computers):
            program = computer.program
            if isinstance(program, LinkFollower):
                held = held_bytes(program.outbox, self.rig.links[vehicle])
            elif isinstance(program, LinkLeader):
                held = held_bytes(program.reassembler, self.rig.links[vehicle])
            else:
                continue
            self.most_bytes = max(self.most_bytes, held)
            if held > MOST_BYTES:
                self.ledger.violations.append(f"vehicle {vehicle} holds {held} bytes")

    def _start(self, vehicle: int, modem: SealedModem, _fate: Fate, _now_s: float) -> Program:
        epoch = self._lives[vehicle] % EPOCHS
        self._lives[vehicle] += 1
        if vehicle == 0:
            return LinkLeader(modem, self._slots, epoch, self.ledger)
        return LinkFollower(modem, self._slots, epoch, self._rng, self.ledger)


def link_trial(seed: int) -> Outcome:
    """Return the outcome of one seed."""
    return LinkTrial(seed).run()
