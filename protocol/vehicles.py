"""How frames number the vehicles of a mission, and how files name them."""

LEADER = 0
"""Followers are 1 and up."""

VEHICLES = BOOT_EPOCHS = 16
"""The header has four bits each for the vehicle and its boot epoch."""


def name_of(vehicle: int) -> str:
    """Return a vehicle's name in files, messages and statuses: leader, follower_1, ..."""
    return "leader" if vehicle == LEADER else f"follower_{vehicle}"
