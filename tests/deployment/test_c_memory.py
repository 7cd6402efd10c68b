"""In C a task's registers move as in an agent: signals, the actuator, and the last action."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Signal, get_task
from phihp_torchrl.deployment import ActorModule, export_c
from phihp_torchrl.deployment.under_way import UnderWay
from phihp_torchrl.tasks import Actuator
from tests.deployment.compiled_c import Compiled, ask, lively, needs_cc, words
from tests.followed import AIM, WIND, Mass, disturbed, followed

STEPS = 60
AIMS = replace(AIM, preview=3)
TWO = Signal(("x", "x_dot"), (-1.0, 0.0), (3.0, 0.5), preview=2)
SLOW = Actuator(delay_steps=1.5, lag=0.15, slew=20.0, dead_zone=0.2, gain_low=0.8)
ARM = get_task("acrobot-swingup")

TASKS = {
    "reference": followed(),
    "preview": followed(reference=TWO),
    "inputs": followed(Mass()),
    "forecast": followed(Mass(), inputs=replace(WIND, preview=2), reference=AIMS),
    "price": followed(action_rate_cost=0.1),
    "rate": replace(get_task("pendulum"), action_rate_limit=4.0),
    "rates": replace(ARM, action_rate_limit=(3.0, 0.5), actuator=Actuator(delay_steps=(2.0, 0.5))),
    "lopsided": replace(ARM, action_low=(0.2, -1.0), action_rate_limit=1.0, actuator=SLOW),
    "all": followed(Mass(), reference=TWO, actuator=SLOW, action_rate_limit=12.0),
    "perfect": followed(actuator=Actuator(gain_low=0.5), action_rate_cost=0.0),
}


def episode(task, often=1.0):
    """Observations of the system ``[T, o]``, and what is given of each signal, in some steps."""
    generator = torch.Generator().manual_seed(1)
    observations = task.system.observe(task.reset.sample([STEPS], generator=generator))
    observations = observations + 0.3 * torch.randn(observations.shape, generator=generator)
    given = []
    for k in range(STEPS):
        whole = task.outside.draw([], 1, generator)
        some = torch.rand(len(whole), generator=generator) < often
        given.append(
            {key: v for (key, v), s in zip(whole.items(), some, strict=True) if s or not k}
        )
    return observations, given


def play(agent, observations, given):
    """The actions of an agent in Python, ``[T, m]``."""
    agent.reset()
    steps = zip(observations, given, strict=True)
    return torch.stack([agent(TensorDict(observation=o, **g))["action"] for o, g in steps])


def play_c(compiled, observations, given):
    """The actions of an actor in C, each of which is one that is not refused."""
    steps = [compiled.step(o, **g) for o, g in zip(observations, given, strict=True)]
    assert not any(code for code, _ in steps)
    return torch.stack([action for _, action in steps])


def equal(found, expected):
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@needs_cc
@pytest.mark.parametrize("name", TASKS)
def test_an_episode_is_that_of_the_agent(name, tmp_path):
    agent = lively(TASKS[name])
    compiled = Compiled(agent, tmp_path)
    for often in (0.3, 1.0):
        observations, given = episode(agent.task, often)
        expected = play(agent, observations, given)
        assert expected.std(0).min() > 0.02
        equal(play_c(compiled, observations, given), expected)
        compiled.reset()


@needs_cc
def test_a_window_moves_up_where_none_is_given(tmp_path):
    agent = lively(followed(reference=AIMS))
    window = torch.tensor([[-1.0], [0.2], [-0.4], [1.0]])
    compiled, still = Compiled(agent, tmp_path), torch.zeros(2)
    found = [compiled.step(still, reference=window)[1]]
    found += [compiled.step(still)[1] for _ in range(4)]
    moved = [window[[min(k + row, 3) for row in range(4)]] for k in range(5)]
    expected = [agent(TensorDict(observation=still, reference=each))["action"] for each in moved]
    equal(torch.stack(found), torch.stack(expected))
    assert len({action.item() for action in found}) == 4  # the last row stays


@needs_cc
@pytest.mark.parametrize("name", ["rate", "rates", "lopsided"])
def test_the_rate_is_limited(name, tmp_path):
    task = TASKS[name]
    compiled = Compiled(lively(task), tmp_path)
    actions = play_c(compiled, *episode(task))
    steps = torch.cat([task.clip_action(torch.zeros(1, task.action_dim)), actions]).diff(dim=0)
    largest = torch.as_tensor(task.action_rate_limit) * task.time_step
    assert (steps.abs() < largest + 1e-5).all()
    assert (steps.abs() > largest - 1e-5).any(0).all()
    assert torch.equal(task.clip_action(actions), actions)


class Told:
    """An agent's memory in Python, and its network, which are told what was sent."""

    def __init__(self, agent):
        self.memory, self.module = UnderWay(agent.task), ActorModule(agent)

    @torch.no_grad()
    def step(self, observation, sent=None, **given):
        """The action of a step, which is sent if nothing else is."""
        seen = self.memory.extend(TensorDict(observation=observation, **given))
        action = self.module(seen["observation"])
        return self.memory.record(action if sent is None else sent)


