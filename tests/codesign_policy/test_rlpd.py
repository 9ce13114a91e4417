"""The agent's updates, against values worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign_policy.presets import FAST, PRESETS, PUBLISHED, Preset
from codesign_policy.replay import Batch, Spaces
from codesign_policy.rlpd import LEAST_VALUE, UNIT_ENTROPY, Agent, LearningError

SPACES = Spaces(observation=4, design=3, control=2)
SMALL = replace(FAST, encoding=False, design_scale=1.0, hidden=(8,), batch_size=6, actor_period=1)


def batch(in_control: list[bool], seed: int = 0, **change: torch.Tensor) -> Batch:
    random, count = torch.Generator().manual_seed(seed), len(in_control)
    control = torch.tensor(in_control)
    action = torch.rand(count, 5, generator=random) * 2 - 1
    action[control, :3] = 0.0
    action[~control, 3:] = 0.0
    rows = Batch(
        observation=torch.randn(count, 4, generator=random),
        action=action,
        in_control=control,
        reward=torch.randn(count, generator=random),
        next_observation=torch.randn(count, 4, generator=random),
        terminated=torch.zeros(count, dtype=torch.bool),
        weight=torch.ones(count),
    )
    return replace(rows, **change)


def constant_critics(agent: Agent, values: list[float]) -> None:
    """Makes target critic k answer values[k], whatever it is asked."""
    with torch.no_grad():
        agent.target_critics.weights[-1].zero_()
        agent.target_critics.biases[-1][:, 0, 0] = torch.tensor(values)


def test_targets_of_both_stages() -> None:
    """y = r + gamma min Q': gamma 0.985 in control, 1 across the boundary, 0 where terminated."""
    agent = Agent(SPACES, SMALL, 0)
    constant_critics(agent, [5.0, 4.0])
    rows = batch(
        [True, False, True],
        reward=torch.tensor([1.0, 0.0, 2.0]),
        terminated=torch.tensor([False, False, True]),
    )
    expected = torch.tensor([1.0 + 0.985 * 4.0, 4.0, 2.0])
    torch.testing.assert_close(agent.targets(rows), expected)


def test_targets_with_backup_entropy() -> None:
    """The control actor's entropy is added to what follows; a wide Gaussian's is known."""
    preset = replace(SMALL, backup_entropy=True, control_temperature=0.2)
    agent = Agent(SPACES, preset, 0)
    constant_critics(agent, [4.0, 4.0])
    with torch.no_grad():  # mean 0, standard deviation 0.01: tanh is the identity
        last = agent.actors["control"].layers[-1]
        last.weight.zero_()
        last.bias.copy_(torch.tensor([0.0, 0.0, np.log(0.01), np.log(0.01)]))
    rows = batch([False] * 4000, reward=torch.zeros(4000))
    entropy = 2 * (0.5 * np.log(2 * np.pi * np.e) + np.log(0.01))
    # Standard error of the mean of 2 chi-squares / 2 over 4000 draws, times 0.2: 0.003.
    assert agent.targets(rows).mean().item() == pytest.approx(4.0 + 0.2 * entropy, abs=0.012)


def test_the_minimum_is_over_a_random_subset() -> None:
    """Of members 0..9, the minimum of 2 is k with probability (9 - k) / 45: mean 3 - 1/3."""
    agent = Agent(SPACES, replace(SMALL, critics=10, critic_subset=2), 0)
    constant_critics(agent, [float(k) for k in range(10)])
    rows = batch([False], reward=torch.zeros(1))
    drawn = torch.cat([agent.targets(rows) for _ in range(1500)])
    assert drawn.mean().item() == pytest.approx(8.0 / 3.0, abs=4 * drawn.std().item() / 1500**0.5)
    assert set(drawn.round().int().tolist()) == set(range(9))


