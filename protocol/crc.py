"""CRC-32C, the last four bytes of every frame."""

from collections.abc import Callable
from typing import cast

import crcmod.predefined

CRC_BYTES = 4

crc32c = cast(Callable[[bytes], int], crcmod.predefined.mkCrcFun("crc-32c"))
"""Return the CRC-32C (Castagnoli) of some bytes; of b"123456789" it is 0xE3069283."""


def with_crc(body: bytes) -> bytes:
    """Return the body followed by its CRC, least significant byte first.

    In that order the bits of a frame, each byte's least significant first, form a codeword of the
    CRC's polynomial, so that every burst of up to 32 bits is caught, even one across the seam.
    """
    return body + crc32c(body).to_bytes(CRC_BYTES, "little")
