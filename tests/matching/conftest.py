import pytest

from tests.matching.scenes import Scene


@pytest.fixture
def scene() -> Scene:
    return Scene(seed=5)
