"""The control stage as a Gymnasium vector environment over the simulator (docs/environment.md)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_policy.domain import FRICTION, TrialDomain, domain_corners, draw_domain
from codesign_policy.episode import EpisodeLog, Measured, measure, step_components
from codesign_policy.lanes import (
    FINAL_INFO,
    STEP_INFO,
    Info,
    Lanes,
    Step,
    check_options,
    check_swap,
    episode_seed,
    final_entries,
    per_lane,
    set_spaces,
    swapped,
)
from codesign_policy.reward import RewardComponents, RewardWeights, weighted
from codesign_policy.simulated_fingers import lip, simulated_fingers
from codesign_policy.task import (
    CONTROL_STAGE,
    EPISODE_STEPS,
    POLICY_PERIOD,
    normalised_observations,
    scaled_actions,
)
from codesign_policy.tool import Tool, ToolStart
from codesign_sim import Block, Material, Simulator, SurfaceMesh
from codesign_sim.material import stable_time_step
from codesign_sim.rest import RestShapes
from codesign_sim.simulator import CONTACT_STIFFNESS, SAFETY, STIFFNESS_DAMPING

LAG = 0.055  # s: what fits the graph's servo and simulated arm, stepped at 10 ms, best
MIN_GAP = 0.010  # m
TABLE_HEIGHT = 0.0  # m, in link_base
LARGEST_POSE_ERROR = 0.02  # m


@dataclass(frozen=True)
class ControlConfig:
    """Settings of the control stage.

    Attributes:
        tetrahedra: resolution of the block, 600 or 2400.
        episode_steps: control steps after which an episode is truncated.
        weights: of the reward's components.
        domain: material and place that are fixed; what is NaN is drawn for every episode.
        friction: range that friction is drawn from.
        pose_error: how far off the object is observed, horizontally, in a direction drawn for every
            episode [m]: a camera's error of calibration.
        start: where the tool begins.
        lag: time constant with which the tool follows its commands [s].
        min_gap: smallest gap between the fingers' pads that can be commanded [m]; the gap itself
            is that between their most protruding points, such as lips.
        end_when_lost: terminate an episode once the lifted object is no longer touched.
    """

    tetrahedra: int = 600
    episode_steps: int = EPISODE_STEPS
    weights: RewardWeights = field(default_factory=RewardWeights)
    domain: TrialDomain = field(default_factory=TrialDomain)
    friction: tuple[float, float] = (FRICTION, FRICTION)
    pose_error: float = 0.0
    start: ToolStart = field(default_factory=ToolStart)
    lag: float = LAG
    min_gap: float = MIN_GAP
    end_when_lost: bool = False


class ControlEnv(VectorEnv):
    """Picks up tofu in `num_envs` lanes at once, 20 control steps a second.

    Observations (E, 8 + D) and actions (E, 7) are those of `task.py`, normalised. Every step's
    info holds arrays (E,): the unweighted components of the reward, stresses, forces and speeds.

    With `AutoresetMode.SAME_STEP` a lane that ends starts its next episode within the same step:
    the observation returned is the new episode's first, the old one's last is in
    `info["final_obs"]` and its metrics in `info["final_info"]`, each with a mask under the same
    name with an underscore. All other arrays describe the step that was made. With `DISABLED` a
    lane that has ended stands still and ignores its action until it is reset with
    `options={"reset_mask": (E,) bool}`.

    Equal seeds and actions give equal bits, whatever the neighbours do and however many lanes
    there are; only fewer than four lanes, which the simulator lays out otherwise, differ from
    more of them in the last digits.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 8,
        fingers: FingerPair | Sequence[FingerPair] | None = None,
        config: ControlConfig | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        """Settles the block for the corners of the domain, which takes 0.2-0.5 s.

        Args:
            num_envs: lanes, best a multiple of 8.
            fingers: one pair for all, or one per lane, with as many design parameters each; None
                for the stock fingers.
            config: settings.
            autoreset_mode: SAME_STEP or DISABLED.

        Raises:
            ValueError: a setting outside its range.
        """
        if autoreset_mode is AutoresetMode.NEXT_STEP:
            raise ValueError("autoreset_mode is NEXT_STEP: choose SAME_STEP or DISABLED")
        self.config = config = config or ControlConfig()
        if not 0.0 <= config.pose_error <= LARGEST_POSE_ERROR:
            raise ValueError(
                f"pose_error is {config.pose_error} m: give 0 to {LARGEST_POSE_ERROR} m"
            )
        self.num_envs = num_envs
        self.autoreset_mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.fingers = per_lane(fingers, num_envs)
        set_spaces(self)
        self._make_simulator()
        self._tool = Tool(num_envs, config.lag, TABLE_HEIGHT)
        self._tell_tool(range(num_envs))
        self._log = EpisodeLog(num_envs, config.episode_steps)
        self._lane_seeds = np.zeros(num_envs, dtype=np.int64)
        self._episodes = np.full(num_envs, -1)
        self._ended = np.ones(num_envs, dtype=bool)
        self.episode_seeds = np.zeros(num_envs, dtype=np.int64)
        self._pose_errors = np.zeros((num_envs, 3))
        self.domains = [config.domain] * num_envs

    def _make_simulator(self) -> None:
        block = Block.tofu(self.config.tetrahedra)
        low, high = domain_corners(self.config.domain, self.config.friction)
        stiffest = Material(high.young_modulus, high.poisson_ratio, low.density, high.friction)
        limit = stable_time_step(block, stiffest, CONTACT_STIFFNESS, STIFFNESS_DAMPING)
        # One time step for every material: a lane must not depend on what its neighbours hold.
        self.simulator = Simulator(
            block,
            _surfaces(self.fingers),
            self.num_envs,
            time_step=SAFETY * limit,
            table_height=TABLE_HEIGHT,
        )
        self._rest = RestShapes(
            block,
            (low.young_modulus, high.young_modulus),
            (low.poisson_ratio, high.poisson_ratio),
            (low.friction, high.friction),
            low.density,
        )

    # ------------------------------------------------------------------ reset

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """Starts new episodes.

        Args:
            seed: lane i draws its first episode from seed + i, as a trial of the graph with that
                seed does, and later ones from that seed and their number. None goes on with the
                next episode of every lane; at the first reset it stands for a random seed.
            options: "reset_mask", (E,) bool: only these lanes; the others keep their state.
                "fingers", {lane: FingerPair}: new fingers for lanes that are reset.

        Raises:
            ValueError: another option, or lanes and fingers that do not belong together.
        """
        super().reset(seed=seed)
        options = check_options(options, "reset_mask", "fingers")
        lanes = self._chosen(options)
        self._swap_fingers(options.get("fingers", {}), lanes)
        if seed is None and (self._episodes[lanes] < 0).any():
            seed = int(self.np_random.integers(2**31))
        if seed is not None:
            self._lane_seeds[lanes] = seed + lanes
            self._episodes[lanes] = -1
        self._start(lanes)
        return self._observations(), {"episode_seed": self.episode_seeds.copy()}

    def _chosen(self, options: Mapping[str, Any]) -> Lanes:
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask {mask}: give {self.num_envs} flags, at least one True")
        if not mask.all() and (self._episodes[~mask] < 0).any():
            raise ValueError("reset_mask leaves lanes out that were never reset: reset all first")
        return np.flatnonzero(mask)

    def _swap_fingers(self, fingers: Mapping[int, FingerPair], lanes: Lanes) -> None:
        if not check_swap(fingers, lanes):
            return
        self.fingers = swapped(self.fingers, fingers)
        chosen = sorted(fingers)
        pairs = _surfaces([fingers[lane] for lane in chosen])
        left, right = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        with warnings.catch_warnings():  # of thin walls, thousands of times: designs come and go
            warnings.simplefilter("ignore", UserWarning)
            self.simulator.set_fingers(left, right, chosen)
        self._tell_tool(chosen)

    def _tell_tool(self, lanes: Sequence[int]) -> None:
        limits = self.simulator.closing_limits
        for lane in lanes:
            between_lips = self.config.min_gap - 2.0 * lip(self.fingers[lane])
            narrowest = max(between_lips, float(limits[lane]))
            self._tool.set_fingers(lane, self.fingers[lane], narrowest)

    def _start(self, lanes: Lanes) -> None:
        """New episodes in these lanes."""
        self._episodes[lanes] += 1
        for lane in lanes:
            self.episode_seeds[lane] = seed = episode_seed(
                int(self._lane_seeds[lane]), int(self._episodes[lane])
            )
            self.domains[lane] = draw_domain(seed, self.config.domain, self.config.friction)
            self._pose_errors[lane] = _pose_error(seed, self.config.pose_error)
        self._tool.reset(lanes, self.config.start)
        self._place_blocks(lanes)
        self._measured = measure(self.simulator)
        self._log.start(lanes, self._measured)
        self._ended[lanes] = False

    def _place_blocks(self, lanes: Lanes) -> None:
        domains = [self.domains[lane] for lane in lanes]
        materials = [_material(domain) for domain in domains]
        if len(lanes) == self.num_envs:  # the first time, or after an error
            self.simulator.reset(materials, fingers=self._tool.targets(), settle=False)
        self.simulator.reset_some(
            lanes,
            materials,
            self._rest.of(materials),
            position=np.array([(domain.x, domain.y) for domain in domains]),
            yaw=np.array([domain.yaw for domain in domains]),
            fingers=self._tool.targets(lanes),
        )

    # ------------------------------------------------------------------- step

    def step(self, actions: NDArray[np.floating]) -> Step:
        """One control step of 50 ms.

        Raises:
            ValueError: an action that is not finite or beyond [-1, 1], naming the lane.
            SimulationError: the state stopped being finite.
        """
        if (self._episodes < 0).any():
            raise RuntimeError("step before the first reset: call reset()")
        increments = scaled_actions(actions, self.num_envs)
        active = np.flatnonzero(~self._ended)
        increments[self._ended] = 0.0
        self._tool.move(increments)
        self.simulator.advance(POLICY_PERIOD, self._tool.targets())
        self._measured = measure(self.simulator)
        self._log.add(active, self._measured)
        components = step_components(
            self._log,
            self._measured,
            self._tool.position,
            self._tool.opening,
            increments[:, 3:6],
        )
        rewards = np.where(self._ended, 0.0, weighted(components, self.config.weights))
        truncated = self._log.steps >= self.config.episode_steps
        terminated = self._log.lost & self.config.end_when_lost
        info = self._info(components, self._measured)
        ending = np.flatnonzero((truncated | terminated) & ~self._ended)
        self._ended[ending] = True
        if len(ending):
            self._finish(ending, info)
        return self._observations(), rewards, terminated, truncated, info

    def _info(self, components: RewardComponents, measured: Measured) -> Info:
        values = {
            **vars(measured),
            **{f"reward_{name}": value for name, value in vars(components).items()},
            "rise": self._log.rise.copy(),
            "contact": self._log.touching.copy(),
            "success": self._log.success,
        }
        return {name: values[name] for name in STEP_INFO}

    def _finish(self, lanes: Lanes, info: Info) -> None:
        """Judges the episodes that end and, in SAME_STEP mode, starts the next ones."""
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[lanes] = True
        info.update(final_entries(mask, self._observations(), self._judge(lanes)))
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._start(lanes)

    def _judge(self, lanes: Lanes) -> dict[str, NDArray]:
        """FINAL_INFO of the episodes in these lanes, (E,) each."""
        final: dict[str, NDArray] = {
            name: np.zeros(self.num_envs, dtype) for name, dtype in FINAL_INFO.items()
        }
        final["steps"][lanes] = self._log.steps[lanes]
        final["episode_seed"][lanes] = self.episode_seeds[lanes]
        for lane in lanes:
            for name, value in vars(self._log.metrics(lane)).items():
                final[name][lane] = value
        return final

    # ------------------------------------------------------------ observation

    def _observations(self) -> NDArray[np.float32]:
        stage = np.full((self.num_envs, 1), CONTROL_STAGE)
        vectors = np.concatenate(
            [
                self._tool.position,
                self._measured.centre + self._pose_errors,
                self._tool.width[:, None],
                stage,
                np.array([pair.parameters for pair in self.fingers]).reshape(self.num_envs, -1),
            ],
            axis=1,
        )
        return normalised_observations(vectors).astype(np.float32)


def _material(domain: TrialDomain) -> Material:
    return Material(
        young_modulus=domain.young_modulus,
        poisson_ratio=domain.poisson_ratio,
        density=domain.density,
        friction=domain.friction,
    )


def _pose_error(seed: int, length: float) -> NDArray[np.float64]:
    """A horizontal vector of this length whose direction the seed draws, apart from the domain."""
    angle = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi)
    return length * np.array([np.cos(angle), np.sin(angle), 0.0])


def _surfaces(fingers: Sequence[FingerPair]) -> list[tuple[SurfaceMesh, SurfaceMesh]]:
    """Each pair as the simulator's surfaces; lanes with the same pair share them."""
    different = {id(pair): pair for pair in fingers}
    shapes = {key: simulated_fingers(pair) for key, pair in different.items()}
    return [shapes[id(pair)] for pair in fingers]
