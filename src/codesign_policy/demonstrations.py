"""Demonstrations of a design space as a Minari dataset: a design, and a grasp with its fingers.

One episode is one design step followed by control steps; docs/demonstrations.md describes what is
stored. Reading a dataset runs none of its content as code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import minari
import numpy as np
from gymnasium.spaces import Box
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from numpy.typing import NDArray

from codesign_design.design_space import DesignSpace, design_space
from codesign_policy.codesign_env import COMPONENTS, reward_weights
from codesign_policy.files import replacing_folder
from codesign_policy.lanes import observation_space
from codesign_policy.replay import ReplayBuffer, Spaces, Transitions
from codesign_policy.task import CONTROL_STAGE, TASK_VERSION, design_stage_observation

SHIPPED = Path(__file__).with_name("demonstration_data")  # a folder of datasets as Minari has it
EXPERTS_VERSION = 0  # of the shipped datasets
METADATA = "metadata.json"  # in every Minari dataset
ABOUT = "codesign"  # our part of its metadata

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Demonstration:
    """What one demonstration is; every one of them succeeds.

    Attributes:
        expert: whose finger, or the label of a recorded trial.
        parameters: of its design, (D,) in [-1, 1].
        width: gap that the grasp closes to [m].
        top10_stress, median_stress: means over the interaction period [Pa].
        chamfer: distance of a fitted design to the expert's surface [m].
        gaps_that_hold: of those tried around the planned one, how many succeeded.
    """

    expert: str
    parameters: tuple[float, ...]
    width: float
    top10_stress: float
    median_stress: float
    chamfer: float | None = None
    gaps_that_hold: int | None = None


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations of one design space and their transitions.

    Attributes:
        space: name of the design space.
        episodes: what they are.
        rows: transitions of both stages with `COMPONENTS`, one episode after the other: its design
            step, then its control steps.
        made_by: the command that made them.
    """

    space: str
    episodes: tuple[Demonstration, ...]
    rows: ReplayBuffer
    made_by: str = ""

    @property
    def designs(self) -> NDArray[np.float64]:
        """The demonstrated designs, (n, D)."""
        return np.array([episode.parameters for episode in self.episodes])

    @property
    def gentlest(self) -> Demonstration:
        """That with the least top-10 % and median stress, added."""
        return min(self.episodes, key=lambda each: each.top10_stress + each.median_stress)

    def transitions(self) -> Iterator[Transitions]:
        """The rows of each episode."""
        rows = self.rows.rows
        starts = np.flatnonzero(~rows.in_control)
        for start, stop in zip(starts, [*starts[1:], len(rows.in_control)], strict=True):
            yield rows.pick(slice(start, stop))

    def save(self, folder: Path, name: str = "experts-v0") -> None:
        """Writes a Minari dataset, over one that was there, in one go.

        Args:
            folder: holds the dataset afterwards: `minari.MinariDataset(folder)` opens it.
            name: last part of its id, `codesign/<space>/<name>`.

        Raises:
            ValueError: there is something else in the folder.
        """
        spaces = self.rows.spaces
        with replacing_folder(folder, METADATA) as temporary:
            storage = MinariStorage.new(
                temporary.resolve(),  # it loses its way in relative ones
                observation_space(spaces.observation),
                Box(-1.0, 1.0, (spaces.action,), np.float32),
                data_format="parquet",
            )
            storage.update_metadata(
                {
                    "dataset_id": f"codesign/{self.space}/{name}",
                    "minari_version": minari.__version__,
                    "description": "Fingers shaped in a design space, and tofu picked up with them",
                    ABOUT: _about(design_space(self.space))
                    | {"weights": reward_weights(), "made_by": self.made_by},
                }
            )
            storage.update_episodes([_buffer(rows) for rows in self.transitions()])
            storage.update_episode_metadata([asdict(episode) for episode in self.episodes])


def demonstrations_path(name: str | Path) -> Path:
    """The folder of the shipped dataset of a design space, or else `name` as a folder.

    Example: load_demonstrations(demonstrations_path("wide-12"))
    """
    shipped = SHIPPED / "codesign" / name / f"experts-v{EXPERTS_VERSION}" / "data"
    return shipped if (shipped / METADATA).is_file() else Path(name)


