"""Demonstrations as a LeRobot dataset, format v3.0, without the `lerobot` package.

One frame per control step, in SI units; the design stage, which takes no time, is in every frame's
state as the design parameters. Layout and fields: https://huggingface.co/docs/lerobot,
"LeRobotDataset v3.0".
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from codesign_policy.codesign_env import COMPONENTS, reward_weights
from codesign_policy.demonstrations import Demonstrations
from codesign_policy.files import replacing_folder
from codesign_policy.replay import Transitions
from codesign_policy.task import ACTION_NAMES, ACTION_SCALE, POLICY_PERIOD, physical_observations

FORMAT = "v3.0"
FPS = round(1.0 / POLICY_PERIOD)
TASK = "Pick up the silk tofu without crushing it."
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
STATE = ("tcp_x", "tcp_y", "tcp_z", "object_x", "object_y", "object_z", "gap")

Frames = dict[str, NDArray[Any]]
"""Columns by feature, (T,) or (T, n)."""


def export_lerobot(demonstrations: Demonstrations, folder: Path) -> None:
    """Writes the dataset, over one that was there, in one go.

    Raises:
        ValueError: there is something else in the folder.
    """
    features = _features(demonstrations.designs.shape[1])
    episodes: list[Frames] = []
    for number, rows in enumerate(demonstrations.transitions()):
        first = sum(len(each["index"]) for each in episodes)
        episodes.append(_frames(rows, number, first))
    together = {name: np.concatenate([each[name] for each in episodes]) for name in features}
    with replacing_folder(folder, INFO) as out:
        _write_table(
            out / DATA.format(chunk_index=0, file_index=0), _data_table(together, features)
        )
        _write_table(out / EPISODES, _episode_table(episodes))
        _write_table(out / TASKS, _task_table())
        _write_json(out / STATS, {name: _statistics(values) for name, values in together.items()})
        _write_json(out / INFO, _info(features, len(episodes), len(together["index"])))


def _features(design: int) -> dict[str, dict[str, Any]]:
    def feature(dtype: str, *names: str) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [len(names) or 1], "names": list(names) or None}

    return {
        "observation.state": feature("float32", *STATE, *(f"design_{k}" for k in range(design))),
        "action": feature("float32", *ACTION_NAMES),
        "next.reward": feature("float32"),
        "next.reward_components": feature("float32", *COMPONENTS),
        "next.done": feature("bool"),
        "timestamp": feature("float32"),
        "frame_index": feature("int64"),
        "episode_index": feature("int64"),
        "index": feature("int64"),
        "task_index": feature("int64"),
    }


def _frames(rows: Transitions, number: int, first: int) -> Frames:
    """The control steps of one episode."""
    control = rows.pick(rows.in_control)
    steps = np.arange(len(control.in_control))
    weights = np.array([reward_weights()[name] for name in COMPONENTS], np.float32)
    seen = np.delete(physical_observations(control.observation), 7, axis=1)  # without f, always 1
    return {
        "observation.state": seen.astype(np.float32),
        "action": (control.action[:, -7:] * ACTION_SCALE).astype(np.float32),
        "next.reward": control.components @ weights,
        "next.reward_components": control.components,
        "next.done": control.terminated | control.truncated,
        "timestamp": (steps / FPS).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(len(steps), number),
        "index": first + steps,
        "task_index": np.zeros(len(steps), np.int64),
    }


def _data_table(frames: Frames, features: dict[str, dict[str, Any]]) -> pa.Table:
    columns = {}
    for name, values in frames.items():
        flat = pa.array(values.ravel(), pa.type_for_alias(features[name]["dtype"]))
        wide = values.ndim == 2
        columns[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if wide else flat
    return pa.table(columns)


def _episode_table(episodes: list[Frames]) -> pa.Table:
    rows = []
    for number, frames in enumerate(episodes):
        statistics = {
            f"stats/{name}/{key}": value
            for name, values in frames.items()
            for key, value in _statistics(values).items()
        }
        row = {
            "episode_index": number,
            "tasks": [TASK],
            "length": len(frames["index"]),
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": int(frames["index"][0]),
            "dataset_to_index": int(frames["index"][-1]) + 1,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        rows.append({**row, **statistics})
    return pa.Table.from_pylist(rows)


def _task_table() -> pa.Table:
    """Numbers of tasks by their text, which the loader expects as a pandas index."""
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored}
        for name, kind, stored in (
            ("task_index", "int64", "int64"),
            ("task", "unicode", "object"),
        )
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [{**column, "metadata": None} for column in columns],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _statistics(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Per number of a feature, as lists; quantiles are exact ones."""
    wide = values.reshape(len(values), -1).astype(np.float64)
    named = {
        "min": wide.min(axis=0),
        "max": wide.max(axis=0),
        "mean": wide.mean(axis=0),
        "std": wide.std(axis=0),
    }
    for share in QUANTILES:
        named[f"q{round(100 * share):02d}"] = np.quantile(wide, share, axis=0)
    return {**{key: value.tolist() for key, value in named.items()}, "count": [len(values)]}


def _info(features: dict[str, dict[str, Any]], episodes: int, frames: int) -> dict[str, Any]:
    return {
        "codebase_version": FORMAT,
        "robot_type": "xarm7",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": None,
        "features": features,
    }


def _write_table(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