def test_critic_loss_is_the_weighted_squared_error() -> None:
    agent = Agent(SPACES, SMALL, 0)
    with torch.no_grad():
        agent.critics.weights[-1].zero_()
        agent.critics.biases[-1][:, 0, 0] = torch.tensor([1.0, -1.0])
    done = torch.ones(2, dtype=torch.bool)
    rows = batch(
        [True, False],
        reward=torch.tensor([2.0, 0.0]),
        terminated=done,
        weight=torch.tensor([1.5, 0.5]),
    )
    # (1.5 ((1-2)^2 + (-1-2)^2) + 0.5 (1 + 1)) / 4
    assert agent.update(rows)["critic_loss"] == pytest.approx((1.5 * 10.0 + 0.5 * 2.0) / 4.0)


def test_target_critics_follow_by_tau() -> None:
    agent = Agent(SPACES, SMALL, 0)
    before = [p.clone() for p in agent.target_critics.parameters()]
    agent.update(batch([True] * 4))
    after = agent.target_critics.parameters()
    for old, new, critic in zip(before, after, agent.critics.parameters(), strict=True):
        torch.testing.assert_close(new, 0.99 * old + 0.01 * critic.detach())


def test_idle_numbers_get_no_gradient() -> None:
    """Weights of the idle action numbers stay as they are, to the bit, in either stage alone."""
    for in_control, idle in ((True, slice(4, 7)), (False, slice(7, 9))):
        agent = Agent(SPACES, SMALL, 0)
        before = agent.critics.weights[0].detach().clone()
        agent.update(batch([in_control] * 6))
        gradient = agent.critics.weights[0].grad
        assert gradient is not None
        assert (gradient[:, idle] == 0.0).all()
        assert torch.equal(agent.critics.weights[0][:, idle], before[:, idle])
        assert not torch.equal(agent.critics.weights[0], before)


def test_each_stage_moves_its_own_actor_only() -> None:
    for in_control, mine, other in ((True, "control", "design"), (False, "design", "control")):
        agent = Agent(SPACES, SMALL, 0)
        before = {s: [p.clone() for p in a.parameters()] for s, a in agent.actors.items()}
        log = agent.update(batch([in_control] * 6))
        moved = {
            stage: any(
                not torch.equal(old, new)
                for old, new in zip(before[stage], agent.actors[stage].parameters(), strict=True)
            )
            for stage in before
        }
        assert moved == {mine: True, other: False}
        assert f"{mine}_entropy" in log
        assert f"{other}_entropy" not in log


def test_entropies_count_only_what_acts() -> None:
    """Both entropies are those of Gaussians of known spread and of their own number of numbers."""
    agent = Agent(SPACES, replace(SMALL, design_std=0.02, learning_rate=1e-9), 0)
    with torch.no_grad():
        last = agent.actors["control"].layers[-1]
        last.weight.zero_()
        last.bias.copy_(torch.tensor([0.0, 0.0, np.log(0.01), np.log(0.01)]))
    log = agent.update(batch([True, False] * 3000))
    per_number = 0.5 * np.log(2 * np.pi * np.e)
    assert log["control_entropy"] == pytest.approx(2 * (per_number + np.log(0.01)), abs=0.08)
    assert log["design_entropy"] == pytest.approx(3 * (per_number + np.log(0.02)), abs=0.08)


def test_temperatures() -> None:
    fixed = Agent(SPACES, SMALL, 0)
    automatic = Agent(
        SPACES,
        replace(
            SMALL, design_entropy_per_parameter=-0.5, design_temperature_range=(0.0099, 0.0101)
        ),
        0,
    )
    for _ in range(60):
        for agent in (fixed, automatic):
            agent.update(batch([True, False] * 3))
    assert fixed.temperatures["design"].value() == pytest.approx(0.01)
    assert automatic.temperatures["design"].target == -1.5
    # The design's entropy, -4 nats, is below its target: up to the bound and no further.
    assert automatic.temperatures["design"].value() == pytest.approx(0.0101)
    assert fixed.temperatures["control"].value() != pytest.approx(SMALL.control_temperature)


