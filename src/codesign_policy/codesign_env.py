"""The two-stage episode (paper, section II): a design becomes fingers, then they are controlled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray

from codesign_design.build import build_finger
from codesign_design.design_space import design_space
from codesign_design.finger_pair import FingerPair
from codesign_design.stock import stock_fingers
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.env_pool import PooledControlEnv
from codesign_policy.lanes import (
    FINAL_INFO,
    STEP_INFO,
    Info,
    Step,
    check_options,
    final_entries,
    set_spaces,
)
from codesign_policy.reward import RewardComponents, RewardWeights
from codesign_policy.task import design_stage_observation

COMPONENTS = (*(f.name for f in fields(RewardComponents)), "invalid")
# More than a hand costs that stays open beside the block: 6 in 200 steps, 11 at most.
INVALID_WEIGHT = 20.0
ROUNDING = 1e-6  # beyond [-1, 1], for networks in single precision
KEPT_DESIGNS = 256  # pairs in memory, about 0.3 MB each


def reward_weights(weights: RewardWeights | None = None) -> dict[str, float]:
    """A factor for each of `COMPONENTS`."""
    return {**asdict(weights or RewardWeights()), "invalid": INVALID_WEIGHT}


@dataclass(frozen=True)
class BuiltDesign:
    """What became of a design.

    Attributes:
        fingers: the pair, for a design that can be printed and used.
        problems: why it cannot; empty if it can.
    """

    fingers: FingerPair | None
    problems: tuple[str, ...] = ()


@lru_cache(maxsize=KEPT_DESIGNS)
def built_design(space: str, parameters: tuple[float, ...]) -> BuiltDesign:
    """The fingers of a design action, by the report that also decides over the real ones.

    Raises:
        ValueError: unknown space, or parameters that do not belong to it.
    """
    surface = design_space(space).surface(parameters)
    try:
        built = build_finger(surface, space, space, parameters)
    except ValueError as error:  # a surface that encloses nothing
        return BuiltDesign(None, (str(error),))
    if not built.report.valid:
        return BuiltDesign(None, tuple(built.report.problems))
    return BuiltDesign(built.pair)


class CodesignEnv(VectorEnv):
    """`ControlEnv` whose every lane has the fingers of a design of its own.

    `reset(options={"designs": (E, D)})` is the design stage: it builds the fingers and returns the
    control stage's first observations, which hold all D parameters. Lanes that end stand still.

    A design that cannot be printed or used is void: its lane terminates in its first step with all
    components zero but "invalid", -1, and success False. That is less than any fingers get that
    stay away from the block, whatever is done with them, so the design is what is to blame.

    Attributes:
        design_observation: o_D, (8 + D,), of every lane.
        designs: (E, D) of the current episodes.
        problems: per lane, why its design is void; empty if it is not.
    """

    def __init__(
        self,
        space: str,
        num_envs: int = 8,
        processes: int = 1,
        config: ControlConfig | None = None,
    ) -> None:
        """
        Args:
            space: name of the design space.
            num_envs: lanes, best a multiple of 8 in each process.
            processes: to spread the lanes over.
            config: of the control stage.

        Raises:
            ValueError: unknown space, or a setting outside its range.
        """
        count = design_space(space).parameter_count
        # Until a lane has had a valid design: a void one must have some fingers to stand still.
        fingers = replace(stock_fingers(), cage=space, parameters=(0.0,) * count)
        mode = AutoresetMode.DISABLED
        self.control: ControlEnv | PooledControlEnv = (
            ControlEnv(num_envs, fingers, config, mode)
            if processes == 1
            else PooledControlEnv(num_envs, processes, fingers, config, mode)
        )
        self.metadata = self.control.metadata
        self.space, self.num_envs, self.config = space, num_envs, self.control.config
        self.fingers = self.control.fingers
        set_spaces(self)
        self.design_observation = design_stage_observation(count)
        self.designs = np.zeros((num_envs, count))
        self.problems: list[tuple[str, ...]] = [()] * num_envs
        self._void = np.zeros(num_envs, dtype=bool)
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """The design stage, then new episodes in all lanes.

        Args:
            seed: as of `ControlEnv.reset`.
            options: "designs", (E, D) in [-1, 1]; without them the lanes keep theirs, at first
                the base mesh.

        Returns:
            Observations (E, 8 + D), and info with "episode_seed" and "design_valid", (E,) each.

        Raises:
            ValueError: another option, or designs of another shape, not finite or out of range.
        """
        super().reset(seed=seed)
        options = check_options(options, "designs")
        fingers = self._build(options.get("designs", self.designs))
        observations, info = self.control.reset(seed=seed, options={"fingers": fingers})
        self.fingers, self._begun = self.control.fingers, False
        self._first = self._with_designs(observations)
        return self._first.copy(), {**info, "design_valid": ~self._void}

    def _build(self, designs: ArrayLike) -> dict[int, FingerPair]:
        """Takes over the designs of all lanes; the fingers that are new, by lane."""
        self.designs = _checked(designs, self.designs.shape)
        built = [built_design(self.space, tuple(design)) for design in self.designs.tolist()]
        self.problems = [each.problems for each in built]
        self._void = np.array([each.fingers is None for each in built])
        return {
            lane: each.fingers
            for lane, each in enumerate(built)
            if each.fingers is not None and each.fingers is not self.fingers[lane]
        }

    def step(self, actions: NDArray[np.floating]) -> Step:
        """One control step, as `ControlEnv.step`; actions of void lanes have no effect."""
        still = np.where(self._void[:, None], 0.0, actions)
        observations, rewards, terminated, truncated, info = self.control.step(still)
        void, first = self._void, self._void & (not self._begun)
        self._begun = True
        info["reward_invalid"] = np.where(first, -1.0, 0.0)
        if not void.any():
            return observations, rewards, terminated, truncated, info
        # A void lane still has its last valid fingers; nothing of what they do is its own.
        observations = np.where(void[:, None], self._first, observations)
        for name, dtype in STEP_INFO.items():
            info[name] = np.where(void, dtype(0), info[name])
        self._end(info, first, observations)
        rewards = np.where(void, INVALID_WEIGHT * info["reward_invalid"], rewards)
        return observations, rewards, terminated | void, truncated & ~void, info

    def _end(self, info: Info, first: NDArray[np.bool_], observations: NDArray[np.float32]) -> None:
        """Ends void lanes (`first`, in their first step) in place of their fingers' episodes."""
        ended = info.pop("_final_obs", np.zeros(self.num_envs, dtype=bool)) & ~self._void
        measured = info.pop("final_info", {})
        info.pop("final_obs", None), info.pop("_final_info", None)
        if not (ended | first).any():
            return
        final = {}
        for name, dtype in FINAL_INFO.items():
            nothing = np.nan if dtype is float else dtype(name == "steps")
            values = measured.get(name, np.zeros(self.num_envs, dtype))
            final[name] = np.where(first, np.array(nothing, dtype), values)
        info.update(final_entries(ended | first, observations, final))

    def _with_designs(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Observations that hold the designs asked for, in void lanes too."""
        return np.concatenate([observations[:, :8], self.designs.astype(np.float32)], axis=1)

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the lanes' processes."""
        self.control.close(**kwargs)


def _checked(designs: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Raises: ValueError: another shape, or a parameter that is not within [-1, 1]."""
    given = np.asarray(designs, dtype=np.float64)
    if given.shape != shape:
        raise ValueError(f"designs have shape {given.shape}: give one row per lane, {shape}")
    bad = ~(np.abs(given) <= 1.0 + ROUNDING)  # so that NaN counts as bad
    if bad.any():
        lane, which = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"design of lane {lane}: parameter {which} is {given[lane, which]}; it must be within "
            "[-1, 1]: clip it"
        )
    return np.clip(given, -1.0, 1.0)
