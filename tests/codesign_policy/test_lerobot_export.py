"""The LeRobot export, read by the rules of its format v3.0 with pyarrow and json alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from codesign_policy.codesign_env import COMPONENTS, reward_weights
from codesign_policy.demonstrations import (
    Demonstrations,
    demonstrations_path,
    load_demonstrations,
)
from codesign_policy.lerobot_export import export_lerobot
from codesign_policy.task import Observation, scaled_actions

TYPES = {"float32": "float", "int64": "int64", "bool": "bool"}


@pytest.fixture(scope="module")
def shipped() -> Demonstrations:
    return load_demonstrations(demonstrations_path("wide-12"))


@pytest.fixture(scope="module")
def root(shipped: Demonstrations, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "wide-12"
    export_lerobot(shipped, folder)
    return folder


@pytest.fixture(scope="module")
def info(root: Path) -> dict[str, Any]:
    return json.loads((root / "meta/info.json").read_text())


@pytest.fixture(scope="module")
def data(root: Path, info: dict[str, Any]) -> dict[str, np.ndarray]:
    """Every column of the file that `data_path` names."""
    table = pq.read_table(root / info["data_path"].format(chunk_index=0, file_index=0))
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def test_the_files_are_those_of_the_format(root: Path, info: dict[str, Any]) -> None:
    files = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
    assert files == {
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    }
    counts = {key: value for key, value in info.items() if key not in ("features", "data_path")}
    assert counts == {
        "codebase_version": "v3.0",
        "robot_type": "xarm7",
        "total_episodes": 3,
        "total_frames": 600,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": 20,
        "splits": {"train": "0:3"},
        "video_path": None,
    }


def test_columns_are_the_features(root: Path, info: dict[str, Any]) -> None:
    schema = pq.read_schema(root / "data/chunk-000/file-000.parquet")
    assert set(schema.names) == set(info["features"])
    for name, feature in info["features"].items():
        (size,) = feature["shape"]
        assert "/" not in name
        kind = TYPES[feature["dtype"]]
        wide = f"fixed_size_list<item: {kind}>[{size}]"
        assert str(schema.field(name).type).replace("element", "item") == (
            wide if size > 1 else kind
        )
        assert feature["names"] is None or len(feature["names"]) == size


def test_indices_and_timestamps_run_on(data: dict[str, np.ndarray]) -> None:
    np.testing.assert_array_equal(data["index"], np.arange(600))
    np.testing.assert_array_equal(data["episode_index"], np.repeat([0, 1, 2], 200))
    np.testing.assert_array_equal(data["frame_index"], np.tile(np.arange(200), 3))
    # The loader allows 1e-4 s.
    np.testing.assert_allclose(data["timestamp"], data["frame_index"] / 20.0, atol=1e-6)
    assert not data["task_index"].any()
    np.testing.assert_array_equal(np.flatnonzero(data["next.done"]), [199, 399, 599])


def test_frames_are_the_control_steps_in_si_units(
    shipped: Demonstrations, data: dict[str, np.ndarray]
) -> None:
    row = 0
    for rows in shipped.transitions():
        for seen, action in zip(rows.observation[1:], rows.action[1:, -7:], strict=True):
            expected = Observation.from_normalised(seen)
            state = data["observation.state"][row]
            np.testing.assert_allclose(state[:3], expected.tcp_position, atol=1e-6)
            np.testing.assert_allclose(state[3:6], expected.object_position, atol=1e-6)
            assert state[6] == pytest.approx(expected.width, abs=1e-6)
            np.testing.assert_allclose(state[7:], expected.design, atol=1e-6)
            np.testing.assert_allclose(
                data["action"][row], scaled_actions(action[None], 1)[0], atol=1e-8
            )
            row += 1
    control = shipped.rows.rows.in_control
    reward = shipped.rows.reward(reward_weights())[control]
    np.testing.assert_allclose(data["next.reward"], reward, atol=1e-5)
    components = shipped.rows.rows.components[control]
    np.testing.assert_array_equal(data["next.reward_components"], components)
    assert components.shape[1] == len(COMPONENTS)


def test_episodes_say_where_their_frames_are(root: Path, data: dict[str, np.ndarray]) -> None:
    rows = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    task = pq.read_table(root / "meta/tasks.parquet")
    assert task.to_pylist() == [
        {"task_index": 0, "task": "Pick up the silk tofu without crushing it."}
    ]
    # Pandas makes the text the index, as the loader expects.
    assert json.loads(task.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    for number, row in enumerate(rows):
        assert row["episode_index"] == number
        assert row["tasks"] == [task["task"][0].as_py()]
        assert (row["data/chunk_index"], row["data/file_index"]) == (0, 0)
        assert (row["meta/episodes/chunk_index"], row["meta/episodes/file_index"]) == (0, 0)
        start, stop = row["dataset_from_index"], row["dataset_to_index"]
        assert stop - start == row["length"] == 200
        assert set(data["episode_index"][start:stop]) == {number}
        for name, values in data.items():
            check_statistics(
                {
                    key.rpartition("/")[2]: row[key]
                    for key in row
                    if key.startswith(f"stats/{name}/")
                },
                values[start:stop],
            )


def test_statistics_are_those_of_the_frames(root: Path, data: dict[str, np.ndarray]) -> None:
    statistics = json.loads((root / "meta/stats.json").read_text())
    assert set(statistics) == set(data)
    for name, values in data.items():
        check_statistics(statistics[name], values)


def check_statistics(stored: dict[str, list[float]], values: np.ndarray) -> None:
    wide = values.reshape(len(values), -1).astype(float)
    assert stored["count"] == [len(values)]
    for key, expected in {
        "min": wide.min(axis=0),
        "max": wide.max(axis=0),
        "mean": wide.sum(axis=0) / len(wide),
        "std": np.sqrt(((wide - wide.mean(axis=0)) ** 2).mean(axis=0)),
        "q50": np.median(wide, axis=0),
    }.items():
        assert len(stored[key]) == wide.shape[1]
        np.testing.assert_allclose(stored[key], expected, atol=1e-6)
    assert set(stored) == {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}
    for lower, higher in (("min", "q01"), ("q01", "q10"), ("q90", "q99"), ("q99", "max")):
        assert (np.array(stored[lower]) <= np.array(stored[higher]) + 1e-9).all()


def test_exporting_again_replaces_only_an_export(
    shipped: Demonstrations, root: Path, tmp_path: Path
) -> None:
    before = (root / "meta/stats.json").read_text()
    export_lerobot(shipped, root)
    assert (root / "meta/stats.json").read_text() == before
    (tmp_path / "other.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"has other content, without a meta/info.json"):
        export_lerobot(shipped, tmp_path)
