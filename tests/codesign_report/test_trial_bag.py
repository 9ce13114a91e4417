"""Reading trial bags: what was written comes back, and what is broken is named."""

import shutil

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from synthetic_trial import DOMAIN, POLICY_START, BagWriter, SyntheticTrial, typestore, write_bag

from codesign_report import BagError, read_trial, trial_metrics


def copy(bag, tmp_path):
    return shutil.copytree(bag, tmp_path / bag.name)


def damaged(tmp_path, change, name="stock-seed3"):
    """A bag whose messages went through `change(time, topic, message)`; None drops one."""

    class Writer(BagWriter):
        def messages(self):
            for t, topic, kind, message in super().messages():
                changed = change(t, topic, message)
                if changed is not None:
                    yield t, topic, kind, changed

    return write_bag(tmp_path / name, SyntheticTrial(), Writer)


def test_round_trip(recording, trial, bag):
    assert (recording.name, recording.gripper, recording.seed) == (bag.name, "stock", 3)
    assert vars(recording.domain) == DOMAIN
    body = recording.soft_body
    np.testing.assert_allclose(body.rest_positions, trial.body.rest_positions, atol=1e-8)
    np.testing.assert_array_equal(body.tetrahedra, trial.body.tetrahedra)
    np.testing.assert_array_equal(body.surface_triangles, trial.body.surface_triangles)
    np.testing.assert_array_equal(body.surface_tetrahedra, trial.body.surface_tetrahedra)
    for mesh, original in zip(
        (recording.left_finger, recording.right_finger), trial.fingers, strict=True
    ):
        np.testing.assert_allclose(mesh.vertices, original.vertices)
        np.testing.assert_array_equal(mesh.triangles, original.triangles)


def test_series_start_when_the_policy_has_started(recording, trial):
    start = POLICY_START
    expected = trial.times[trial.times > start + 1e-9] - start
    np.testing.assert_allclose(recording.stress.times, expected, atol=1e-9)
    np.testing.assert_allclose(recording.motion.times, expected, atol=1e-9)
    i = 59  # where every topic has a sample
    t = expected[i] + start
    np.testing.assert_allclose(recording.stress.von_mises[i], trial.von_mises(t), rtol=1e-6)
    np.testing.assert_allclose(recording.stress.left_force[i], trial.forces(t)[0])
    np.testing.assert_allclose(recording.motion.positions[i], trial.positions(t), atol=1e-7)
    np.testing.assert_allclose(recording.motion.right_pose[i], trial.pose(t, -1.0), atol=1e-12)
    np.testing.assert_allclose(recording.object_height[i], trial.height(t), atol=1e-12)
    np.testing.assert_allclose(np.diff(recording.gripper_times), 0.02, atol=1e-9)


def test_a_trial_that_did_not_finish_starts_when_it_ran(tmp_path):
    def cut_off(_, topic, message):
        return None if topic == "/trial_state" and message.state == 3 else message

    stress = read_trial(damaged(tmp_path, cut_off)).stress
    assert stress.times[-1] == pytest.approx(5.0 - 0.21)


def test_metrics_of_the_bag(recording, trial):
    metrics = trial_metrics(recording)
    assert metrics.success
    assert metrics.peak_lift == pytest.approx(trial.lift)
    assert metrics.held_force == pytest.approx(trial.weight)
    assert recording.weight == pytest.approx(trial.weight, rel=1e-6)
    assert metrics.interaction_time == pytest.approx(3.7, abs=0.1)
    assert trial_metrics(recording.bag) == metrics
    assert not trial_metrics(recording, success_lift=0.15).success


def test_read_by_mcap_ros2_support(bag, trial):
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/stress"])]
    assert len(decoded) == len(trial.times)
    assert len(decoded[0].von_mises) == len(trial.body.tetrahedra)


def test_type_hashes_and_offered_qos_are_kept(bag):
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {t["topic_metadata"]["name"]: t for t in information["topics_with_message_count"]}
    for topic in topics.values():
        assert topic["topic_metadata"]["type_description_hash"].startswith("RIHS01_")
    durability = {
        name: topic["topic_metadata"]["offered_qos_profiles"][0]["durability"]
        for name, topic in topics.items()
    }
    assert durability["/soft_body_mesh"] == "transient_local"
    assert durability["/stress"] == "volatile"


def test_a_bag_without_metadata_is_read(bag, tmp_path, recording):
    lost = copy(bag, tmp_path)
    (lost / "metadata.yaml").unlink()
    assert read_trial(lost).stress.times.tolist() == recording.stress.times.tolist()
    (file,) = lost.glob("*.mcap")
    assert read_trial(file).gripper == "stock"


def test_without_trial_state_the_name_tells(tmp_path):
    path = write_bag(tmp_path / "round-a-seed12", SyntheticTrial(leave_out=("/trial_state",)))
    trial = read_trial(path)
    assert (trial.gripper, trial.seed, trial.domain.density) == ("round-a", 12, DOMAIN["density"])
    assert trial.stress.times[-1] == pytest.approx(5.0)


