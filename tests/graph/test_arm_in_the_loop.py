"""A real arm's driver, with the real SDK against the fake control box, and a simulated block.

The policy sees the block in rendered pictures only; the driver moves the arm; the fingers are where
the driver says that they are.
"""

import json
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import executable, load_profile

from codesign_control import Xarm7
from codesign_control.grasp_frame import start_posture
from codesign_control.gripper import GripperModel
from codesign_perception.camera import Camera
from codesign_perception.camera_file import save_camera
from codesign_report import read_trial, trial_metrics
from codesign_report.bag_outcome import read_outcome
from codesign_report.replay import replay
from tests.fake_box import FakeBox

LIMIT = 240.0  # s of one trial: rendering without a graphics card beside other tests

pytestmark = pytest.mark.timeout(600.0)


@pytest.fixture
def box() -> Iterator[FakeBox]:
    start = start_posture(Xarm7(), GripperModel(), 0.06)
    with FakeBox(joints=np.add(start, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).tolist()) as box:
        yield box


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """Where the profile's camera stands, with a quarter of its pixels: quick to render."""
    path = tmp_path / "camera.yaml"
    seen = Camera.looking_at(
        [0.80, 0.10, 0.27], [0.45, 0.0, 0.075], width=640, height=360, focal=500
    )
    save_camera(path, seen)
    return path


@pytest.fixture
def loop(box: FakeBox, camera: Path, tmp_path: Path) -> Iterator[Path]:
    """The profile, running; its folder."""
    settings = [
        f"xarm_driver.address={box.address}",
        f"simulated_camera.camera_file={camera}",
        f"tofu_pose_estimator.camera_file={camera}",
        "fem_simulator.tetrahedra=600",
    ]
    command = [
        str(executable("codesign_bringup", "bringup")), "arm_in_the_loop", "--quiet",
        "--log-folder", str(tmp_path / "logs"), *(p for s in settings for p in ("--set", s)),
    ]  # fmt: skip
    process = subprocess.Popen(command)
    yield tmp_path
    process.terminate()
    process.wait(30.0)


def person(*command: str) -> subprocess.CompletedProcess[str]:
    """What somebody at the arm types."""
    path = str(executable("codesign_bringup", command[0]))
    return subprocess.run([path, *command[1:]], capture_output=True, text=True, timeout=LIMIT)


def trial(out: Path, seed: int, *options: str) -> dict[str, Any]:
    """A trial's result, of an arm that somebody has enabled.

    Where a busy machine lets nodes stand still for 0.2 s the watchdogs rightly call it a fault,
    most of all while everything starts: no message came, or the driver paused and the arm fell
    behind. Then that somebody recovers and tries again. No other failure is tried again.
    """
    for attempt in range(5):
        if person("operate", "enable").returncode:
            time.sleep(2.0)
            continue
        folder = out / f"trial{seed}-{attempt}"
        said = person(
            "run_trials", "--count", "1", "--seed", str(seed), "--out", str(folder), *options
        )
        if said.returncode == 0:
            (result,) = json.loads((folder / "trials.json").read_text())["trials"]
            return result
        health = person("operate", "status").stdout
        if not re.search(r"ERROR +fault: (no (measured|fresh)|tracking error)", health):
            pytest.fail(said.stderr + health)
        person("operate", "recover")
    pytest.fail("the machine is too busy: every attempt ended in a watchdog's fault")


def test_the_policy_is_started_as_in_the_simulator() -> None:
    """The same node with the same parameters: only what is around it differs."""
    here, there = load_profile("arm_in_the_loop"), load_profile("sim_camera")
    policies = [profile["parameters"].get("policy", {}) for profile in (here, there)]
    for parameters in policies:
        parameters.pop("object_patience", None)  # wall time, in lockstep only
    assert policies[0] == policies[1] == {}
    assert set(there["nodes"]) | {"xarm_driver"} == set(here["nodes"])


def test_two_trials_on_an_arm_with_a_block_that_only_pictures_show(
    box: FakeBox, loop: Path
) -> None:
    results = [trial(loop, seed) for seed in (0, 1)]
    assert not box.violations()
    assert len(box.servo_points()[0]) > 1000
    for result in results:
        assert result["success"], result["message"]
        assert result["metrics"]["peak_lift"] == pytest.approx(0.1, abs=0.004)
        bag = Path(result["bag"])
        # Judged by the stress in the simulated block, live and from the bag alike.
        assert vars(trial_metrics(read_trial(bag))) == result["metrics"]
        assert read_outcome(bag).stress_known
        again = replay(bag)
        assert again.identical, again.first
        assert again.unknown == 0
        assert again.actions > 150
    first, second = (result["domain"] for result in results)
    assert first["x"] != second["x"]  # another block, put down under the arm


def test_the_co_designed_pair_on_the_arm(box: FakeBox, loop: Path) -> None:
    """Its fingers are made and put on first; then the same as with the scripted grasp."""
    result = trial(loop, 0, "--policy", "codesign")
    assert not box.violations()
    assert result["success"], result["message"]
    again = replay(Path(result["bag"]))
    assert again.identical, again.first
    assert again.unknown == 0
    assert again.actions > 100
