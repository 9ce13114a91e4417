"""`codesign policy train`, `finetune`, `evaluate`, `export` and `show`, a round each."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_policy import presets
from codesign_policy.policy_file import load_pair


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Small networks, few updates: what is learned is not looked at."""
    small = replace(presets.FAST, hidden=(8,), batch_size=16, design_rows=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.PRESETS, "fast", small)
        yield


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["policy", *map(str, words)])


@pytest.fixture(scope="module")
def trained(quick: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the stock fingers, one round long."""
    out = tmp_path_factory.mktemp("runs") / "stock"
    done = run(
        "train", "--space", "stock", "--out", out, "--transitions", 1600, "--lanes", 8,
        "--practice", 4,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    return out


def test_a_run_keeps_what_made_it(trained: Path) -> None:
    files = {path.name for path in trained.iterdir()}
    assert files >= {
        "run.json",
        "checkpoint.pt",
        "history.csv",
        "curves.png",
        "policy.npz",
        "finger.png",
    }
    about = load_pair(trained / "policy.npz").about
    settings = json.loads((trained / "run.json").read_text())
    assert (about["space"], about["transitions"]) == ("", 1600)
    # Three grasps, and those of practice that succeeded.
    assert settings["demonstrations"] in range(600, 1401, 200)
    assert settings["commit"] == about["commit"]


def test_a_run_goes_on_with_a_larger_budget(trained: Path) -> None:
    done = run("train", "--out", trained, "--resume", "--transitions", 3200)
    assert done.exit_code == 0, done.output
    table = run("show", trained, "--json")
    (row,) = json.loads(table.stdout)["runs"]
    assert (row["transitions"], row["finished"], row["fingers"]) == (3200, True, "stock")


def test_a_run_is_not_overwritten(trained: Path) -> None:
    done = run("train", "--space", "stock", "--out", trained)
    assert done.exit_code == 2
    assert "--resume" in done.output


def test_a_policy_that_fails_cannot_be_fine_tuned(quick: None, tmp_path: Path) -> None:
    blind = tmp_path / "blind"
    done = run(
        "train", "--space", "stock", "--out", blind, "--transitions", 800, "--lanes", 4,
        "--without-demonstrations",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    done = run("finetune", blind, "--out", tmp_path / "tuned", "--tets", 600, "--lanes", 4)
    assert done.exit_code == 1
    assert "none of 4 episodes" in done.output
    assert not (tmp_path / "tuned" / "run.json").exists()


def test_an_evaluation_as_json(trained: Path) -> None:
    done = run(
        "evaluate", "--checkpoint", trained, "--episodes", 4, "--tets", 600, "--friction", 0.4,
        "--pose-error", 2, "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    wanted = {"success_rate", "top10_stress_pa", "median_stress_pa", "top10_std", "median_std",
              "score", "episodes"}  # fmt: skip
    assert wanted <= set(found)
    assert (found["episodes"], found["friction"], found["pose_error_m"]) == (4, [0.4, 0.4], 0.002)


def test_a_pair_is_exported(trained: Path, tmp_path: Path) -> None:
    done = run("export", trained, "--out", tmp_path / "pair")
    assert done.exit_code == 0, done.output
    written, own = (load_pair(folder / "policy.npz") for folder in (tmp_path / "pair", trained))
    assert written.about == own.about
    assert all((a == b).all() for a, b in zip(written.weights, own.weights, strict=True))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("train", "--out", "x", "--preset", "slow"), "presets are published, fast"),
        (("train", "--out", "x", "--space", "cube-9"), "cube-9"),
        (("train", "--out", "x", "--resume"), "no run of this release"),
        (("finetune", "nowhere", "--out", "x"), "nowhere: no run of this release"),
        (("evaluate", "--checkpoint", "nowhere"), "checkpoint 'nowhere'"),
        (("evaluate", "--pose-error", "40", "--checkpoint", "{trained}"), "pose_error is 0.04"),
        (("show", "nowhere"), "no history.csv"),
    ],
)
def test_bad_input_is_told(
    words: tuple[str, ...], message: str, trained: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    done = run(*(word.format(trained=trained) for word in words))
    assert done.exit_code == 2, done.output
    assert message in " ".join(done.output.split())
