"""Metrics of bags with and without stress, as of a real arm."""

import json
import math
from dataclasses import asdict

import pytest
from synthetic_trial import CENTER, BagWriter, SyntheticTrial, write_bag
from typer.testing import CliRunner

from codesign_cli.bag import app
from codesign_report import BagError, trial_metrics
from codesign_report.bag_outcome import read_outcome

TRUTH = ("/stress", "/simulation_state", "/soft_body_mesh")


class RealBag(BagWriter):
    """What an arm and a camera would publish: no truth, but the hand's pose. Fingers close to less
    than the block's thickness, as `SyntheticTrial` closes along 50 mm and the task along 30 mm."""

    drop_at = math.inf  # s, when the block falls

    def messages(self):
        for t, topic, kind, message in super().messages():
            if topic in TRUTH:
                continue
            if topic == "/gripper_state":
                message.width -= 0.022  # 20 mm wide at the end: closed on the block
            if topic == "/object_pose":
                if t >= self.drop_at:
                    message.pose.position.z = 0.02
                yield t, "/tcp_pose", kind, self.hand(t)
            yield t, topic, kind, message

    def hand(self, t):
        pose = [*CENTER, 0.005 + self.trial.rise(t), 1.0, 0.0, 0.0, 0.0]
        return self.make(
            "geometry_msgs/PoseStamped", header=self.header(t), pose=self.to_pose(pose)
        )


@pytest.fixture(scope="module")
def real_bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("real") / "stock-seed3", SyntheticTrial(), RealBag)


def test_without_stress_pose_and_gripper_tell(real_bag, trial):
    outcome = read_outcome(real_bag)
    assert (outcome.gripper, outcome.seed, outcome.stress_known) == ("stock", 3, False)
    metrics = outcome.metrics
    assert metrics.success
    assert metrics.peak_lift == pytest.approx(trial.lift)
    for name in ("top10_stress", "median_stress", "held_force", "score"):
        assert math.isnan(getattr(metrics, name)), name
    assert math.isnan(outcome.weight)
    # The gap comes below the block's thickness and 1 mm while it closes, and stays.
    closed = next(t for t in (0.6 + 0.001 * k for k in range(1400)) if trial.gap(t) < 0.053)
    assert metrics.interaction_time == pytest.approx(trial.duration - closed, abs=0.05)


def test_a_dropped_block_is_no_success(tmp_path):
    class Dropped(RealBag):
        drop_at = 4.5

    metrics = read_outcome(write_bag(tmp_path / "bag", SyntheticTrial(), Dropped)).metrics
    assert not metrics.success
    assert metrics.peak_lift == pytest.approx(0.1, abs=1e-3)


def test_with_stress_it_is_the_one_judgement(bag, recording):
    outcome = read_outcome(bag)
    assert outcome.stress_known
    assert outcome.metrics == trial_metrics(recording)
    assert outcome.weight == recording.weight


@pytest.mark.parametrize("topic", ["/object_pose", "/gripper_state", "/tcp_pose"])
def test_a_missing_topic_is_named(tmp_path, topic):
    class Writer(RealBag):
        def messages(self):
            return (m for m in super().messages() if m[1] != topic)

    with pytest.raises(BagError, match=f"no messages on {topic}"):
        read_outcome(write_bag(tmp_path / "bag", SyntheticTrial(), Writer))


def test_without_trial_state_all_of_it_counts(tmp_path):
    trial = SyntheticTrial(leave_out=("/trial_state",))
    outcome = read_outcome(write_bag(tmp_path / "round-seed12", trial, RealBag))
    assert (outcome.gripper, outcome.seed) == ("round", 12)
    assert outcome.metrics.success


def command(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_command_line(real_bag, bag, tmp_path):
    done = command("metrics", real_bag, "--json")
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["success"] is True
    assert told["stress_known"] is False
    assert told["top10_stress"] is told["score"] is told["held_force"] is None
    table = command("metrics", real_bag).stdout.splitlines()
    assert [line.split() for line in table if "judged by" in line or "top-10" in line] == [
        ["judged", "by", "pose", "and", "gripper"],
        ["top-10", "%", "stress", "-"],
    ]
    simulated = json.loads(command("metrics", bag, "--json").stdout)
    known = asdict(read_outcome(bag).metrics)
    assert {name: simulated[name] for name in known} == known
    missing = command("metrics", tmp_path / "nothing")
    assert missing.exit_code == 2
    assert "does not exist" in missing.stderr