def load_demonstrations(folder: Path) -> Demonstrations:
    """Reads and checks a dataset.

    Raises:
        ValueError: no dataset of ours, a damaged one, another version of task or cage, other
            reward components, wrong shapes, stages or types, or numbers that are not finite or
            out of range.
    """
    try:
        dataset = minari.MinariDataset(folder)
        about = dataset.storage.metadata[ABOUT]
        space = design_space(about["space"])
        wrong = [(name, value) for name, value in _about(space).items() if about[name] != value]
    except (OSError, KeyError, ValueError, TypeError, AssertionError) as error:
        raise _unreadable(folder, error) from error
    if wrong:
        name, mine = wrong[0]
        raise ValueError(
            f"{folder}: {name} is {about[name]}, this program's is {mine}; make them anew with "
            "`codesign policy demonstrate`"
        )
    try:
        data = list(dataset.iterate_episodes())
        described = dataset.storage.get_episode_metadata(dataset.episode_indices.tolist())
        episodes = tuple(_described(each) for each in described)
        if len(data) != len(episodes):
            raise ValueError(f"steps of {len(data)} episodes, {len(episodes)} are announced")
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise _unreadable(folder, error) from error
    try:
        rows = empty_rows(space.name, sum(len(each.rewards) for each in data))
        for number, (each, episode) in enumerate(zip(data, episodes, strict=True)):
            try:
                transitions = _transitions(each, episode, space)
                rows.insert(transitions)
                _require_rewards(transitions, each.rewards, about["weights"])
            except (ValueError, KeyError) as error:
                raise ValueError(f"episode {number}: {error}") from error
    except ValueError as error:
        raise ValueError(f"{folder}: {error}; make it anew") from error
    return Demonstrations(space.name, episodes, rows, about.get("made_by", ""))


def empty_rows(space: str, capacity: int) -> ReplayBuffer:
    """For the transitions of both stages in a design space."""
    design = design_space(space).parameter_count
    return ReplayBuffer(Spaces(8 + design, design, 7), COMPONENTS, capacity)


def _about(space: DesignSpace) -> dict[str, Any]:
    """What data must agree on with the program that reads them."""
    return {
        "task_version": TASK_VERSION,
        "space": space.name,
        "cage_version": space.version,
        "components": list(COMPONENTS),
    }


def _buffer(rows: Transitions) -> EpisodeBuffer:
    """One episode; as in Gymnasium, what a step's info says stands beside its next observation."""
    observations = np.concatenate([rows.observation, rows.next_observation[-1:]])
    before = np.zeros((1, rows.components.shape[1]), np.float32)
    components = np.concatenate([before, rows.components])
    infos = {
        f"reward_{name}": list(values)  # of numbers: one-dimensional arrays cannot be read back
        for name, values in zip(COMPONENTS, components.T, strict=True)
    }
    return EpisodeBuffer(
        observations=observations,
        actions=rows.action,
        rewards=rows.components @ _vector(reward_weights()),
        terminations=rows.terminated,
        truncations=rows.truncated,
        infos={**infos, "stage": list(observations[:, 7])},
    )


def _vector(weights: Mapping[str, float]) -> Array:
    return np.array([weights[name] for name in COMPONENTS], np.float32)


def _described(metadata: dict[str, Any]) -> Demonstration:
    known = {field.name: metadata[field.name] for field in fields(Demonstration)}
    return Demonstration(**{**known, "parameters": tuple(known["parameters"])})


def _transitions(episode: Any, described: Demonstration, space: DesignSpace) -> Transitions:
    """Raises: ValueError: what is stored is not a two-stage episode of this demonstration."""
    steps, design = len(episode.rewards), np.array(described.parameters, np.float32)
    seen = np.asarray(episode.observations)
    _require_shape("parameters", design, (space.parameter_count,))
    _require_shape("observations", seen, (steps + 1, 8 + space.parameter_count))
    _require_shape("actions", episode.actions, (steps, space.parameter_count + 7))
    box = observation_space(seen.shape[1])
    outside = np.argwhere(~((seen >= box.low) & (seen <= box.high)))  # so that NaN counts too
    if len(outside):
        row, column = (int(i) for i in outside[0])
        raise ValueError(
            f"observations[{row}, {column}] is {seen[row, column]}: it must be within "
            f"{box.low[column]}..{box.high[column]}"
        )
    if not np.array_equal(seen[0], design_stage_observation(space.parameter_count)):
        raise ValueError("it does not begin with the design stage")
    if not (seen[1:, 7] == CONTROL_STAGE).all() or steps < 2:
        raise ValueError("it must be one design step and then control steps")
    if not (seen[1:, 8:] == design).all() or not np.array_equal(
        episode.actions[0, : len(design)], design
    ):
        raise ValueError(f"design of {described.expert!r} differs from the one in its metadata")
    components = np.stack([episode.infos[f"reward_{name}"][1:] for name in COMPONENTS], axis=1)
    return Transitions(
        observation=seen[:-1],
        action=episode.actions,
        in_control=seen[:-1, 7] == CONTROL_STAGE,
        components=components,
        next_observation=seen[1:],
        terminated=episode.terminations,
        truncated=episode.truncations,
    )


def _require_rewards(rows: Transitions, rewards: Array, weights: Mapping[str, float]) -> None:
    if not np.allclose(rows.components @ _vector(weights), rewards, atol=1e-4):
        raise ValueError("rewards are not the weighted sum of their components")


def _require_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise ValueError(f"{name} have shape {np.shape(array)}; it must be {shape}")


def _unreadable(folder: Path, error: Exception) -> ValueError:
    return ValueError(
        f"{folder}: not demonstrations ({error!r}); make them with `codesign policy demonstrate`"
    )
