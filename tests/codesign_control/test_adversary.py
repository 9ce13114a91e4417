"""Hostile actions break no limit: 10,000 here, a million by `codesign control adversarial`."""

import json
from pathlib import Path

from typer.testing import CliRunner

from codesign_cli.control import app
from codesign_control.driver import box_log


def test_10_000_hostile_actions_break_no_limit() -> None:
    result = CliRunner().invoke(app, ["adversarial", "--actions", "10000", "--seed", "1", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["violations"] == 0
    assert found["actions"] == 10_000 == found["actions_accepted"] + found["actions_rejected"]
    assert found["actions_rejected"] > 200  # NaN, infinite, huge, too short
    assert found["set_points"] > 1000
    assert found["slowest_stop_s"] <= 0.3
    # It is no proof unless the limits were met.
    met = {name for name, ticks in found["ticks_at_limit"].items() if ticks}
    assert {"JOINT", "SELF_COLLISION", "TABLE"} <= met
    worst = {limit["name"]: limit["worst"] for limit in found["limits"]}
    assert worst["joint jerk"] > 499.0
    assert worst["self distance"] < 0.02


def test_nor_do_10_000_through_the_driver_on_the_wire(tmp_path: Path) -> None:
    """Every limit of the servo holds for what goes out, and the box's log has nothing forbidden."""
    log = tmp_path / "box.jsonl"
    options = ["--actions", "10000", "--seed", "5", "--through", "driver", "--box-log", str(log)]
    result = CliRunner().invoke(app, ["adversarial", *options, "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["violations"] == found["wire_violations"] == 0
    assert found["actions"] == 10_000
    assert found["points_held"] == 0  # the last look before the SDK had nothing to stop
    assert found["points_on_the_wire"] > 1000
    reasons = {"not_finite", "wrong_length", "outside_limits", "too_fast", "stale", "wrong_clock"}
    assert {f"refused_{reason}" for reason in reasons} <= found.keys()
    worst = {limit["name"]: limit["worst"] for limit in found["limits"]}
    assert worst["joint jerk"] > 499.0
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(records) == found["points_on_the_wire"]
    assert box_log.violations(records) == []
    assert len({tuple(record["joints"]) for record in records}) > 1000  # it moves


def test_a_box_log_wants_a_wire(tmp_path: Path) -> None:
    options = ["--actions", "10", "--box-log", str(tmp_path / "box.jsonl")]
    result = CliRunner().invoke(app, ["adversarial", *options])
    assert result.exit_code == 2
    assert "--through driver" in result.output


def test_the_check_of_a_boxs_log_finds_what_is_wrong() -> None:
    def point(t: float, first: float, measured: float) -> dict[str, object]:
        return {
            "t": t,
            "command": "servo_j",
            "joints": [first, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            "measured": [measured, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
        }

    good = [point(0.0, 0.01, 0.0), point(0.01, 0.025, 0.0), {"t": 0.015, "command": "get_state"}]
    assert box_log.violations(good) == []
    for bad, said in (
        (point(0.02, 0.041, 0.0), "step of 0.0160 rad (next point)"),
        (point(0.02, 6.3, 0.0), "outside the joint limits"),
        (point(0.02, float("nan"), 0.0), "not finite"),
        (point(0.5, 0.025, 0.0), "step of 0.0250 rad (first point)"),
    ):
        assert said in box_log.violations([*good, bad])[0]
