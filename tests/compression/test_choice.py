"""How many frames a sub-map is worth."""

import dataclasses

import pytest

from firmware.compression import compress
from firmware.compression.settings import CompressionSettings
from tests.compression.conftest import made_survey


def frames_for(noise_m: float = 0.15, **changes: float) -> int:
    settings = dataclasses.replace(CompressionSettings(), **changes)  # type: ignore[arg-type]
    return compress(made_survey(noise_m=noise_m).bins, settings, "auto").fragment_count


def test_noisy_soundings_are_worth_fewer_frames() -> None:
    assert frames_for(noise_m=1.0) < frames_for(noise_m=0.05) < 10


def test_more_loss_takes_more_frames() -> None:
    assert frames_for(expected_loss=0.3) > frames_for(expected_loss=0.0)


@pytest.mark.parametrize("most", [1, 2, 3])
def test_link_budget_is_kept(most: int) -> None:
    assert frames_for(noise_m=0.02, frames=most) <= most
