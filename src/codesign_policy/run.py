"""A training run: its settings, the objects made of them, and the folder that keeps it.

run.json        settings, command and commit
checkpoint.pt   everything to go on; configuration.json beside it
history.csv     one row per round; tensorboard/ the same for TensorBoard
selection.json  designs that were judged at the end, of a run that learns the design too
policy.npz      the pair to be served
curves.png      success, stress, return over transitions; finger.png the finger
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from codesign_design.design_space import design_space
from codesign_design.finger_pair import FingerPair
from codesign_design.stock import stock_fingers
from codesign_policy.codesign_env import COMPONENTS, CodesignEnv, built_design, reward_weights
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.demonstrations import (
    Demonstrations,
    demonstrations_path,
    load_demonstrations,
)
from codesign_policy.files import write_text
from codesign_policy.presets import PRESETS, Preset
from codesign_policy.proposals import DesignSearch, SearchSettings
from codesign_policy.replay import ReplayBuffer, Spaces
from codesign_policy.reward import RewardWeights
from codesign_policy.rlpd import Agent
from codesign_policy.rounds import Episodes
from codesign_policy.training import Training, TrainingConfig

RUN_FILE, PAIR_FILE = "run.json", "policy.npz"
METRICS = ("success", "top10_stress", "median_stress", "peak_lift")
FINE_TUNING = 5.0  # on the weight of stress (paper, III-D)


@dataclass(frozen=True)
class RunConfig:
    """Settings of a run.

    Attributes:
        space: design space; empty: the stock fingers, and control alone is learned.
        design: fixed parameters in that space: control alone is learned; empty: the design too.
        start: where designs start, in [-1, 1]; empty: at the base mesh.
        design_direction: unit vector (D,): d is the design's component in it, the paper's scalar;
            empty: d is the whole design.
        preset: of the learner.
        discount: in place of the preset's; 0 for that.
        search: whether designs come from `DesignSearch` instead of the design actor.
        transitions: budget, of the control stage.
        seed: of everything that is drawn.
        lanes: environments side by side.
        tetrahedra: resolution of the block.
        friction: range that it is drawn from.
        pose_error: of the observed object [m].
        stress_factor: on the weight of stress in the reward.
        lift_factor: on the weights of lift and of being held up.
        demonstrations: rows of demonstrations, 0 for none; the checkpoint keeps them.
        command, commit: what made it.
    """

    space: str = "wide-12"
    design: tuple[float, ...] = ()
    start: tuple[float, ...] = ()
    design_direction: tuple[float, ...] = ()
    preset: str = "fast"
    discount: float = 0.0
    search: bool = True
    transitions: int = 80_000
    seed: int = 0
    lanes: int = 16
    tetrahedra: int = 2400
    friction: tuple[float, float] = (0.4, 0.6)
    pose_error: float = 0.001
    stress_factor: float = 1.0
    lift_factor: float = 1.0
    demonstrations: int = 0
    command: str = ""
    commit: str = ""

    @property
    def learns_design(self) -> bool:
        """Whether there is a design stage."""
        return bool(self.space) and not self.design

    @property
    def spaces(self) -> Spaces:
        """Sizes of what the agent sees and does."""
        size = design_space(self.space).parameter_count if self.space else 0
        return Spaces(observation=8 + size, design=size, control=7)

    @property
    def learner(self) -> Preset:
        """Settings of the learner."""
        preset = PRESETS[self.preset]
        return replace(preset, discount=self.discount) if self.discount else preset

    @property
    def weights(self) -> dict[str, float]:
        """Of the reward's `COMPONENTS`."""
        plain = RewardWeights()
        changed = replace(
            plain,
            lift=plain.lift * self.lift_factor,
            held=plain.held * self.lift_factor,
            stress=plain.stress * self.stress_factor,
        )
        return reward_weights(changed)

    def control(self) -> ControlConfig:
        """Of the environment."""
        return ControlConfig(
            tetrahedra=self.tetrahedra, friction=self.friction, pose_error=self.pose_error
        )

    def save(self, folder: Path) -> None:
        """Writes run.json."""
        write_text(folder / RUN_FILE, json.dumps(asdict(self), indent=2) + "\n")