@needs_cc
@pytest.mark.parametrize("name", ["all", "rates", "price"])
def test_another_command_may_have_been_sent(name, tmp_path):
    task = TASKS[name]
    agent, scale = lively(task), task.bounds.scale
    compiled, told = Compiled(agent, tmp_path), Told(agent)
    for k, (observation, given) in enumerate(zip(*episode(task, 0.3), strict=True)):
        code, action = compiled.step(observation, **given)
        assert code == 0
        if k % 3 == 1:  # also beyond the bounds, and more than once
            command = 1.5 * scale * torch.randn(task.action_dim)
            compiled.sent(-command)
            compiled.sent(command)
            told.step(observation, command, **given)
        else:
            equal(action, told.step(observation, **given))


@needs_cc
def test_a_command_that_is_no_number_was_not_sent(tmp_path):
    agent = lively(TASKS["all"])
    compiled, told = Compiled(agent, tmp_path), Told(agent)
    for observation, given in zip(*episode(agent.task), strict=True):
        equal(compiled.step(observation, **given)[1], told.step(observation, **given))
        compiled.sent(torch.tensor([torch.nan]))


@needs_cc
@pytest.mark.parametrize("wrong", ["observation", "reference", "inputs"])
def test_what_is_not_finite_is_refused_and_nothing_is_lost(wrong, tmp_path):
    agent = lively(TASKS["all"])
    compiled, told, restrained = Compiled(agent, tmp_path), Told(agent), []
    for k, (observation, given) in enumerate(zip(*episode(agent.task), strict=True)):
        if k % 4 != 3:
            equal(compiled.step(observation, **given)[1], told.step(observation, **given))
            continue
        bad = {"observation": observation, **given}
        bad[wrong] = bad[wrong].clone()
        bad[wrong].flatten()[-1] = (torch.nan, torch.inf)[k // 4 % 2]
        code, action = compiled.step(**bad)
        given.pop(wrong, None)
        assert code == 1
        # What is right is kept, and the rate holds here too.
        equal(action, told.step(observation, torch.zeros(1), **given))
        restrained.append(action.item() != 0.0)
    assert any(restrained)


@needs_cc
def test_signals_are_needed_where_an_episode_starts(tmp_path):
    agent = lively(TASKS["forecast"])
    compiled = Compiled(agent, tmp_path)
    (first, *_), (given, *_) = episode(agent.task)
    expected = agent(TensorDict(observation=first, **given))["action"]
    for _ in range(2):
        for some in ({}, {"reference": given["reference"]}):
            code, action = compiled.step(first, **some)
            assert (code, action.tolist()) == (1, [0.0])
        code, action = compiled.step(first, **given)
        assert code == 0
        equal(action, expected)
        compiled.reset()


@needs_cc
def test_the_program_reads_signals_behind_each_observation(tmp_path):
    agent = lively(TASKS["all"])
    observations, given = episode(agent.task, 0.4)
    keys = ("inputs", "reference")
    steps = zip(observations, given, strict=True)
    lines = [" ".join([words(o), *(words(g.get(key)) for key in keys)]) for o, g in steps]
    assert sum(" -" in line for line in lines) > 10
    found = ask(export_c(ActorModule(agent), tmp_path / "actor.c"), lines)
    equal(found, play(agent, observations, given))


def test_the_head_of_the_file_says_what_there_is(tmp_path):
    task = replace(TASKS["all"], name="up */ and /* down")
    text = export_c(ActorModule(lively(task)), tmp_path / "cart.c").read_text()
    head = text[: text.index("*/")]
    for line in (
        "for the task up * / and / * down:",
        " *     int cart_step(cart_memory *memory, const float *observation,",
        " *                   const float *inputs, const float *reference, float *action);",
        "    observation (2): x, x_dot",
        "    inputs (1): wind",
        "    reference (6): x, x_dot now, then x, x_dot after each of the next 2 steps",
        "    action, command (1): force from -5 to 5 and changing by at most 12 a second",
        "cart_step: once in every step of 0.1 s.",
    ):
        assert line in head, line


def test_what_needs_the_model_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"^agent: expected .* got 'disturbance'"):
        export_c(ActorModule(lively(disturbed(actuator=SLOW))), tmp_path / "actor.c")
    assert not list(tmp_path.iterdir())
