"""Policy gradients through the model: against autograd, with limits, and as an update."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import (
    AnalyticConfig,
    AnalyticUpdate,
    Draws,
    TD3Config,
    act,
    make_td3_loss,
)
from phihp_torchrl.agents.analytic import (
    followed,
    imagine_step,
    lambda_returns,
    limited,
    pull_step,
    state_values,
)
from phihp_torchrl.dynamics import TaskWorldModel

PENDULUM = get_task("pendulum")
GAMMA, STEPS, WORLDS = 0.9, 5, 6
CONFIG = AnalyticConfig(horizon=STEPS, critic_updates=3, noise=0.2)
NO_LIMIT = torch.tensor(math.inf)
TD3 = TD3Config(actor_hidden_sizes=(16,), critic_hidden_sizes=(16,), last_layer_scale=1.0)


def make_update(task=PENDULUM, config=CONFIG, dynamics=None, compile=False) -> AnalyticUpdate:
    torch.manual_seed(0)
    dynamics = HybridDynamics.hybrid(task) if dynamics is None else dynamics
    model = TaskWorldModel(task, dynamics)
    return AnalyticUpdate(make_td3_loss(model, TD3), model, config, GAMMA, compile=compile)


def draws(task=PENDULUM, seed=1, steps=STEPS) -> tuple[torch.Tensor, Draws]:
    generator = torch.Generator().manual_seed(seed)
    state = task.coverage.sample([WORLDS], generator=generator)
    starts = task.coverage.sample([steps, WORLDS], generator=generator)
    noise = 0.2 * torch.randn(steps, WORLDS, task.action_dim, generator=generator)
    return state, Draws(starts, noise, torch.randperm(steps * WORLDS, generator=generator))


def rolled(update, actor, state, noise, horizon=STEPS):
    """States, and the discounted return with the critics' value beyond, by plain code."""
    bounds, states, total = update.bounds, [], 0.0
    value_actor = [layer.detach() for layer in actor]
    for t in range(horizon):
        states.append(state)
        step = imagine_step(update.world_model, actor, state, noise[t], bounds)
        total = total + GAMMA**t * step.reward
        state = step.next_state
    tail = state_values(update.world_model, value_actor, update.critics, state, bounds)
    return states, total + GAMMA**horizon * tail


def pulled(update, states, noise, limit=NO_LIMIT, beyond=None):
    """The gradients of the returns by the actions, and which were limited, last step first."""
    bounds, adjoint = update.bounds, beyond
    gradients, hits = [], []
    for state, each in zip(reversed(states), noise.flip(0), strict=True):
        adjoint, gradient, hit = pull_step(
            update.world_model, update.actor, state, each, GAMMA * adjoint, limit, bounds
        )
        gradients.append(gradient)
        hits.append(hit)
    return gradients, hits, adjoint


def value_slope(update, state):
    values = lambda s: state_values(  # noqa: E731
        update.world_model, update.actor, update.critics, s, update.bounds
    )
    return torch.func.grad(lambda s: values(s).sum())(state)


