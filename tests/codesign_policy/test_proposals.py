"""The search for designs, on outcomes with a known optimum."""

import numpy as np
import pytest

from codesign_policy.proposals import DESIGN_BOUND, DesignSearch, SearchSettings, fitness

LANES = 12
SETTINGS = SearchSettings(rounds=2, practice=3, spread=0.05)
START = np.array([0.0, 0.4, 0.1, 0.0])
OPTIMUM = np.array([0.05, 0.3, 0.1, -0.1])


def search(seed: int = 0) -> DesignSearch:
    return DesignSearch(START, LANES, SETTINGS, seed)


def outcome(designs: np.ndarray) -> dict[str, np.ndarray]:
    """All succeed; stress grows with the squared distance to the optimum."""
    away = ((designs - OPTIMUM) ** 2).sum(axis=1)
    return {
        "success": np.ones(len(designs)),
        "peak_lift": np.full(len(designs), 0.1),
        "top10_stress": 500.0 + 500.0 * away,
        "median_stress": 200.0 + 500.0 * away,
    }


def play(found: DesignSearch, rounds: int) -> None:
    for _ in range(rounds):
        found.judge(outcome(found.propose()))


def test_designs_scatter_around_the_start() -> None:
    designs = search().propose()
    np.testing.assert_array_equal(designs[0], START.astype(np.float32))
    # 44 normal numbers: their root mean square is within 3 sigma / sqrt(88) of the spread.
    assert np.sqrt(((designs[1:] - START) ** 2).mean()) == pytest.approx(0.05, rel=0.33)


def test_a_generation_is_kept_for_its_rounds() -> None:
    found = search()
    first = found.propose()
    play(found, 1)
    np.testing.assert_array_equal(found.propose(), first)
    play(found, 1)
    assert not np.array_equal(found.propose(), first)
    assert len(found.generations) == 1


def test_the_start_is_left_after_practice() -> None:
    found = search()
    play(found, SETTINGS.rounds * SETTINGS.practice)
    np.testing.assert_array_equal(found.centre, START.astype(np.float32))
    play(found, SETTINGS.rounds)
    assert not np.array_equal(found.centre, START.astype(np.float32))


def test_it_finds_the_optimum() -> None:
    found = search()
    play(found, SETTINGS.rounds * (SETTINGS.practice + 40))
    # The start is 0.15 away from it.
    assert np.linalg.norm(found.centre - OPTIMUM) < 0.01
    best = found.best(3)
    assert len(best) == 3
    assert all(np.linalg.norm(design - OPTIMUM) < 0.05 for design in best)


def test_designs_stay_within_their_bounds() -> None:
    found = DesignSearch(np.full(4, 0.89), LANES, SETTINGS, 1)
    for _ in range(20):
        designs = found.propose()
        assert np.abs(designs).max() <= DESIGN_BOUND + 1e-6
        found.judge(outcome(-designs))


@pytest.mark.parametrize("rounds", [1, 5, 9])  # during practice, and after it
def test_a_restored_search_goes_on_alike(rounds: int) -> None:
    whole, again = search(), search()
    play(whole, rounds)
    again.restore(whole.state())
    for _ in range(6):
        np.testing.assert_array_equal(again.propose(), whole.propose())
        play(whole, 1)
        play(again, 1)


def test_fitness_is_success_lift_and_stress() -> None:
    found = fitness(
        {
            "success": np.array([1.0, 0.0, 0.0, 0.0]),
            "peak_lift": np.array([0.1, 0.04, 0.0, np.nan]),
            "top10_stress": np.array([600.0, 900.0, 9000.0, np.nan]),
            "median_stress": np.array([200.0, 500.0, 900.0, np.nan]),
        }
    )
    kpa = [0.8 * 0.6 + 0.2 * 0.2, 0.8 * 0.9 + 0.2 * 0.5, 0.8 * 9.0 + 0.2 * 0.9]  # as equation 1
    cost = [1.5 * stress / (1.0 + stress) for stress in kpa]
    np.testing.assert_allclose(found, [1.5 - cost[0], 0.25 - cost[1], -cost[2], -1.5])
