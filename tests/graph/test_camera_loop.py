"""The whole loop through a rendered camera: the policy sees the block in its pictures only."""

import json
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from codesign_bringup.bringup import executable
from rosbags.highlevel import AnyReader

from codesign_perception.camera import Camera
from codesign_perception.camera_file import save_camera
from codesign_report import read_trial, trial_metrics

SEED = 3
TIMEOUT = 900.0  # s: rendering without a GPU beside other tests

pytestmark = pytest.mark.timeout(TIMEOUT + 120.0)


def run_trials(
    out: Path, camera: Path, *options: str, policies: tuple[str, ...] = (), succeeds: bool = True
) -> list[dict[str, Any]]:
    """A trial with each policy, in lockstep at 600 tetrahedra, through this camera."""
    settings = [
        f"simulated_camera.camera_file={camera}",
        f"tofu_pose_estimator.camera_file={camera}",
        "fem_simulator.tetrahedra=600",
        *options,
    ]
    command = [
        str(executable("codesign_bringup", "bringup")), "sim_camera", "--lockstep", "--quiet",
        "--log-folder", str(out / "logs"), *(part for s in settings for part in ("--set", s)),
        "--", "run_trials", "--count", "1", "--seed", str(SEED), "--out", str(out),
        "--timeout", str(TIMEOUT), *(part for p in policies for part in ("--policy", p)),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT + 60.0)
    assert done.returncode == (0 if succeeds else 1), done.stdout + done.stderr
    return json.loads((out / "trials.json").read_text())["trials"]


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the profile's camera stands, with fewer pixels: quick to render."""
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    seen = Camera.looking_at(
        [0.80, 0.10, 0.27], [0.45, 0.0, 0.075], width=960, height=540, focal=750
    )
    save_camera(path, seen)
    return path


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory, camera: Path) -> dict[str, Any]:
    (trial,) = run_trials(tmp_path_factory.mktemp("camera_loop"), camera)
    return trial


def by_stamp(bag: Path, topic: str) -> dict[int, Any]:
    """The messages of a topic by header.stamp [ns]; repeated ones once."""
    found: dict[int, Any] = {}
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        # Given no connection, the reader gives all of them.
        for connection, _, data in reader.messages(wanted) if wanted else ():
            message = reader.deserialize(data, connection.msgtype)
            found[nanoseconds(message.header.stamp)] = message
    return found


def nanoseconds(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def numbers(action: Any) -> list[float]:
    turn, way = action.rotation, action.translation
    return [way.x, way.y, way.z, turn.x, turn.y, turn.z, action.width]


def gap_errors(bag: Path) -> np.ndarray:
    """How far the gap is from a command when the next one comes [m]: one that waited for the table
    must not stay behind for good."""
    actions = by_stamp(bag, "/action")
    commands, states = by_stamp(bag, "/gripper_command"), by_stamp(bag, "/gripper_state")
    later = {stamp: stamp + 50_000_000 for stamp in commands if min(actions) <= stamp}
    return np.array(
        [abs(states[t].width - commands[s].width) for s, t in later.items() if t in states]
    )


def test_tofu_is_picked_up_through_the_camera(trial: dict[str, Any]) -> None:
    assert trial["success"], trial["message"]
    assert trial["metrics"]["peak_lift"] == pytest.approx(0.1, abs=0.003)


def test_the_judge_knows_the_truth_live_and_from_the_bag(trial: dict[str, Any]) -> None:
    recording = read_trial(trial["bag"])
    assert vars(trial_metrics(recording)) == trial["metrics"]
    truth = by_stamp(Path(trial["bag"]), "/ground_truth/object_pose")
    heights = {s: m.pose.position.z for s, m in truth.items()}
    top = np.interp(1.0, [0.0, 1.0], [0.0, recording.object_positions[:, 2].max()])
    assert top == max(z for s, z in heights.items() if s > recording.start)


def test_the_estimates_are_near_the_truth_while_the_block_rests(trial: dict[str, Any]) -> None:
    recording = read_trial(trial["bag"])
    estimates = recording.estimates
    assert estimates is not None
    resting = estimates.times < recording.stress.times[recording.object_height > 0.025][0] - 2.0
    assert resting.sum() > 20
    assert np.percentile(estimates.distances[resting], 95) < 0.0015


def test_an_action_answers_the_picture_of_its_own_moment(trial: dict[str, Any]) -> None:
    bag = Path(trial["bag"])
    actions, poses = by_stamp(bag, "/action"), by_stamp(bag, "/object_pose")
    pictures = by_stamp(bag, "/camera/image/compressed")
    for stamp, action in actions.items():
        seen = nanoseconds(action.observation_stamp)
        assert nanoseconds(action.tcp_stamp) == stamp
        assert seen in poses
        assert seen == stamp or (stamp not in poses and stamp - seen <= 200_000_000)
    late = max(actions)  # the trial's last moments may be cut off
    missing = {s for s in actions if s < late - 10**8} - pictures.keys()
    assert not missing


def test_pictures_have_the_size_of_their_camera_info(trial: dict[str, Any], camera: Path) -> None:
    bag = Path(trial["bag"])
    (info,) = by_stamp(bag, "/camera/camera_info").values()
    assert (info.width, info.height, info.distortion_model) == (960, 540, "plumb_bob")
    assert info.k[0] == 750.0
    picture = next(iter(by_stamp(bag, "/camera/image/compressed").values()))
    decoded = cv2.imdecode(np.asarray(picture.data), cv2.IMREAD_COLOR)
    assert decoded.shape == (540, 960, 3)


def test_every_policy_sees_enough_and_the_same_trial_is_the_same_again(
    tmp_path: Path, camera: Path, trial: dict[str, Any]
) -> None:
    """The pairs' fingers hide half of what they hold."""
    policies = ("scripted", "codesign", "original")
    again, *learned = run_trials(tmp_path, camera, policies=policies)
    for result in learned:
        assert result["success"], f"{result['gripper']}: {result['message']}"
        assert gap_errors(Path(result["bag"])).max() < 1e-6
    first, second = (by_stamp(Path(t["bag"]), "/action") for t in (trial, again))
    end = min(max(first), max(second))  # a policy goes on until it is stopped
    assert {s for s in first if s <= end} == {s for s in second if s <= end}
    for stamp in (s for s in first if s <= end):
        assert numbers(first[stamp]) == numbers(second[stamp])
    assert trial["metrics"] == again["metrics"]


def test_a_block_out_of_sight_ends_the_trial_without_a_move(tmp_path: Path, camera: Path) -> None:
    """The camera looks half a radian past what its file says."""
    (result,) = run_trials(
        tmp_path,
        camera,
        "simulated_camera.rotation_error=0.5",
        "policy.object_patience=2.0",
        "trial_runner.policy_silence=20.0",
        succeeds=False,
    )
    assert not result["success"]
    assert "fault" in result["message"]
    assert not by_stamp(Path(result["bag"]), "/action")
    joints = by_stamp(Path(result["bag"]), "/joint_states").values()
    positions = np.array([m.position for m in joints])
    assert np.ptp(positions, axis=0).max() < 1e-6
