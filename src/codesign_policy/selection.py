"""The design that a run ends with: searched for and proposed by the critics, decided by simulation.

While a run learns, its controller changes and explores, so that outcomes say little about small
differences between designs. When it has learned, the search goes on with the controller as it is.
Candidates are the demonstrated designs, where both searches end and what they found best, and what
the critics vouch for most among many drawn around these (lower-confidence bound over the ensemble).
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codesign_policy.codesign_env import COMPONENTS, CodesignEnv, built_design
from codesign_policy.proposals import DESIGN_BOUND, DesignSearch, SearchSettings, fitness
from codesign_policy.replay import ReplayBuffer
from codesign_policy.rounds import Episodes, play_round
from codesign_policy.run import METRICS, RunConfig, make_episodes
from codesign_policy.training import Training

FINE = 2400  # tetrahedra: optima of the coarse block sit at the slip threshold
EPISODES = 16  # of every candidate
SHOWN = 3  # demonstrated designs
KEPT = 3  # candidates of each kind
DRAWN = 512  # around the candidates, for the critics to choose from
REFINING = SearchSettings(practice=0)  # once the controller is as it is
GENERATIONS = 6  # of that search
_SHARE = 0.6  # of the time that it takes, for progress


@dataclass(frozen=True)
class Candidate:
    """A design and how it did with the trained controller.

    Attributes:
        origin: "demonstrated", "search", "tried", "refined" or "critics".
        design: (D,) in [-1, 1].
        lower_bound: of its value, mean minus standard deviation over the critics.
        success: share of episodes.
        top10_stress, median_stress: means over the episodes [Pa]; NaN if it never touched.
        fitness: mean over the episodes.
    """

    origin: str
    design: tuple[float, ...]
    lower_bound: float
    success: float
    top10_stress: float
    median_stress: float
    fitness: float

    def as_json(self) -> dict[str, object]:
        """Plain values; None for NaN."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


def select_design(
    training: Training,
    config: RunConfig,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Candidate]:
    """Judges candidates in the simulator; the best comes first.

    Args:
        training: a run that has learned designs.
        config: its settings.
        progress: told the share that is done.

    Raises:
        ValueError: no candidate can be printed and used.
    """
    fine = make_episodes(replace(config, tetrahedra=FINE))
    refined = refine(training, fine, lambda share: progress(_SHARE * share))
    fine.environment.close()
    found = _candidates(training, config, refined)
    named = [(o, d) for o, d in found if _usable(config.space, d)]
    if not named:
        raise ValueError("no candidate design can be printed and used: train longer")
    designs = np.array([design for _, design in named])
    observation = training.episodes.design_observation
    assert observation is not None
    bounds = training.agent.choose_design(designs, observation).lower_bound
    judged = []

    def outcome_progress(share: float) -> None:
        progress(_SHARE + (1.0 - _SHARE) * share)

    for k, metrics in enumerate(_outcomes(training, config, designs, outcome_progress)):
        judged.append(
            Candidate(
                origin=named[k][0],
                design=tuple(float(value) for value in designs[k]),
                lower_bound=float(bounds[k]),
                success=float(metrics["success"].mean()),
                top10_stress=_mean(metrics["top10_stress"]),
                median_stress=_mean(metrics["median_stress"]),
                fitness=float(fitness(metrics).mean()),
            )
        )
    return sorted(judged, key=lambda candidate: -candidate.fitness)


def refine(
    training: Training,
    episodes: Episodes,
    progress: Callable[[float], None] = lambda share: None,
    generations: int = GENERATIONS,
) -> DesignSearch:
    """Searches on from where the run's search stands, with the controller's mean actions.

    Args:
        training: a run that has learned designs.
        episodes: with a design stage, where it searches: with the block that is judged on.
        progress: told the share that is done.
        generations: of the search, each two episodes per lane.
    """
    search, lanes = training.proposer, episodes.environment.num_envs
    if isinstance(search, DesignSearch):
        start = search.centre
    else:
        start = np.tanh(training.agent.actors["design"].mean.detach().numpy())  # type: ignore
    refined = DesignSearch(start, lanes, REFINING, training.config.seed)
    rounds = generations * REFINING.rounds
    rows = ReplayBuffer(training.agent.spaces, episodes.components, lanes)  # nobody reads them
    for k in range(rounds):
        played = play_round(episodes, lanes * k, training.act, rows, refined.propose())
        refined.judge(played.metrics)
        progress((k + 1) / rounds)
    return refined


def _candidates(
    training: Training, config: RunConfig, refined: DesignSearch
) -> list[tuple[str, NDArray[np.float32]]]:
    observation = training.episodes.design_observation
    assert observation is not None
    found: list[tuple[str, NDArray[np.float32]]] = []
    if training.demonstrations is not None:
        shown = training.demonstrations.designs[:SHOWN]  # what follows is practice
        found += [("demonstrated", design) for design in shown]
    search = training.proposer
    if isinstance(search, DesignSearch):
        found.append(("search", search.centre))
        found += [("tried", design) for design in search.best(KEPT)]
    else:
        drawn = training.agent.propose_designs(np.tile(observation, (KEPT, 1)))
        found += [("search", design) for design in drawn]
    found += [("refined", design) for design in (refined.centre, *refined.best(KEPT))]
    random = np.random.default_rng([config.seed, 3])
    centres = np.array([design for _, design in found])
    noise = random.normal(scale=SearchSettings().spread, size=(DRAWN, centres.shape[1]))
    around = np.clip(centres[np.arange(DRAWN) % len(centres)] + noise, -DESIGN_BOUND, DESIGN_BOUND)
    bound = training.agent.choose_design(around, observation).lower_bound
    best = np.argsort(-bound)[:KEPT]
    return found + [("critics", around[k].astype(np.float32)) for k in best]


def _usable(space: str, design: NDArray[np.float32]) -> bool:
    return built_design(space, tuple(design.astype(np.float64).tolist())).fingers is not None


def _outcomes(
    training: Training,
    config: RunConfig,
    designs: NDArray[np.float32],
    progress: Callable[[float], None],
) -> list[dict[str, NDArray[np.float64]]]:
    """Metrics of `EPISODES` episodes with each design and the mean action, the same blocks."""
    lanes = 8
    fine = replace(config, tetrahedra=FINE).control()
    env = CodesignEnv(config.space, lanes, config=fine)
    episodes = Episodes(env, COMPONENTS, METRICS, env.design_observation)
    outcomes = []
    for k, design in enumerate(designs):
        rounds: list[dict[str, NDArray[np.float64]]] = []
        for start in range(0, EPISODES, lanes):
            rows = ReplayBuffer(config.spaces, COMPONENTS, lanes * (1 + fine.episode_steps))
            played = play_round(episodes, start, training.act, rows, np.tile(design, (lanes, 1)))
            rounds.append(played.metrics)
            progress((k + (start + lanes) / EPISODES) / len(designs))
        outcomes.append({name: _joined(rounds, name) for name in METRICS})
    env.close()
    return outcomes


def _joined(rounds: Sequence[dict[str, NDArray[np.float64]]], name: str) -> NDArray[np.float64]:
    return np.concatenate([metrics[name] for metrics in rounds])


def _mean(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")