def test_actors_learn_every_second_update_in_fast() -> None:
    agent = Agent(SPACES, replace(SMALL, actor_period=2), 0)
    logs = [agent.update(batch([True, False] * 3)) for _ in range(4)]
    assert ["control_entropy" in log for log in logs] == [False, True, False, True]


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_presets_hold_together(preset: Preset) -> None:
    assert preset.critic_subset <= preset.critics
    assert preset.batch_size % 2 == preset.design_rows % 2 == 0
    assert 16 <= preset.design_rows <= 32
    assert preset.design_std_range[0] <= preset.design_std <= preset.design_std_range[1]
    low, high = preset.design_temperature_range
    assert low <= preset.design_temperature <= high


def test_published_targets_are_half_a_nat_per_number() -> None:
    agent = Agent(Spaces(29, 21, 7), PUBLISHED, 0)
    assert agent.temperatures["design"].target == -10.5
    assert agent.temperatures["control"].target == -3.5


def test_design_chosen_by_lower_bound() -> None:
    """Known values: the higher mean loses where the critics disagree about it."""
    agent = Agent(SPACES, SMALL, 0)
    candidates = np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [-0.5, 0.5, 0.0]], np.float32)
    values = np.array([[1.0, 2.0, 6.0], [1.2, 2.0, 0.0]], np.float32)
    agent.design_values = lambda designs, observation: values  # type: ignore[method-assign]
    choice = agent.choose_design(candidates, np.zeros(4))
    np.testing.assert_allclose(choice.mean, [1.1, 2.0, 3.0])
    np.testing.assert_allclose(choice.lower_bound, [1.0, 2.0, 0.0], atol=1e-6)
    assert choice.index == 1
    np.testing.assert_array_equal(choice.design, candidates[1])


def test_design_values_are_the_critics() -> None:
    agent = Agent(SPACES, SMALL, 0)
    designs, o_d = np.full((2, 3), 0.4, np.float32), np.arange(4, dtype=np.float32)
    action = torch.tensor([[0.4, 0.4, 0.4, 0.0, 0.0]] * 2)
    expected = agent.critics(torch.tensor(o_d).expand(2, -1), action).detach().numpy()
    np.testing.assert_array_equal(agent.design_values(designs, o_d), expected)


def test_actions_are_bounded_and_exploration_is_seeded() -> None:
    observation = np.random.default_rng(0).normal(size=(5, 4))
    one, two = (Agent(SPACES, SMALL, 3) for _ in range(2))
    np.testing.assert_array_equal(
        one.act(observation, explore=True), two.act(observation, explore=True)
    )
    assert not np.array_equal(
        one.act(observation, explore=True), one.act(observation, explore=False)
    )
    designs = one.propose_designs(np.zeros((500, 4)))
    assert designs.shape == (500, 3)
    assert np.abs(designs).max() <= 1.0
    assert designs.std() == pytest.approx(0.05, rel=0.1)


def test_a_loss_that_is_not_finite_is_an_error() -> None:
    agent = Agent(SPACES, SMALL, 0)
    with pytest.raises(LearningError, match="critics is inf at update 0"):
        agent.update(batch([True] * 2, reward=torch.tensor([1e30, 0.0])))


def test_start_designs_are_checked() -> None:
    with pytest.raises(ValueError, match="3 numbers"):
        Agent(SPACES, SMALL, 0, start_design=np.zeros(2))
    with pytest.raises(ValueError, match=r"\[-1, 1\]"):
        Agent(SPACES, SMALL, 0, start_design=np.array([0.0, 2.0, 0.0]))


def test_restored_agents_go_on_alike() -> None:
    agent, rows = Agent(SPACES, SMALL, 0), batch([True, False] * 3)
    for _ in range(3):
        agent.update(rows)
    twin = Agent(SPACES, SMALL, 99)
    twin.restore(agent.state())
    for _ in range(3):
        assert agent.update(rows) == twin.update(rows)
    observation = np.zeros((2, 4))
    np.testing.assert_array_equal(
        agent.act(observation, explore=True), twin.act(observation, explore=True)
    )


