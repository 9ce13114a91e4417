"""`codesign design grasp`: figures of a grasp, and exit codes that mean something."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_design.design_file import write_stl
from codesign_design.experts import flat_pad


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["design", "grasp", *arguments])
    return result.exit_code, result.stdout, result.stderr


def test_a_finger_from_a_file_picks_tofu_up(tmp_path: Path) -> None:
    write_stl(tmp_path / "mine.stl", flat_pad(width=0.05))
    options = ("--tetrahedra", "600", "--grasps", "1", "--tighter", "0.3", "--json")
    code, out, _ = run(str(tmp_path / "mine.stl"), *options)
    (row,) = json.loads(out)["fingers"]
    assert code == 0
    assert (row["name"], row["succeeded"], row["grasps"]) == ("mine", 1, 1)
    assert 100 < row["held_median_pa"] < row["held_top10_pa"] <= row["peak_top10_pa"] < 2000


def test_a_dropped_block_shows_in_the_exit_code() -> None:
    code, out, _ = run("stock", "--tetrahedra", "600", "--grasps", "1", "--tighter", "-2", "--json")
    assert code == 1
    assert json.loads(out)["fingers"][0]["succeeded"] == 0


@pytest.mark.parametrize(
    ("name", "said"), [("spoon.stl", "spoon.stl"), ("spoon.json", "spoon.json")]
)
def test_a_missing_file_is_named(name: str, said: str) -> None:
    code, out, err = run(name)
    assert (code, out) == (2, "")
    assert said in err
