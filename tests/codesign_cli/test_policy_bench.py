"""`codesign policy bench`."""

import json
from dataclasses import replace
from functools import partial

import pytest
from typer.testing import CliRunner

from codesign_cli.main import app
from codesign_policy import presets, training_bench
from codesign_policy.training_bench import TrainingRate


@pytest.fixture(autouse=True)
def small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, preset in presets.PRESETS.items():
        small = replace(preset, hidden=(8,), batch_size=32, design_rows=4)
        monkeypatch.setitem(presets.PRESETS, name, small)
    one_round = partial(training_bench.measure_training, rounds=1, lanes=8)
    monkeypatch.setattr(training_bench, "measure_training", one_round)


def test_bench_prints_json_alone() -> None:
    result = CliRunner().invoke(app, ["policy", "bench", "--seconds", "0.1", "--json"])
    assert result.exit_code == 0
    results = json.loads(result.stdout)
    rates = {rate["preset"]: rate for rate in results["rates"]}
    assert set(rates) == {"published", "fast"}
    for name, ratio in (("published", 20.0), ("fast", 0.25)):
        rate = rates[name]
        assert rate["updates"] > 0
        per_second = rate["updates_per_cpu_second"]
        assert rate["cpu_ms_per_update"] == pytest.approx(1e3 / per_second)
        assert rate["transitions_per_cpu_second"] == pytest.approx(per_second / ratio)
    training = results["training"]
    assert training["environment_steps_per_second"] > 0.0
    shares = [training[name] for name in ("simulation", "updates", "rest")]
    assert sum(shares) == pytest.approx(1.0)
    assert min(shares) > 0.0


def test_bench_prints_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    rate = TrainingRate("fast", "wide-12", 8, 1, 250.0, 0.3, 0.6, 0.1)
    monkeypatch.setattr(training_bench, "measure_training", lambda: rate)
    result = CliRunner().invoke(app, ["policy", "bench", "--seconds", "0.1"])
    assert result.exit_code == 0
    assert "published" in result.stdout
    assert "updates/CPU s" in result.stdout
    assert "250 environment steps/s" in result.stdout
