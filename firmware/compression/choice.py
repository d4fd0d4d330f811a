"""Which profile, and how many frames of it: no more of the water than the map is worth.

Measured (`python -m benchmarks.compression`): whatever the number of frames, `lattice` rebuilds
with the least error of the three, and unlike them gives some map from any two of its frames.
`paper` is for receivers that know the paper's packet only. What is left to choose is the number of
frames (`--profile auto`, aboard too), and that the sub-map's own code tells: how much error every
byte takes away, over the frames that may be lost, beside what the soundings leave unknown anyway.
"""

from firmware.compression.lattice import LatticeCode, chosen_protection, missing_m2
from firmware.compression.losses import arrival_chances
from firmware.compression.settings import CompressionSettings

_WORTH_IT = 1.1  # of the error of all frames at hand: what fewer may cost
_MAPS = 0.95  # share of sub-maps of which a map must arrive


def chosen_frames(code: LatticeCode, columns: int, most: int, settings: CompressionSettings) -> int:
    """Return the fewest frames, up to `most`, whose map is about as good as that of all.

    columns are the bytes of a frame that are left for the code; the loss to expect is in settings.
    """
    loss = settings.expected_loss
    nodes = code.field.frame.rows * code.field.frame.columns
    unknown_m2 = code.field.unknown_m2

    def error_m2(frames: int) -> float:
        protection = chosen_protection(code.progress, columns, frames, settings)
        return unknown_m2 + missing_m2(code.progress, protection, columns, frames, loss) / nodes

    enough_m2 = _WORTH_IT**2 * error_m2(most)
    for frames in range(1, most):
        fewest = min(settings.usable_frames, frames)
        none = sum(arrival_chances(frames, loss)[:fewest])
        if 1.0 - none >= _MAPS and error_m2(frames) <= enough_m2:
            return frames
    return most