def load_run(folder: Path) -> RunConfig:
    """Settings of the run in a folder.

    Raises:
        ValueError: no run there, or one of another release.
    """
    try:
        values = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
        named = ("design", "start", "design_direction", "friction")
        lists = {name: tuple(values.get(name, ())) for name in named}
        return RunConfig(**{**values, **lists})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{folder}: no run of this release ({error}); name the folder of a run"
        ) from None


def make_episodes(config: RunConfig, lanes: int | None = None) -> Episodes:
    """Where a run plays.

    Raises:
        ValueError: an unknown space, or a fixed design that cannot be used.
    """
    lanes = lanes or config.lanes
    if config.learns_design:
        env = CodesignEnv(config.space, lanes, config=config.control())
        return Episodes(env, COMPONENTS, METRICS, env.design_observation)
    fingers = fingers_of(config.space, config.design)
    return Episodes(GivenFingers(lanes, fingers, config.control()), COMPONENTS, METRICS)


class GivenFingers(ControlEnv):
    """Fingers that are never void: the component is there, so that all runs store the same."""

    def __init__(self, lanes: int, fingers: FingerPair, config: ControlConfig) -> None:
        super().__init__(lanes, fingers, config, AutoresetMode.DISABLED)

    def step(self, actions: np.ndarray) -> Any:
        *rest, info = super().step(actions)
        info["reward_invalid"] = np.zeros(self.num_envs)
        return *rest, info


def fingers_of(space: str, design: Sequence[float] | NDArray[np.floating]) -> FingerPair:
    """The pair of a design; the stock fingers where there is no space.

    Raises:
        ValueError: a design that cannot be printed or used.
    """
    if not space:
        return stock_fingers()
    built = built_design(space, tuple(float(value) for value in design))
    if built.fingers is None:
        raise ValueError(f"design of {space}: {'; '.join(built.problems)}")
    return built.fingers


def make_training(
    config: RunConfig, demonstrations: ReplayBuffer | None, agent: Agent | None = None
) -> Training:
    """The run of these settings, at its start.

    Args:
        config: settings.
        demonstrations: `config.demonstrations` rows of them, or None.
        agent: one that has learned before.

    Raises:
        ValueError: settings that do not belong together.
    """
    episodes = make_episodes(config)
    if agent is not None:
        agent.preset = config.learner
    start = np.array(config.start or (0.0,) * config.spaces.design)
    if agent is None:
        direction = np.array(config.design_direction) if config.design_direction else None
        agent = Agent(config.spaces, config.learner, config.seed, start, direction)
    search = None
    if config.learns_design and config.search:
        search = DesignSearch(start, config.lanes, SearchSettings(), config.seed)
    training = TrainingConfig(config.transitions, config.weights, config.seed)
    return Training(agent, episodes, training, demonstrations, search)


def principal_direction(designs: NDArray[np.floating]) -> tuple[float, ...]:
    """The direction (D,) in which designs (n, D) differ most, a unit vector.

    Raises:
        ValueError: fewer than two different designs.
    """
    apart = np.asarray(designs, np.float64) - np.mean(designs, axis=0)
    if len(apart) < 2 or not np.abs(apart).max():
        raise ValueError(
            f"{len(apart)} demonstrated designs, none different: a scalar d needs at least two"
        )
    first = np.linalg.svd(apart, full_matrices=False)[2][0]
    return tuple((first * np.sign(first[np.abs(first).argmax()])).tolist())


def shown_rows(space: str, source: str | Path | None = None) -> Demonstrations:
    """Demonstrations of a space: the shipped ones, or those of a folder.

    Raises:
        ValueError: none there, or of another space.
    """
    shown = load_demonstrations(demonstrations_path(source or space))
    if shown.space != space:
        raise ValueError(
            f"{source}: demonstrations of {shown.space}, the run is of {space}: name others, or "
            f"--space {shown.space}"
        )
    return shown
