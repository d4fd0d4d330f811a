from dataclasses import replace

from firmware.leader.ranges import RangeSettings
from firmware.leader.ranging import Ranging
from tests.protocol.strategies import paper_packet


def test_frames_of_one_packet_give_one_range() -> None:
    ranging = Ranging(RangeSettings())
    header = replace(paper_packet().header, tx_second=8)
    for fragment in (0, 1):
        ranging.hold(1, replace(header, fragment=fragment), 8.4)
    ranging.hold(2, header, 8.4)  # another vehicle, though it can hardly be
    ranging.hold(1, header, 24.4)
    assert [held.chain for held in ranging._held] == [1, 2, 1]
    assert ranging.counters == {"ranges_of_one_packet": 1}
