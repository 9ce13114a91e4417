"""Bags that were cut off are saved up to the damaged place."""

import shutil

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from synthetic_trial import BagWriter, SyntheticTrial, write_bag
from typer.testing import CliRunner

from codesign_cli.bag import app
from codesign_report import BagError, read_trial
from codesign_report.bag_recovery import recover


def contents(path):
    with AnyReader([path]) as reader:
        return [(c.topic, c.msgtype, time, data) for c, time, data in reader.messages()]


@pytest.fixture(scope="module")
def pieces(tmp_path_factory):
    """A bag of several chunks; its messages."""
    trial = SyntheticTrial(cells=(8, 12, 10))
    path = write_bag(tmp_path_factory.mktemp("run") / "stock-seed3", trial, BagWriter)
    return path, contents(path)


def cut(bag, target, kept):
    """A copy of which the first `kept` bytes are left, as a killed recorder leaves it."""
    shutil.copytree(bag, target)
    (target / "metadata.yaml").unlink()
    (file,) = target.glob("*.mcap")
    with file.open("r+b") as stream:
        stream.truncate(kept)
    return target


def test_a_cut_bag_is_saved_up_to_the_last_piece(pieces, tmp_path):
    bag, all_of_it = pieces
    (file,) = bag.glob("*.mcap")
    size = file.stat().st_size
    assert size > 3.5 * 2**20  # chunks are of a little more than 1 MiB
    killed = cut(bag, tmp_path / "killed", size // 2)
    with pytest.raises(BagError, match="codesign bag recover"):
        read_trial(killed)
    count = recover(killed, tmp_path / "saved")
    saved = contents(tmp_path / "saved")
    assert len(saved) == count
    # Sorted by time both: what was written first is a part of what was written.
    assert 0.2 * len(all_of_it) < count < 0.55 * len(all_of_it)
    assert saved == all_of_it[:count]
    stress = read_trial(tmp_path / "saved").stress
    np.testing.assert_allclose(np.diff(stress.times), 0.05, atol=1e-9)


def test_types_hashes_and_qos_are_kept(pieces, tmp_path):
    bag, _ = pieces
    recover(bag, tmp_path / "saved")

    def topics(path):
        information = yaml.safe_load((path / "metadata.yaml").read_text())
        listed = information["rosbag2_bagfile_information"]["topics_with_message_count"]
        return {t["topic_metadata"]["name"]: t for t in listed}

    assert topics(tmp_path / "saved") == topics(bag)


def test_a_whole_bag_stays_whole(pieces, tmp_path):
    bag, all_of_it = pieces
    assert recover(bag, tmp_path / "saved") == len(all_of_it)
    assert contents(tmp_path / "saved") == all_of_it


@pytest.mark.parametrize("kept", [0, 4, 5000])
def test_nothing_to_save_is_said(bag, tmp_path, kept):
    with pytest.raises(BagError, match="no message can be read"):
        recover(cut(bag, tmp_path / "killed", kept), tmp_path / "saved")
    assert not (tmp_path / "saved").exists()


def test_nothing_is_overwritten(bag, tmp_path):
    with pytest.raises(BagError, match="exists already"):
        recover(bag, tmp_path)


def test_no_bag_is_refused(tmp_path):
    with pytest.raises(BagError, match=r"not a bag, it holds 0 \.mcap files"):
        recover(tmp_path, tmp_path / "saved")


def test_command_line(pieces, tmp_path):
    killed = cut(pieces[0], tmp_path / "killed", 3 * 2**20)
    command = ["recover", str(killed), str(tmp_path / "saved")]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.stderr
    assert done.stdout == f"{tmp_path / 'saved'}: {len(contents(tmp_path / 'saved'))} messages\n"
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 2
    assert "exists already" in again.stderr
