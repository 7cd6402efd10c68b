"""Start states lie where they should, in the asked proportions, and come back with their seed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.imagination import (
    BoxStates,
    DataStates,
    MixtureStates,
    StartConfig,
    make_start_states,
)
from phihp_torchrl.tasks import Box, list_tasks

SHAPES = [(), (0,), (1,), (5,), (2, 3)]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def constant(value: float) -> BoxStates:
    return BoxStates(Box(low=(value, value), high=(value, value)))


SAMPLERS = {
    "box": lambda: BoxStates(Box(low=(-1.0, 2.0), high=(0.0, 3.0))),
    "data": lambda: DataStates(torch.randn(50, 2, generator=generator(), dtype=torch.float64)),
    "mixture": lambda: MixtureStates({constant(1.0): 1.0, DataStates(torch.randn(9, 2)): 2.0}),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", SAMPLERS)
def test_shape_and_dtype(name, shape):
    for states in (SAMPLERS[name]().sample(shape), SAMPLERS[name]().sample(torch.Size(shape))):
        assert states.shape == (*shape, 2)
        assert states.dtype == torch.float32


@pytest.mark.parametrize("name", SAMPLERS)
def test_seeded(name):
    sampler = SAMPLERS[name]()
    first, again, other = (sampler.sample([64], generator(seed)) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    source = generator()
    assert not torch.equal(sampler.sample([64], source), sampler.sample([64], source))


@pytest.mark.parametrize("name", SAMPLERS)
def test_given_generator_leaves_the_global_one_alone(name):
    sampler = SAMPLERS[name]()
    before = torch.get_rng_state()
    sampler.sample([8], generator())
    assert torch.equal(before, torch.get_rng_state())


def test_box_is_filled_and_not_left():
    box = Box(low=(-1.0, 2.0, 5.0), high=(0.0, 3.0, 5.0))
    states = BoxStates(box).sample([4000], generator())
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    assert ((states >= low) & (states <= high)).all()
    torch.testing.assert_close(states.mean(0), (low + high) / 2, atol=0.03, rtol=0)
    assert (states.amax(0) - states.amin(0))[:2].min() > 0.95


def test_data_come_from_the_data_and_can_be_updated():
    data = DataStates(torch.arange(10.0).reshape(5, 2))
    rows = {tuple(row) for row in data.sample([500], generator()).tolist()}
    assert rows == {(0.0, 1.0), (2.0, 3.0), (4.0, 5.0), (6.0, 7.0), (8.0, 9.0)}
    mixture = MixtureStates({data: 1.0})
    data.update(torch.full((3, 2), -1.0))
    assert (mixture.sample([20]) == -1).all()


def test_data_draws_are_copies():
    states = torch.zeros(1, 2)
    DataStates(states).sample([3]).add_(1.0)
    assert (states == 0).all()


def test_mixture_keeps_its_proportions():
    weights = {constant(0.0): 2.0, constant(1.0): 0.0, constant(2.0): 5.0, constant(3.0): 3.0}
    states = MixtureStates(weights).sample([100, 200], generator())
    assert torch.equal(states[..., 0], states[..., 1]), "a row comes from one component"
    shares = torch.bincount(states[..., 0].long().flatten(), minlength=4) / 20_000
    torch.testing.assert_close(shares, torch.tensor([0.2, 0.0, 0.5, 0.3]), atol=0.015, rtol=0)


def test_mixture_rows_are_independent():
    choice = MixtureStates({constant(0.0): 1.0, constant(1.0): 1.0}).sample([20_000], generator())
    same = (choice[1:, 0] == choice[:-1, 0]).float().mean()
    assert abs(same - 0.5) < 0.02


@pytest.mark.parametrize("name", list_tasks())
def test_every_task_has_a_default_mixture(name):
    task = get_task(name)
    mixture = make_start_states(task)
    states = mixture.sample([1000], generator())
    assert states.shape == (1000, task.state_dim)
    boxes = [box for box in (task.reset, task.coverage, task.goal) if box is not None]
    inside = torch.zeros(1000, dtype=torch.bool)
    for box in boxes:
        low, high = torch.tensor(box.low), torch.tensor(box.high)
        inside |= ((states >= low) & (states <= high)).all(-1)
    assert inside.all()
    assert len(mixture.weights) == len(boxes)
    assert sum(mixture.weights) == pytest.approx(1.0)


def test_absent_boxes_leave_their_share():
    task = get_task("cartpole-swingup")
    assert make_start_states(task).weights == pytest.approx((0.2, 0.6, 0.2))
    assert make_start_states(replace(task, goal=None)).weights == pytest.approx((0.25, 0.75))
    bare = replace(task, goal=None, coverage=None)
    assert make_start_states(bare).weights == (1.0,)
    data = torch.zeros(1, 4)
    found = make_start_states(bare, StartConfig(data=0.6), states=data)
    assert found.weights == pytest.approx((0.25, 0.75))


def test_data_share_follows_updates():
    data = DataStates(torch.full((1, 2), 7.0))
    shares = StartConfig(reset=0.0, data=1.0, coverage=0.0, goal=0.0)
    mixture = make_start_states(get_task("pendulum"), shares, states=data)
    assert (mixture.sample([5]) == 7).all()
    data.update(torch.full((1, 2), 8.0))
    assert (mixture.sample([5]) == 8).all()


@pytest.mark.parametrize("key", ["reset", "data", "coverage", "goal"])
@pytest.mark.parametrize("share", [-0.1, float("nan"), float("inf")])
def test_bad_share_is_named(key, share):
    with pytest.raises(
        ConfigError, match=rf"^{key}: expected a (finite number|number >= 0), got {share}"
    ):
        StartConfig(**{key: share})


@pytest.mark.parametrize("weight", [-0.1, float("nan"), float("inf")])
def test_bad_weight_is_named(weight):
    with pytest.raises(ConfigError, match=r"^BoxStates: expected a finite weight"):
        MixtureStates({constant(0.0): weight})


def test_nothing_left_is_named():
    task = replace(get_task("pendulum"), goal=None)
    with pytest.raises(ConfigError, match=r"^start: .*\['coverage', 'reset'\].*'pendulum'"):
        make_start_states(task, StartConfig(reset=0.0, coverage=0.0, goal=1.0))
    with pytest.raises(ConfigError, match=r"^data: .*data=0\.5"):
        make_start_states(task, StartConfig(data=0.5))
    with pytest.raises(ConfigError, match=r"^weights: "):
        MixtureStates({})


@given(st.lists(st.floats(0, 1e3), min_size=4, max_size=4).filter(any))
def test_shares_are_normalised_over_what_the_task_has(shares):
    config = StartConfig(*shares)
    task, data = get_task("cartpole-swingup"), torch.full((1, 4), 50.0)
    mixture = make_start_states(task, config, states=data)
    assert sum(mixture.weights) == pytest.approx(1.0)
    total = sum(shares)
    expected = [config.reset, config.coverage, config.goal, config.data]
    assert mixture.weights == pytest.approx([share / total for share in expected if share > 0])
    if config.data == 0:
        assert (mixture.sample([50]).abs() < 49).all()


@pytest.mark.parametrize(
    "states", [torch.zeros(0, 2), torch.zeros(2), torch.full((1, 2), float("nan"))]
)
def test_bad_data_are_refused(states):
    with pytest.raises(ValueError, match=r"^states: "):
        DataStates(states)
