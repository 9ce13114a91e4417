"""The simulated cell with an object of the user's own."""

from pathlib import Path

import meshio
import numpy as np
import pytest
from codesign_nodes.simulated_cell import CellConfig, SimulatedCell

from codesign_design.stock import stock_fingers
from codesign_policy.domain import draw_domain
from codesign_sim import Block


@pytest.fixture
def wedge(tmp_path: Path) -> tuple[Path, Block]:
    """A block in millimetres whose upper half narrows."""
    block = Block((0.05, 0.03, 0.04), (4, 3, 4))
    nodes = block.nodes.copy()
    nodes[:, 0] *= np.where(nodes[:, 2] > 0, 1 - 10 * nodes[:, 2], 1)
    path = tmp_path / "wedge.vtu"
    meshio.write(path, meshio.Mesh(1e3 * nodes, [("tetra", block.tetrahedra)]))
    return path, block


def test_an_own_object_rests_where_the_trial_puts_it(wedge: tuple[Path, Block]) -> None:
    path, block = wedge
    config = CellConfig(object_mesh=str(path), object_scale=1e-3)
    cell = SimulatedCell(config, stock_fingers())
    domain = draw_domain(1)
    cell.reset(domain)
    cell.tick(0.01)
    assert cell.simulator.tetrahedra.shape == block.tetrahedra.shape
    # Half the height narrows to 0.8 of the width: 0.95 of the volume is left.
    weight = 0.95 * block.volume * domain.density * 9.81
    assert cell.simulator.contact().table[0, 2] == pytest.approx(weight, rel=1e-3)
    centre = cell.simulator.object_pose()[0][0]
    assert centre[:2] == pytest.approx([domain.x, domain.y], abs=2e-4)


def test_a_bad_object_names_its_file(tmp_path: Path) -> None:
    config = CellConfig(object_mesh=str(tmp_path / "missing.msh"))
    with pytest.raises(ValueError, match=r"no mesh file .*missing\.msh"):
        SimulatedCell(config, stock_fingers())
