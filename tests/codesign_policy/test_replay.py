"""Replay buffers: what goes in comes out, and sampling is unbiased."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_policy.replay import FIELDS, ReplayBuffer, Spaces, Transitions, sample_batch

SPACES = Spaces(observation=3, design=2, control=1)
NAMES = ("lift", "stress")


def rows(count: int, seed: int = 0, design_share: float = 0.2) -> Transitions:
    random = np.random.default_rng(seed)
    return Transitions(
        observation=random.normal(size=(count, 3)).astype(np.float32),
        action=random.uniform(-1.0, 1.0, (count, 3)).astype(np.float32),
        in_control=random.random(count) >= design_share,
        components=random.normal(size=(count, 2)).astype(np.float32),
        next_observation=random.normal(size=(count, 3)).astype(np.float32),
        terminated=random.random(count) < 0.1,
        truncated=random.random(count) < 0.1,
    )


def filled(count: int, capacity: int = 100, seed: int = 0) -> ReplayBuffer:
    buffer = ReplayBuffer(SPACES, NAMES, capacity)
    buffer.insert(rows(count, seed))
    return buffer


def test_idle_parts_of_actions_are_zeroed_and_the_rest_kept() -> None:
    given_rows = rows(40)
    buffer = filled(40)
    for name in FIELDS:
        if name != "action":
            np.testing.assert_array_equal(getattr(buffer.rows, name), getattr(given_rows, name))
    control = given_rows.in_control
    stored = buffer.rows.action
    assert (stored[control, :2] == 0.0).all()
    assert (stored[~control, 2:] == 0.0).all()
    np.testing.assert_array_equal(stored[control, 2:], given_rows.action[control, 2:])
    np.testing.assert_array_equal(stored[~control, :2], given_rows.action[~control, :2])


def test_idle_parts_may_hold_anything() -> None:
    """Demonstrations of others fill them with what they like."""
    buffer, odd = ReplayBuffer(SPACES, NAMES, 10), rows(10)
    odd.action[odd.in_control, :2] = np.nan
    buffer.insert(odd)
    assert np.isfinite(buffer.rows.action).all()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 9), max_size=12), st.integers(9, 20))
def test_the_newest_rows_are_kept(counts: list[int], capacity: int) -> None:
    buffer = ReplayBuffer(SPACES, NAMES, capacity)
    inserted = []
    for k, count in enumerate(counts):
        buffer.insert(rows(count, seed=k))
        inserted += list(rows(count, seed=k).observation)
    assert len(buffer) == min(len(inserted), capacity)
    newest = {tuple(o) for o in inserted[-capacity:]}
    assert {tuple(o) for o in buffer.rows.observation} == newest


def test_rewards_are_relabelled_by_weights() -> None:
    buffer = filled(20)
    lift, stress = buffer.rows.components.T
    np.testing.assert_allclose(
        buffer.reward({"lift": 1.0, "stress": 0.1}), lift + 0.1 * stress, rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(
        buffer.reward({"stress": 0.5, "lift": 1.0}), lift + 0.5 * stress, rtol=1e-5, atol=1e-6
    )
    with pytest.raises(ValueError, match="stores"):
        buffer.reward({"lift": 1.0})


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 12))
def test_importance_weights_sum_to_the_buffers_shares(seed: int, design_count: int) -> None:
    """Known without sampling: each stage's weights sum to its share of the buffer times n."""
    buffer = filled(60, seed=3)
    index, weight = buffer.draw(32, design_count, np.random.default_rng(seed))
    in_control = buffer.rows.in_control
    assert (~in_control[index]).sum() == design_count
    share = (~in_control).mean()
    assert weight[~in_control[index]].sum() == pytest.approx(32 * share, rel=1e-5)
    assert weight.sum() == pytest.approx(32, rel=1e-5)