def test_the_averaged_actor_is_what_is_served() -> None:
    agent = Agent(SPACES, replace(SMALL, actor_average=0.25), 0)
    before = agent.averaged.state_dict()["layers.0.bias"].clone()
    agent.update(batch([True] * 6))
    after = agent.actors["control"].state_dict()["layers.0.bias"]
    averaged = agent.averaged.state_dict()["layers.0.bias"]
    torch.testing.assert_close(averaged, 0.75 * before + 0.25 * after)
    seen = np.ones((3, 4), np.float32)
    pair = agent.pair(np.zeros(3), {})
    np.testing.assert_allclose(agent.act(seen, explore=False), pair.act(seen), atol=1e-6)
    np.testing.assert_array_equal(pair.biases[0], averaged.numpy())


def test_restoring_other_shapes_is_refused_by_name() -> None:
    state = Agent(SPACES, SMALL, 0).state()
    with pytest.raises(
        ValueError, match=r"critics\.biases\.0: stored \(2, 1, 8\), .* \(2, 1, 16\)"
    ):
        Agent(SPACES, replace(SMALL, hidden=(16,)), 0).restore(state)
    with pytest.raises(ValueError, match=r"averaged_actor\..*weight: stored \(8, 4\), .* \(8, 1\)"):
        Agent(Spaces(1, 6, 2), SMALL, 0).restore(state)


class Parabola(torch.nn.Module):
    """Two critics that value an action by its distance to one."""

    def __init__(self, best: torch.Tensor) -> None:
        super().__init__()
        self.best = best

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        value = -(action[:, 3:] - self.best).square().sum(-1)
        return value.expand(2, -1)


def test_the_actor_is_held_near_the_clone() -> None:
    """Which answers 0.5 and -0.1 everywhere; design rows do not count."""
    agent = Agent(SPACES, replace(SMALL, imitation=2.0), 0)
    agent.critics = Parabola(torch.tensor([0.5, 0.0]))  # type: ignore[assignment]
    last = agent.clone_actor.layers[-1]
    torch.nn.init.zeros_(last.weight)
    last.bias = torch.nn.Parameter(torch.atanh(torch.tensor([0.5, -0.1, 0.0, 0.0])))
    rows = batch([True, True, False, True])
    mean = torch.atanh(torch.tensor([[0.5, -0.1], [0.4, 0.1], [0.5, 0.0]]))
    value = torch.tensor([-0.25, 0.1, 0.2])  # of a size that counts as LEAST_VALUE
    loss = agent._imitation_loss(rows, rows.in_control, mean, value)
    assert loss.item() == pytest.approx(2.0 * LEAST_VALUE * (0.0 + 0.05 + 0.01) / 3, rel=1e-5)


def test_only_a_clone_imitates() -> None:
    """Without one the weight of imitation changes nothing."""
    rows = batch([True, False, True, True, False, True])
    agents = [Agent(SPACES, replace(SMALL, imitation=w), 0) for w in (0.0, 2.0)]
    for agent in agents:
        agent.update(rows)
    seen = rows.observation.numpy()
    np.testing.assert_array_equal(*(agent.act(seen, explore=False) for agent in agents))


def test_after_cloning_the_actor_rests() -> None:
    agent = Agent(SPACES, replace(SMALL, cloning=5, actor_rest=2), 0)
    rows = batch([True, False, True, True, False, True])
    seen = rows.observation.numpy()
    agent.clone(seen, np.zeros((6, 2)))
    cloned = agent.act(seen, explore=False)
    for _ in range(2):
        assert "control_entropy" not in agent.update(rows)
        np.testing.assert_array_equal(agent.act(seen, explore=False), cloned)
    assert "control_entropy" in agent.update(rows)


