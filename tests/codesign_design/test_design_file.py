"""Files of finger design: what is written is read back."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from codesign_design.design_file import (
    read_parameters,
    read_surface,
    write_parameters,
    write_stl,
)
from codesign_design.design_space import design_space
from codesign_design.targets import target


def test_parameters_survive_to_the_last_digit(tmp_path: Path) -> None:
    space = design_space("torus-12")
    values = np.random.default_rng(0).uniform(-1, 1, 36)
    write_parameters(tmp_path / "p.json", space, values)
    read, again = read_parameters(tmp_path / "p.json")
    assert read is space
    assert np.array_equal(again, values)
    assert list(tmp_path.iterdir()) == [tmp_path / "p.json"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "for version 99 of sphere-7.*fit the target again"),
        ({"parameters": [0.0] * 20 + [3.0]}, "parameter 20 is 3"),
        ({"parameters": [0.0]}, r"shape \(1,\)"),
        ({"space": "cube-7"}, "no cage 'cube-7'"),
    ],
)
def test_files_that_do_not_fit_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    path = tmp_path / "p.json"
    content = {"space": "sphere-7", "version": 2, "parameters": [0.0] * 21}
    path.write_text(json.dumps(content | change))
    with pytest.raises(ValueError, match=message):
        read_parameters(path)


@pytest.mark.parametrize("text", ["", "[1, 2]", '{"space": "sphere-7"}'])
def test_files_of_another_kind_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "p.json"
    path.write_text(text)
    with pytest.raises(ValueError, match="is not a parameter file"):
        read_parameters(path)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("m", 1000.0), ("inch", 25.4)])
def test_stl_is_in_millimetres_and_read_in_the_unit_given(
    tmp_path: Path, unit: str, factor: float
) -> None:
    scoop = target("scoop")
    write_stl(tmp_path / "scoop.stl", scoop)
    on_file = trimesh.load(tmp_path / "scoop.stl")
    assert np.ptp(on_file.vertices[:, 2]) == pytest.approx(48.0, abs=1e-4)
    read = read_surface(tmp_path / "scoop.stl", unit)
    assert np.ptp(read.vertices[:, 2]) == pytest.approx(0.048 * factor, rel=1e-5)


def test_open_surfaces_and_other_files_are_refused(tmp_path: Path) -> None:
    sheet = trimesh.creation.box()
    sheet.update_faces(np.arange(len(sheet.faces)) > 0)
    sheet.export(tmp_path / "open.stl")
    with pytest.raises(
        ValueError, match=r"open\.stl is not closed: .* 3 are open and 0 belong to more"
    ):
        read_surface(tmp_path / "open.stl")
    (tmp_path / "text.stl").write_text("no surface")
    with pytest.raises(ValueError, match=r"text\.stl"):
        read_surface(tmp_path / "text.stl")
    with pytest.raises(ValueError, match="unit 'cm': choose from mm, m, inch"):
        read_surface(tmp_path / "open.stl", "cm")
    with pytest.raises(FileNotFoundError):
        read_surface(tmp_path / "missing.stl")