def test_without_gripper_state(tmp_path):
    path = write_bag(tmp_path / "bag", SyntheticTrial(leave_out=("/gripper_state",)))
    assert read_trial(path).gripper_times.shape == (0,)


@pytest.mark.parametrize("topic", ["/stress", "/object_pose", "/finger_design"])
def test_a_missing_topic_is_named(tmp_path, topic):
    path = write_bag(tmp_path / "bag", SyntheticTrial(leave_out=(topic,)))
    with pytest.raises(BagError, match=topic):
        read_trial(path)


@pytest.mark.parametrize("kept", [0, 4, 5000, 200_000])
def test_a_truncated_file_is_refused(bag, tmp_path, kept):
    cut = copy(bag, tmp_path)
    (file,) = cut.glob("*.mcap")
    assert file.stat().st_size > 200_000
    with file.open("r+b") as stream:
        stream.truncate(kept)
    with pytest.raises(BagError, match=r"stock-seed3.*codesign bag recover"):
        read_trial(cut)


def test_not_a_bag(tmp_path):
    with pytest.raises(BagError, match="does not exist"):
        read_trial(tmp_path / "nothing")
    with pytest.raises(BagError, match="not a bag"):
        read_trial(tmp_path)
    other = tmp_path / "notes.txt"
    other.write_text("hello")
    with pytest.raises(BagError, match="not a bag"):
        read_trial(other)
    fake = tmp_path / "fake.mcap"
    fake.write_text("hello")
    with pytest.raises(BagError, match="cannot be read"):
        read_trial(fake)


def test_a_value_that_is_not_finite_is_refused(tmp_path):
    def spoil(t, topic, message):
        if topic == "/stress" and t == pytest.approx(2.0):
            message.top10_mean = float("nan")
        return message

    with pytest.raises(BagError, match=r"/stress.*not finite"):
        read_trial(damaged(tmp_path, spoil))


def test_another_object_halfway_is_refused(tmp_path):
    def swap(t, topic, message):
        if topic == "/stress" and t > 2.0:
            message.von_mises = message.von_mises[:-1]
        return message

    with pytest.raises(BagError, match=r"/stress.*changes its length"):
        read_trial(damaged(tmp_path, swap))


def test_stress_of_another_mesh_is_refused(tmp_path):
    def swap(_, topic, message):
        if topic == "/stress":
            message.von_mises = message.von_mises[:-1]
        return message

    with pytest.raises(BagError, match=r"719 tetrahedra.*720"):
        read_trial(damaged(tmp_path, swap))


def test_other_message_definitions_are_refused(tmp_path):
    class Old(BagWriter):
        def __init__(self, trial):
            super().__init__(trial)
            self.store = typestore(
                lambda name, text: (
                    text.replace("width ", "gap ") if name == "GripperState" else text
                )
            )

        def make(self, kind, **fields):
            if kind.endswith("/GripperState"):
                fields["gap"] = fields.pop("width")
                fields["target_gap"] = fields.pop("target_width")
            return super().make(kind, **fields)

    path = write_bag(tmp_path / "bag", SyntheticTrial(), Old)
    with pytest.raises(BagError, match=r"other message definitions.*width"):
        read_trial(path)


def test_indices_beyond_the_mesh_are_refused(tmp_path):
    def spoil(_, topic, message):
        if topic == "/soft_body_mesh":
            message.surface_triangles[5] = 9999
        return message

    with pytest.raises(BagError, match=r"surface triangles.*9999"):
        read_trial(damaged(tmp_path, spoil))


def test_too_few_samples_are_refused(tmp_path):
    path = damaged(tmp_path, lambda t, topic, m: None if topic == "/object_pose" and t else m)
    with pytest.raises(BagError, match=r"/object_pose has 0 samples"):
        read_trial(path)


def test_double_stamps_and_disorder_do_no_harm(tmp_path, recording):
    def disorder(t, topic, message):
        if topic == "/stress" and t == pytest.approx(3.0):
            message.header.stamp = message.header.stamp.__class__(
                sec=message.header.stamp.sec, nanosec=message.header.stamp.nanosec - 50_000_000
            )
        return message

    stress = read_trial(damaged(tmp_path, disorder)).stress
    assert len(stress.times) == len(recording.stress.times) - 1
    assert (np.diff(stress.times) > 0).all()


def test_quaternions_do_not_jump_sign(tmp_path, recording):
    def flip(t, topic, message):
        if topic == "/simulation_state" and round(t * 20) % 2:
            q = message.left_finger.orientation
            q.x, q.y, q.z, q.w = -q.x, -q.y, -q.z, -q.w
        return message

    pose = read_trial(damaged(tmp_path, flip)).motion.left_pose
    np.testing.assert_allclose(np.abs(pose), np.abs(recording.motion.left_pose))
    assert (np.einsum("ti,ti->t", pose[1:, 3:], pose[:-1, 3:]) > 0).all()
