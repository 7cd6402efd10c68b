"""Actor and critics: what they compute, in whatever bounds, and that they are built again."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl import get_task
from phihp_torchrl.agents import (
    Actor,
    QNetwork,
    TD3Config,
    TwinQ,
    make_actor,
    make_qvalue,
    make_td3_loss,
    make_twin_qvalue,
)
from phihp_torchrl.agents.update import layers
from phihp_torchrl.worlds import SimulatedWorld

PENDULUM = get_task("pendulum")
WIDTHS = st.lists(st.integers(1, 12), min_size=1, max_size=3)


@pytest.mark.parametrize("batch", [[], [5], [2, 3]])
def test_twin_q_is_its_two_critics(batch):
    task = get_task("acrobot")
    loss = make_td3_loss(
        SimulatedWorld(task).model(),
        TD3Config(actor_hidden_sizes=(8,), critic_hidden_sizes=(8, 6)),
    )
    twin = TwinQ.from_layers(task, layers(loss.qvalue_network_params))
    observation, action = torch.randn(*batch, 6), torch.rand(*batch, 1)
    values = twin(observation, action)
    assert values.shape == (*batch, 2)
    for i in range(2):
        critic = QNetwork(task, (8, 6))
        columns = layers(loss.qvalue_network_params)
        for parameter, layer in zip(critic.mlp.parameters(), columns, strict=True):
            parameter.data.copy_(layer[i])
        torch.testing.assert_close(values[..., i], critic(observation, action).squeeze(-1))
    actor = Actor.from_layers(task, layers(loss.actor_network_params))
    td = TensorDict(observation=observation, batch_size=batch)
    with loss.actor_network_params.to_module(loss.actor_network):
        torch.testing.assert_close(actor(observation), loss.actor_network(td)["action"])


def test_layers_are_copied_and_must_fit():
    task = get_task("pendulum")
    source = [parameter.detach() for parameter in TwinQ(task, (4,)).layers]
    twin = TwinQ.from_layers(task, source)
    source[0].zero_()
    assert twin.layers[0].abs().sum() > 0
    with pytest.raises(ValueError, match="layers: expected shape"):
        TwinQ.from_layers(get_task("acrobot"), source)
    again = TwinQ(task, (4,))
    again.load_state_dict(twin.state_dict())
    td = TensorDict(observation=torch.randn(3, 3), action=torch.randn(3, 1), batch_size=[3])
    shell = make_twin_qvalue(task, (4,))
    shell.module.load_state_dict(twin.state_dict())
    expected = twin(td["observation"], td["action"])
    assert torch.equal(again(td["observation"], td["action"]), expected)
    assert torch.equal(shell(td)["state_action_value"], expected)


def with_weights_of(other, network):
    network.load_state_dict(other.state_dict())
    return network


# Bounds.


@given(WIDTHS, st.integers(0, 2**31), st.floats(0.1, 1e3))
def test_actions_stay_in_lopsided_bounds(widths, seed, size):
    torch.manual_seed(seed)
    actor = Actor(LOPSIDED, widths)
    action = actor(size * torch.randn(64, 3))
    assert action.shape == (64, 1)
    assert (action >= -6.0).all()
    assert (action <= 12.0).all()


def test_a_loud_actor_reaches_both_bounds():
    actor = Actor(LOPSIDED, (4,), last_layer_scale=1e6)
    action = actor(torch.randn(64, 3))
    assert action.min().item() == pytest.approx(-6.0)
    assert action.max().item() == pytest.approx(12.0)
    quiet = Actor(LOPSIDED, (4,), last_layer_scale=0.0)
    assert quiet(torch.randn(5, 3)).flatten().tolist() == [3.0] * 5, "the middle of the bounds"


@given(WIDTHS, st.integers(0, 2**31))
def test_bounds_are_only_a_unit_of_measure(widths, seed):
    """Same weights: an action of 2 N m there is one of 12 N m here, and -2 is -6."""
    torch.manual_seed(seed)
    observation = torch.randn(16, 3)
    actor = Actor(PENDULUM, widths)
    moved = with_weights_of(actor, Actor(LOPSIDED, widths))(observation)
    torch.testing.assert_close(moved, 3.0 + 4.5 * actor(observation))
    action = 4 * torch.rand(16, 1) - 2
    for kind in (QNetwork, TwinQ):
        critic = kind(PENDULUM, widths)
        other = with_weights_of(critic, kind(LOPSIDED, widths))
        torch.testing.assert_close(
            other(observation, 3.0 + 4.5 * action), critic(observation, action)
        )


def test_bounds_are_no_weights_and_move_along():
    for network in (Actor(LOPSIDED, (4,)), QNetwork(LOPSIDED, (4,)), TwinQ(LOPSIDED, (4,))):
        assert set(network.state_dict()) == {name for name, _ in network.named_parameters()}
        bounds = network.double().bounds
        assert [limit.tolist() for limit in bounds] == [[-6.0], [12.0], [3.0], [9.0]]
        assert {limit.dtype for limit in bounds} == {torch.float64}


# Built again.


@given(WIDTHS)
def test_networks_say_how_they_are_built(widths):
    for kind in (Actor, QNetwork, TwinQ):
        network = kind(LOPSIDED, tuple(widths))
        assert network.config == {"kind": kind.kind, "hidden_sizes": widths}
        again = kind.from_config(LOPSIDED, network.config)
        assert type(again) is kind
        shapes = {name: p.shape for name, p in network.named_parameters()}
        assert {name: p.shape for name, p in again.named_parameters()} == shapes


def test_a_network_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="kind: expected 'twin_q', got 'mlp_actor'"):
        TwinQ.from_config(PENDULUM, Actor(PENDULUM, (4,)).config)


@pytest.mark.parametrize("sizes", [(), (0,), (-1,), (2.5,), (True,), (65_537,), (4,) * 33, "44"])
@pytest.mark.parametrize("kind", [Actor, QNetwork, TwinQ])
def test_bad_widths_are_named(kind, sizes):
    with pytest.raises(ValueError, match=r"^hidden_sizes: expected"):
        kind(PENDULUM, sizes)


def test_factories_make_what_they_say():
    td = TensorDict(observation=torch.randn(7, 3), action=torch.randn(7, 1), batch_size=[7])
    actor, critic, twin = (
        make(PENDULUM, (6, 5)) for make in (make_actor, make_qvalue, make_twin_qvalue)
    )
    assert torch.equal(
        critic(td.clone())["state_action_value"], critic.module(td["observation"], td["action"])
    )
    assert twin(td.clone())["state_action_value"].shape == (7, 2)
    assert torch.equal(actor(td.clone())["action"], actor.module(td["observation"]))
    assert actor.module.hidden_sizes == twin.module.hidden_sizes == (6, 5)