def test_a_clone_acts_as_demonstrated_with_the_spread_that_is_wanted() -> None:
    preset = replace(SMALL, hidden=(32,), batch_size=64, cloning=1500, control_entropy=-3.0)
    agent = Agent(SPACES, preset, 0)
    assert not agent.acts
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (200, SPACES.observation))
    shown = 0.8 * np.stack([np.sin(seen[:, 0]), seen[:, 1] ** 2], axis=1)
    assert agent.clone(seen, shown) < 0.01
    assert agent.acts
    np.testing.assert_allclose(agent.act(seen, explore=False), shown, atol=0.25)
    log_std = agent.actors["control"](agent._seen(seen))[1].detach().numpy()
    np.testing.assert_allclose(log_std, -3.0 / 2 - UNIT_ENTROPY, atol=0.5)
    assert log_std.mean() == pytest.approx(-3.0 / 2 - UNIT_ENTROPY, abs=0.1)


def test_a_clone_is_repeatable() -> None:
    seen, shown = np.linspace(-1.0, 1.0, 80).reshape(20, 4), np.zeros((20, 2))
    first, again = (Agent(SPACES, replace(SMALL, cloning=20), 3) for _ in range(2))
    assert first.clone(seen, shown) == again.clone(seen, shown)
    np.testing.assert_array_equal(first.act(seen, explore=False), again.act(seen, explore=False))


def test_a_scalar_d_is_the_component_in_one_direction() -> None:
    """Observations that differ across the direction alone look the same to every network."""
    direction = np.array([0.6, 0.8, 0.0])
    agent = Agent(SPACES, SMALL, 0, design_direction=direction)
    here = np.array([0.3, 0.1, 0.2, 0.5], np.float32)
    across = here + np.array([0.0, -0.8, 0.6, 0.4], np.float32)
    along = here + np.array([0.0, 0.6, 0.8, 0.0], np.float32)
    actions = agent.act(np.stack([here, across, along]), explore=False)
    np.testing.assert_allclose(actions[0], actions[1], atol=1e-6)
    assert np.abs(actions[0] - actions[2]).max() > 1e-3
    designs = np.zeros((1, 3), np.float32)
    values = [agent.design_values(designs, seen) for seen in (here, across)]
    np.testing.assert_allclose(*values, atol=1e-5)


def test_a_pair_with_a_scalar_d_takes_whole_observations() -> None:
    agent = Agent(SPACES, SMALL, 0, design_direction=np.array([0.6, 0.8, 0.0]))
    agent.update(batch([True, False, True, True, False, True]))
    pair = agent.pair(np.zeros(3), {})
    seen = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    np.testing.assert_allclose(pair.act(seen), agent.act(seen, explore=False), atol=1e-6)


@pytest.mark.parametrize("direction", [None, np.array([0.6, 0.8, 0.0])])
def test_designs_are_seen_enlarged_from_the_start(direction: np.ndarray | None) -> None:
    """And a pair that is served takes them as they are."""
    start = np.array([0.3, -0.2, 0.1])
    large = replace(SMALL, design_scale=10.0)
    agent, plain = (
        Agent(SPACES, preset, 0, start, direction)
        for preset in (large, replace(SMALL, design_scale=1.0))
    )
    step = np.array([0.02, 0.01, -0.03])
    o = np.array([[0.5, *start], [0.5, *(start + step)]], np.float32)
    far = np.array([o[0], [0.5, *(start + 10.0 * step)]], np.float32)
    np.testing.assert_allclose(agent._seen(o), plain._seen(far), atol=1e-6)
    agent.update(batch([True, False, True, True, False, True]))
    seen = agent.act(o, explore=False)
    np.testing.assert_allclose(agent.pair(start, {}).act(o), seen, atol=1e-6)
    assert np.abs(seen[0] - seen[1]).max() > 1e-4


def test_design_directions_are_checked() -> None:
    with pytest.raises(ValueError, match="must be 3 numbers"):
        Agent(SPACES, SMALL, 0, design_direction=np.ones(2))
