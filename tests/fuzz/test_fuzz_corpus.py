"""Every fuzz target on its corpus, and on a few thousand mutations of it."""

from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"


def corpus(target: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / target).iterdir())]


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_the_corpus_raises_nothing(target: str) -> None:
    inputs = corpus(target)
    assert inputs
    for data in inputs:
        TARGETS[target](data)


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_mutations_of_the_corpus_raise_nothing(target: str) -> None:
    rng = np.random.default_rng(1)
    inputs = corpus(target)
    for _ in range(300):
        data = bytearray(inputs[int(rng.integers(len(inputs)))][:1024])
        for _ in range(int(rng.integers(1, 6))):
            at = int(rng.integers(len(data) + 1))
            kind = int(rng.integers(4))
            if kind == 0:
                data[at:at] = rng.bytes(int(rng.integers(1, 20)))
            elif kind == 1:
                del data[at : at + int(rng.integers(1, 20))]
            elif kind == 2:
                data[at:at] = inputs[int(rng.integers(len(inputs)))][:64]
            elif at < len(data):
                data[at] ^= int(rng.integers(1, 256))
        TARGETS[target](bytes(data))
