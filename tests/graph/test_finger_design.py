"""Fingers made on request while the graph runs, and trials with them."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import Graph, executable, load_profile
from rosbags.highlevel import AnyReader

from codesign_policy.domain import BLOCK_SIZE
from tests.conftest import Probe

SEED = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("designs")


@pytest.fixture(scope="module")
def running(folder: Path) -> Iterator[Probe]:
    """The simulated graph in lockstep at 600 tetrahedra, and somebody to ask it."""
    profile = load_profile("sim")
    settings = {
        "fem_simulator": {"tetrahedra": 600},
        "finger_design": {"output_dir": str(folder / "files")},
    }
    with Graph(folder / "logs", quiet=True) as graph:
        for node in profile["nodes"]:
            parameters = profile["parameters"].get(node, {}) | settings.get(node, {})
            graph.start(node, parameters, lockstep=True)
        probe = Probe()
        yield probe
        probe.close()


def order(probe: Probe, **fields: Any) -> Any:
    from codesign_interfaces.srv import GenerateDesign

    request = GenerateDesign.Request(**fields)
    return probe.call("/finger_design/generate_design", GenerateDesign, request, timeout=150.0)


def run_trial(out: Path, name: str) -> dict[str, Any]:
    """One trial in the graph that runs already."""
    command = [
        str(executable("codesign_bringup", "run_trials")), "--count", "1", "--seed", str(SEED),
        "--gripper", name, "--out", str(out), "--timeout", "200",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    (trial,) = json.loads((out / "trials.json").read_text())["trials"]
    return trial


def recorded(bag: Path, topic: str) -> list[Any]:
    with AnyReader([bag]) as reader:
        found = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(d, c.msgtype) for c, _, d in reader.messages(found)]


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("box", {"cage": "box-7", "parameters": [0.0] * 21}),
        ("scoop", {}),
    ],
)
def test_a_trial_runs_with_fingers_made_on_request(
    running: Probe, folder: Path, name: str, fields: dict[str, Any]
) -> None:
    from codesign_nodes.messages import design_from

    from codesign_policy.finger_plan import plan_for

    answer = order(running, name=name, **fields)
    assert answer.success, answer.message
    fingers = design_from(answer.design)
    assert fingers.content_hash == answer.design.content_hash
    report = json.loads(answer.report)
    assert report["valid"]
    assert report["content_hash"] == fingers.content_hash
    assert all(Path(path).is_file() for path in answer.files)
    assert {Path(path).name for path in answer.files} >= {"left.stl", "right.stl", "report.json"}

    trial = run_trial(folder / name, name)
    assert trial["success"], trial["message"]
    bag = Path(trial["bag"])
    assert {m.content_hash for m in recorded(bag, "/finger_design")} == {fingers.content_hash}
    closed = min(m.width for m in recorded(bag, "/gripper_state"))
    assert closed == pytest.approx(plan_for(fingers).width, abs=2e-4)
    if name == "box":
        keeps_the_bounds_of_side_grasps(recorded(bag, "/stress"), trial["domain"])


def keeps_the_bounds_of_side_grasps(stress: list[Any], domain: dict[str, float]) -> None:
    """What `codesign sim validate` asks of flat pads: friction needs a normal force of m g / 2 mu
    at least, and that a mean stress of rho g d / 2 mu."""
    weight = domain["density"] * float(np.prod(BLOCK_SIZE)) * 9.81
    held = [
        m for m in stress if m.left_force.z + m.right_force.z == pytest.approx(weight, rel=0.02)
    ]
    assert len(held) > 15
    normal = np.mean([abs(m.left_force.y) for m in held])
    assert normal > weight / (2 * domain["friction"])
    least = domain["density"] * 9.81 * BLOCK_SIZE[1] / (2 * domain["friction"])
    assert np.mean([m.mean for m in held]) > least


def test_fingers_that_come_in_the_middle_of_a_trial_wait_for_the_next(running: Probe) -> None:
    """The simulator shows what is mounted and what comes next."""
    from codesign_interfaces.srv import ResetSimulation
    from codesign_nodes.messages import unspecified_domain
    from diagnostic_msgs.msg import DiagnosticArray

    running.listen("/diagnostics", DiagnosticArray, 10)

    def mounted() -> tuple[str, str]:
        for _, array in reversed(running.received["/diagnostics"]):
            for status in array.status:
                if status.name == "/fem_simulator":
                    values = {v.key: v.value for v in status.values}
                    return values["fingers"], values["next_fingers"]
        return "", ""

    before = running.wait_for(lambda: mounted()[0], 30.0, "diagnostics")
    answer = order(running, name="stock")
    assert answer.success, answer.message
    label = f"stock {answer.design.content_hash[:12]}"
    running.wait_for(lambda: mounted() == (before, label), 30.0, "the stock fingers wait")
    reset = ResetSimulation.Request(seed=1, domain=unspecified_domain(), paused=True)
    assert running.call("/fem_simulator/reset", ResetSimulation, reset, timeout=60.0).success
    running.wait_for(lambda: mounted() == (label, ""), 30.0, "the stock fingers are mounted")