def test_the_gradient_is_autograds():
    update = make_update()
    state, drawn = draws()
    with torch.no_grad():
        states, _ = rolled(update, update.actor, state, drawn.noise)
        last = imagine_step(
            update.world_model, update.actor, states[-1], drawn.noise[-1], update.bounds
        ).next_state
    gradients, hits, adjoint = pulled(update, states, drawn.noise, beyond=value_slope(update, last))
    assert not torch.stack(hits).any()
    leaf = state.clone().requires_grad_()
    rolled(update, update.actor, leaf, drawn.noise)[1].sum().backward()
    torch.testing.assert_close(adjoint, leaf.grad, rtol=1e-4, atol=1e-5)

    # Step by step the actor follows the return from there on, which autograd finds as well.
    expected = [torch.zeros_like(layer) for layer in update.actor]
    for t, start in enumerate(states):
        actor = [layer.clone().requires_grad_() for layer in update.actor]
        step = imagine_step(update.world_model, actor, start, drawn.noise[t], update.bounds)
        rest = rolled(update, update.actor, step.next_state, drawn.noise[t + 1 :], STEPS - t - 1)[1]
        (-(step.reward + GAMMA * rest).sum() / (STEPS * WORLDS)).backward()
        expected = [e + layer.grad for e, layer in zip(expected, actor, strict=True)]
    ours = torch.func.grad(followed)(
        update.actor,
        update.world_model.observe(torch.cat(states)),
        drawn.noise.flatten(0, 1),
        torch.cat(gradients[::-1]),
        update.bounds,
        torch.tensor(0.0),
    )
    for mine, theirs in zip(ours, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def test_no_action_claims_more_than_the_limit():
    update = make_update()
    state, drawn = draws()
    with torch.no_grad():
        states, _ = rolled(update, update.actor, state, drawn.noise)
    steep = torch.full_like(state, 1e6)
    free, _, _ = pulled(update, states, drawn.noise, beyond=steep)
    sizes = torch.stack([(g * update.bounds.scale).norm(dim=-1) for g in free])
    assert sizes.min() > 3.0
    kept, hits, _ = pulled(update, states, drawn.noise, torch.tensor(3.0), steep)
    sizes = torch.stack([(g * update.bounds.scale).norm(dim=-1) for g in kept])
    assert sizes.max() <= 3.0 * (1 + 1e-5)
    assert hits[0].all()
    cosine = torch.nn.functional.cosine_similarity(kept[0], free[0])
    torch.testing.assert_close(cosine, torch.ones(WORLDS))


def test_rows_that_are_not_finite_are_left_out_alone():
    update = make_update()
    state, drawn = draws()
    beyond = torch.ones_like(state)
    pull = lambda adjoint: pull_step(  # noqa: E731
        update.world_model, update.actor, state, drawn.noise[0], adjoint, NO_LIMIT, update.bounds
    )
    good = pull(beyond)
    wild = beyond.clone()
    wild[2] = math.nan
    adjoint, gradient, hit = pull(wild)
    assert hit.tolist() == [False, False, True, False, False, False]
    assert (adjoint[2] == 0).all()
    assert (gradient[2] == 0).all()
    others = ~hit
    assert torch.equal(gradient[others], good[1][others])


def test_lambda_returns_are_those_of_the_definition():
    generator = torch.Generator().manual_seed(0)
    reward, value = torch.rand(2, 4, 3, generator=generator)
    ended = torch.zeros(4, 3, dtype=torch.bool)
    ended[1, 0] = ended[3, 1] = True
    found = lambda_returns(reward, value, ended, GAMMA, 0.7)
    for world in range(3):
        after = value[3, world]
        for t in (3, 2, 1, 0):
            mixed = 0.3 * value[t, world] + 0.7 * after
            after = reward[t, world] + GAMMA * (0.0 if ended[t, world] else 1.0) * mixed
            torch.testing.assert_close(found[t, world], after)


def test_gradients_are_scaled_down_or_dropped():
    layers = [torch.full((2, 2), 3.0), torch.zeros(2)]
    small, norm = limited(layers, 3.0)
    assert norm.item() == pytest.approx(6.0)
    torch.testing.assert_close(small[0], torch.full((2, 2), 1.5))
    kept, _ = limited(layers, 10.0)
    assert torch.equal(kept[0], layers[0])
    none, _ = limited([torch.tensor([math.nan]), torch.ones(2)], 1.0)
    assert torch.equal(torch.cat(none), torch.zeros(3))


def test_terminations_cut_the_gradient_and_start_the_world_anew():
    ends = replace(PENDULUM, terminated=lambda state: torch.ones_like(state[..., 0]).bool())
    update = make_update(ends)
    state, drawn = draws()
    batch, state, _ = update(state, drawn)
    assert batch.terminated.all()
    assert torch.equal(state, drawn.start_states[-1])
    assert torch.equal(batch.state[WORLDS:], drawn.start_states[:-1].flatten(0, 1))


def test_a_model_that_explodes_leaves_the_networks_finite():
    class Explosive(torch.nn.Module):
        def forward(self, state, action):
            return torch.full_like(state, math.nan) * action

    update = make_update(config=replace(CONFIG, entropy=0.0), dynamics=Explosive())
    before = [layer.clone() for layer in update.actor]
    _, state, metrics = update(*draws())
    assert state.isfinite().all()
    assert all(layer.isfinite().all() for layer in (*update.actor, *update.critics))
    assert all(torch.equal(a, b) for a, b in zip(before, update.actor, strict=True))
    assert metrics["limited_share"] == 1


def test_the_actor_follows_the_reward():
    task = replace(PENDULUM, reward=lambda s, a, n: -(a[..., 0] - 1.0).square())
    update = make_update(task, replace(CONFIG, actor_learning_rate=0.03))
    state, _ = draws(task)
    observation = task.observe(state)
    before = (act(update.actor, observation, update.bounds) - 1.0).abs().mean()
    for seed in range(15):
        _, state, metrics = update(state, draws(task, seed)[1])
    assert all(value.isfinite() for value in metrics.values())
    after = (act(update.actor, observation, update.bounds) - 1.0).abs().mean()
    assert after < 0.5 * before


def test_entropy_keeps_the_actor_from_its_ends():
    update = make_update()
    state, drawn = draws()
    observation, noise = update.world_model.observe(state), drawn.noise[0]
    pull = torch.full((WORLDS, 1), 1e-3)

    def size(entropy):
        slopes = torch.func.grad(followed)(
            [*update.actor[:-1], update.actor[-1] + 9.0],  # far up the tanh
            observation,
            noise,
            pull,
            update.bounds,
            torch.tensor(entropy),
        )
        return slopes[-1].item()

    assert -1e-6 < size(0.0) < 0, "returns would go further up, with nearly no gradient"
    assert size(0.01) == pytest.approx(0.02, rel=1e-2), (
        "entropy leads back: 2 tanh(u) of its weight"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("traced")
def test_compiled_it_is_the_same():
    short = replace(CONFIG, horizon=2, critic_updates=2)
    plain, fast = (make_update(config=short, compile=c) for c in (False, True))
    state, drawn = draws(steps=2)
    one, other = plain(state, drawn), fast(state, drawn)
    torch.testing.assert_close(one[0], other[0])
    for name, value in one[2].items():
        torch.testing.assert_close(value, other[2][name], rtol=1e-3, atol=1e-5)
    for mine, theirs in zip(plain.actor, fast.actor, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)
