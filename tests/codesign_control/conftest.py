import pytest

from codesign_control import Xarm7


@pytest.fixture(scope="session")
def arm() -> Xarm7:
    return Xarm7()
