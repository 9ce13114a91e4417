"""`codesign sim`."""

import json

import pytest
from typer.testing import CliRunner

from codesign_cli.sim import app
from codesign_sim import bench, validation
from codesign_sim.kernels import vector_lanes
from codesign_sim.validation import Check


def invoke(*arguments):
    return CliRunner().invoke(app, list(arguments))


def test_validate_prints_json():
    result = invoke("validate", "--case", "rotation", "--case", "spin", "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["passed"] is True
    assert len(report["cases"]) == 3
    assert {"name", "expected", "measured", "tolerance", "unit", "passed"} <= set(
        report["cases"][0]
    )


def test_validate_prints_a_table():
    result = invoke("validate", "--case", "rotation")
    assert result.exit_code == 0
    assert "1 of 1 passed" in result.stdout


@pytest.fixture
def failing(monkeypatch):
    check = Check("wrong", 1.0, 2.0, 0.1, "Pa")
    monkeypatch.setitem(validation.CASES, "wrong", (lambda: [check], 0.1))


@pytest.mark.usefixtures("failing")
def test_validate_fails_with_a_failed_case():
    result = invoke("validate", "--case", "wrong", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["passed"] is False
    assert "0 of 1 passed" in invoke("validate", "--case", "wrong").stdout


def test_validate_names_an_unknown_case():
    result = invoke("validate", "--case", "nonsense")
    assert result.exit_code == 2
    assert "choose from squeeze" in result.output


@pytest.fixture
def quick_bench(monkeypatch):
    """The smallest case only: the rest is the same, and takes a minute."""
    monkeypatch.setattr(bench, "cases", lambda device, peer: [bench.Case("codesign", 600, 1, 1)])


@pytest.mark.usefixtures("quick_bench")
def test_bench_prints_rates():
    report = json.loads(invoke("bench", "--json", "--seconds", "0.1").stdout)
    (row,) = report["results"]
    assert (row["solver"], row["tets"], row["envs"], row["processes"]) == ("codesign", 600, 1, 1)
    assert row["control_steps_per_second"] > 0
    assert row["control_steps_per_cpu_second"] > 0
    assert report["machine"]["lanes"] >= 4


def test_bench_prints_a_table_and_the_ratio(monkeypatch):
    def result(solver, per_cpu):
        rate = bench.Rate(per_cpu, per_cpu - 1, per_cpu + 1)
        case = bench.Case(solver, 600, 1, 1)
        return bench.Result(case, rate, rate, 1e-3, 0.1, 0.0, True, False, 0, 5000)

    results = [result("codesign", 840.0), result("mujoco-flex", 40.0)]
    monkeypatch.setattr(bench, "run", lambda *arguments, **options: results)
    printed = invoke("bench", "--peer", "mujoco").stdout
    assert "600 tetrahedra: 21.0 times MuJoCo flex per CPU second" in printed
    assert "40 (39-41)" in printed
    assert "dropped" in printed
    report = json.loads(invoke("bench", "--peer", "mujoco", "--json").stdout)
    assert report["ratio_vs_mujoco_flex"] == 21.0


def test_bench_names_a_device_that_is_not_there(monkeypatch):
    case = bench.Case("codesign", 600, 1, 1, device="abacus")
    monkeypatch.setattr(bench, "cases", lambda device, peer: [case])
    result = invoke("bench", "--device", "abacus")
    assert result.exit_code == 2
    assert "abacus" in result.output


def test_sensitivity_prints_json():
    result = invoke("sensitivity", "--tets", "600", "--json")
    report = json.loads(result.stdout)
    assert report["names"] == ["width", "height", "edge radius", "offset", "tilt"]
    assert len(report["top10_gradient"]) == len(report["median_gradient"]) == 5
    assert report["lanes"] == 11
    assert "Pa/mm" in invoke("sensitivity", "--tets", "600").stdout


def test_sensitivity_names_what_is_wrong():
    result = invoke("sensitivity", "--tets", "600", "--width", "0.0299")
    assert result.exit_code == 2
    assert "drop the block" in result.output
    assert "choose one of" in invoke("sensitivity", "--tets", "601").output


def test_warm_up_reports_its_parts():
    result = invoke("warm-up")
    assert result.exit_code == 0
    parts = len(vector_lanes()) + 2
    assert f"[{parts}/{parts}] done" in result.output