def test_stratified_means_are_unbiased() -> None:
    """The weighted mean over many draws is the buffer's mean, within 4 standard errors."""
    buffer, random = filled(90, seed=5), np.random.default_rng(0)
    value = buffer.rows.components[:, 0].astype(np.float64)
    value[~buffer.rows.in_control] += 10.0  # stages differ much: a bias would show
    means = []
    for _ in range(3000):
        index, weight = buffer.draw(16, 8, random)
        means.append((weight * value[index]).mean())
    error = np.std(means) / np.sqrt(len(means))
    assert np.mean(means) == pytest.approx(value.mean(), abs=4.0 * error)
    unweighted = np.mean([value[buffer.draw(16, 8, random)[0]].mean() for _ in range(200)])
    assert abs(unweighted - value.mean()) > 20.0 * error


def test_a_buffer_of_one_stage_is_drawn_from_uniformly() -> None:
    buffer = ReplayBuffer(SPACES, NAMES, 50)
    buffer.insert(rows(50, design_share=0.0))
    index, weight = buffer.draw(5000, 32, np.random.default_rng(0))
    assert (weight == 1.0).all()
    assert np.bincount(index, minlength=50).min() > 50


def test_half_of_a_batch_comes_from_each_buffer() -> None:
    offline, online = filled(30, seed=1), filled(80, seed=2)
    random = np.random.default_rng(0)
    weights = {"lift": 1.0, "stress": 2.0}
    batch = sample_batch([offline, online], 64, 8, weights, random)
    known = {tuple(o) for o in offline.rows.observation}
    from_offline = np.array([tuple(o) in known for o in batch.observation.numpy()])
    assert from_offline[:32].all()
    assert not from_offline[32:].any()
    for half in (slice(0, 32), slice(32, 64)):
        assert (~batch.in_control[half]).sum() == 4
    assert batch.reward.shape == batch.weight.shape == (64,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation": np.zeros((4, 2))}, "observation has shape"),
        ({"observation": np.full((4, 3), np.nan)}, r"observation\[0, 0\] is nan"),
        ({"components": np.full((4, 2), np.inf)}, r"components\[0, 0\] is inf"),
        ({"action": np.full((4, 3), 1.5)}, "action reaches 1.5"),
        ({"terminated": np.zeros(4)}, "must be bool"),
        ({"truncated": np.zeros(3, bool)}, "truncated has shape"),
    ],
)
def test_bad_rows_are_refused_and_nothing_is_stored(change: dict, message: str) -> None:
    buffer = filled(10)
    with pytest.raises(ValueError, match=message):
        buffer.insert(replace(rows(4), **change))
    assert len(buffer) == 10


def test_too_many_rows_and_empty_draws_are_refused() -> None:
    buffer = ReplayBuffer(SPACES, NAMES, 5)
    with pytest.raises(ValueError, match="holds 5"):
        buffer.insert(rows(6))
    with pytest.raises(ValueError, match="of 0 stored"):
        buffer.draw(4, 0, np.random.default_rng(0))
    with pytest.raises(ValueError, match="multiples"):
        sample_batch([filled(9), filled(9)], 7, 0, {}, np.random.default_rng(0))


@pytest.mark.parametrize("count", [12, 45])  # partly full, and overwritten
def test_restored_buffers_go_on_alike(count: int) -> None:
    buffer = ReplayBuffer(SPACES, NAMES, 30)
    for k in range(0, count, 3):
        buffer.insert(rows(3, seed=k))
    twin = ReplayBuffer(SPACES, NAMES, 30)
    twin.restore(buffer.state())
    for mine in (buffer, twin):
        mine.insert(rows(7, seed=99))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(buffer.rows, name), getattr(twin.rows, name))


def test_restoring_other_shapes_is_refused() -> None:
    state = filled(20).state()
    with pytest.raises(ValueError, match="capacity 100: this buffer's is 50"):
        ReplayBuffer(SPACES, NAMES, 50).restore(state)
    with pytest.raises(ValueError, match="components"):
        ReplayBuffer(SPACES, ("lift", "held"), 100).restore(state)
    with pytest.raises(ValueError, match="observation has shape"):
        ReplayBuffer(Spaces(4, 2, 1), NAMES, 100).restore(state)
