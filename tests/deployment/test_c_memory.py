"""In C a task's registers move as in an agent."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import get_task
from phihp_torchrl.deployment import ActorModule, export_c
from phihp_torchrl.deployment.under_way import UnderWay
from phihp_torchrl.tasks import Actuator
from tests.deployment.compiled_c import Compiled, lively, needs_cc
from tests.followed import followed

STEPS = 60
SLOW = Actuator(delay_steps=1.5, lag=0.15, slew=20.0, dead_zone=0.2, gain_low=0.8)
ARM = replace(get_task("acrobot-swingup"), actuator=SLOW)


def equal(found, expected):
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


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
def test_another_command_may_have_been_sent(tmp_path):
    agent, scale = lively(ARM), ARM.bounds.scale
    compiled, told = Compiled(agent, tmp_path), Told(agent)
    for k, observation in enumerate(ARM.system.observe(ARM.reset.sample([STEPS]))):
        code, action = compiled.step(observation)
        assert code == 0
        if k % 3 == 1:  # also beyond the bounds, and more than once
            command = 1.5 * scale * torch.randn(ARM.action_dim)
            compiled.sent(-command)
            compiled.sent(command)
            told.step(observation, command)
        else:
            equal(action, told.step(observation))


@needs_cc
def test_a_command_that_is_no_number_was_not_sent(tmp_path):
    agent = lively(ARM)
    compiled, told = Compiled(agent, tmp_path), Told(agent)
    for observation in ARM.system.observe(ARM.reset.sample([STEPS])):
        equal(compiled.step(observation)[1], told.step(observation))
        compiled.sent(torch.tensor([0.0, torch.nan]))


def test_the_head_of_the_file_says_what_there_is(tmp_path):
    task = replace(ARM, name="up */ and /* down")
    text = export_c(ActorModule(lively(task)), tmp_path / "arm.c").read_text()
    head = text[: text.index("*/")]
    for line in (
        "for the task up * / and / * down:",
        " *     int arm_step(arm_memory *memory, const float *observation, float *action);",
        "    action, command (2): ",
        "arm_step: once in every step of 0.2 s.",
    ):
        assert line in head, line


def test_what_is_no_actuator_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"^agent: expected .* got 'reference'"):
        export_c(ActorModule(lively(followed(actuator=SLOW))), tmp_path / "actor.c")
    assert not list(tmp_path.iterdir())
