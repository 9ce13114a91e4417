"""Shared fingers and simulators."""

import pytest
from small_block import SMALL, around

from codesign_sim import Material, Simulator, SurfaceMesh


@pytest.fixture(scope="session")
def pads() -> tuple[SurfaceMesh, SurfaceMesh]:
    left = SurfaceMesh.box((-0.01, 0.0, -0.025), (0.01, 0.01, 0.025))
    right = SurfaceMesh.box((-0.01, -0.01, -0.025), (0.01, 0.0, 0.025))
    return left, right


@pytest.fixture
def floating() -> Simulator:
    """A block in empty space."""
    simulator = Simulator(SMALL, table_height=None, gravity=(0, 0, 0))
    simulator.reset(Material())
    return simulator


@pytest.fixture
def grasped(pads) -> Simulator:
    """A block squeezed by 4 mm and lifted by 10 mm."""
    simulator = Simulator(SMALL, pads)
    simulator.reset(Material(), fingers=around(0.034))
    simulator.advance(0.2, around(0.026))
    simulator.advance(0.2, around(0.026, height=0.036))
    return simulator


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory):
    """Tests start from an empty cache and leave the user's alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CODESIGN_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield
