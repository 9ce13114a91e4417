"""What `codesign demo` refuses, before it starts or replaces anything."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from codesign_cli.main import app

runner = CliRunner()


def test_a_folder_that_is_no_run_of_ours_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "thesis.txt"
    precious.write_text("final")
    result = runner.invoke(app, ["demo", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "is not empty and no run of ours" in result.output
    assert precious.read_text() == "final"


@pytest.mark.parametrize("command", [["demo"], ["graph", "up"], ["graph", "bench"]])
def test_without_the_workspace_the_remedy_is_named(
    command: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(app, command)
    assert result.exit_code == 2
    assert "make setup" in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", [["--trials", "0"], ["--seed", "-1"]])
def test_numbers_out_of_range_are_refused(option: list[str]) -> None:
    result = runner.invoke(app, ["demo", *option])
    assert result.exit_code == 2
    assert option[0] in result.output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--policy", "nobody"], "'nobody': unknown; there are scripted, codesign, original"),
        (["--policy", "scripted", "--policy", "scripted"], "two would be labelled the same"),
    ],
)
def test_policies_are_checked_first(
    options: list[str], words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("codesign_cli.demo.bringup_command", lambda: ["false"])
    result = runner.invoke(app, ["demo", "--out", str(tmp_path / "run"), *options])
    assert result.exit_code == 2
    assert words in result.output
    assert list(tmp_path.iterdir()) == []


def test_help_names_every_command() -> None:
    result = runner.invoke(app, ["--help"])
    assert result.exit_code == 0
    for name in ("demo", "report", "bag", "control", "graph", "sim"):
        assert name in result.output
