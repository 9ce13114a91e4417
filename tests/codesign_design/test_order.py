"""Orders for fingers: what comes of them, and what is refused before anything is written."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from codesign_design.design_file import read_parameters
from codesign_design.design_space import design_space
from codesign_design.experts import expert, flat_pad
from codesign_design.finger_files import load_finger_pair
from codesign_design.finger_pair import TriangleMesh
from codesign_design.mesh_checks import volume_and_centre
from codesign_design.order import DesignOrder, deliver
from codesign_design.stock import stock_fingers


def test_an_expert_comes_with_files_that_hold_the_same_volume(tmp_path: Path) -> None:
    delivery = deliver(DesignOrder("flat_pad"), tmp_path)
    assert delivery.pair.content_hash == expert("flat_pad").content_hash
    assert json.loads(delivery.report)["content_hash"] == delivery.pair.content_hash
    folder = tmp_path / delivery.pair.content_hash[:16]
    assert list(delivery.files) == sorted(folder.iterdir())
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]
    assert load_finger_pair(folder).content_hash == delivery.pair.content_hash
    volume = volume_and_centre(delivery.pair.left)[0]
    for side in ("left", "right"):
        stored = trimesh.load(folder / f"{side}.stl")
        assert stored.volume * 1e-9 == pytest.approx(volume, rel=1e-5)  # mm, float32


def test_parameters_come_back_with_the_design(tmp_path: Path) -> None:
    values = tuple(np.linspace(-0.05, 0.05, 21))
    delivery = deliver(DesignOrder("mine", "box-7", values), tmp_path)
    assert (delivery.pair.name, delivery.pair.cage) == ("mine", "box-7")
    assert delivery.pair.parameters == values
    (path,) = (p for p in delivery.files if p.name == "parameters.json")
    space, stored = read_parameters(path)
    assert space.name == "box-7"
    np.testing.assert_array_equal(stored, values)


def test_the_same_order_gives_the_same_files(tmp_path: Path) -> None:
    order = DesignOrder(cage="box-7", parameters=(0.0,) * 21)
    assert deliver(order, tmp_path).files == deliver(order, tmp_path).files


def test_a_target_is_fitted_or_taken_as_it_is(tmp_path: Path) -> None:
    target = design_space("box-7").surface([0.0] * 21)
    as_it_is = deliver(DesignOrder("mine", "none", target=target), tmp_path).pair
    assert (as_it_is.cage, as_it_is.parameters) == ("", ())
    fitted = deliver(DesignOrder("mine", "box-7", target=target), tmp_path).pair
    assert fitted.cage == "box-7"
    # The target is in the space, so the fit finds nearly the same finger.
    volumes = [volume_and_centre(pair.left)[0] for pair in (as_it_is, fitted)]
    assert volumes[1] == pytest.approx(volumes[0], rel=0.05)


def test_the_stock_fingers_are_a_design_like_any_other(tmp_path: Path) -> None:
    delivery = deliver(DesignOrder("stock"), tmp_path)
    assert delivery.pair.content_hash == stock_fingers().content_hash
    assert json.loads(delivery.report)["valid"]


PAD = flat_pad()


@pytest.mark.parametrize(
    ("order", "said"),
    [
        (DesignOrder(), "neither parameters nor a target"),
        (DesignOrder("a\nb", parameters=(0.0,) * 21), "printable"),
        (DesignOrder(parameters=(0.0,) * 21, target=PAD), "leave one of them out"),
        (DesignOrder(target=TriangleMesh(PAD.vertices, PAD.faces[:3])), "3 triangles: must be 4"),
        (DesignOrder(target=TriangleMesh(PAD.vertices, PAD.faces[1:])), "not closed"),
        (DesignOrder(target=TriangleMesh(PAD.vertices * 1e3, PAD.faces)), "in metres"),
    ],
)
def test_what_is_refused_leaves_nothing_behind(
    order: DesignOrder, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=said):
        deliver(order, tmp_path / "out")
    assert not (tmp_path / "out").exists()
