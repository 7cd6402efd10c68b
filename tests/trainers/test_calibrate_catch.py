"""When calibration leaves what is near the goal to a regulator."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from phihp_torchrl import Agent, HybridDynamics, get_task
from phihp_torchrl.baselines import Settle
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import Box
from phihp_torchrl.trainers import CalibratePhase, calibrate_catch
from phihp_torchrl.trainers.calibrate_rule import Way, loses_nothing
from tests.followed import followed

from .calibrate_parts import TINY, finished

RESTLESS = CEMConfig(planning_horizon=5, optim_steps=1, num_candidates=32, top_k=8)
CATCHING = replace(TINY, catch=True)


class Shaking(nn.Module):
    """An actor that pushes to and fro, whatever it sees."""

    def forward(self, observation):
        return torch.where(observation[..., 1:2] > 0.0, 2.0, -2.0)


def make_agent(name="pendulum", **changes):
    torch.manual_seed(0)
    task = replace(
        get_task(name), max_steps=40, reset=Box.around((0.0, 0.0), (0.3, 0.3)), **changes
    )
    actor = TensorDictModule(Shaking(), ["observation"], ["action"])
    parts = {"dynamics": HybridDynamics.pure_prior(task), "actor": actor}
    return Agent(task, **parts, planner_config=RESTLESS)


def test_a_restless_plan_leaves_the_goal_to_a_regulator():
    phase = finished(make_agent(), CATCHING)
    found = phase.final["catch"]
    assert found["way"] == "caught"
    assert found["share"] == 1.0
    assert found["chatter"] < 0.02 < found["chatter_before"]
    assert phase.acting == "planner"
    agent = Agent(phase.agent.task, **{**parts_of(phase.agent), **phase.parts()})
    assert agent.catch is not None
    assert evaluate(agent, agent.task, episodes=4).chatter.mean() < 0.02


def parts_of(agent):
    return {"dynamics": agent.dynamics, "actor": agent.actor}


def test_it_is_as_without_where_the_setting_says_no():
    without, with_it = (finished(make_agent(), config) for config in (TINY, CATCHING))
    assert without.final["catch"] is None
    assert without.parts()["catch"] is None
    assert {k: with_it.final["ways"][k] for k in without.final["ways"]} == without.final["ways"]


def test_a_regulator_that_earns_less_is_not_kept(monkeypatch):
    """To this judge every regulator loses ten in each episode."""

    def judge(way, before, **options):
        return loses_nothing(replace(way, returns=tuple(r - 10.0 for r in way.returns)), before)

    monkeypatch.setattr(calibrate_catch, "loses_nothing", judge)
    monkeypatch.setattr(calibrate_catch, "costs_little", lambda way, before, **options: False)
    phase = finished(make_agent(), CATCHING)
    tried = [name for name in phase.final["ways"] if name.startswith("caught")]
    assert tried == ["caught", "caught close", "caught closer", "caught closest"]
    assert phase.final["catch"] is None


def make_follower():
    torch.manual_seed(0)
    task = followed()
    actor = TensorDictModule(lambda seen: 0.0 * seen[..., :1], ["observation"], ["action"])
    parts = {"dynamics": HybridDynamics.pure_prior(task), "actor": actor}
    return Agent(task, **parts, planner_config=RESTLESS)


def test_on_a_reference_the_one_that_earns_most_of_those_that_cost_a_little_is_kept(monkeypatch):
    monkeypatch.setattr(calibrate_catch, "loses_nothing", lambda way, before, **options: False)
    monkeypatch.setattr(calibrate_catch, "costs_little", lambda way, before, **options: True)
    phase = finished(make_follower(), CATCHING)
    ways = {name: way for name, way in phase.final["ways"].items() if name.startswith("caught")}
    assert len(ways) == 4
    assert phase.final["catch"]["way"] == max(ways, key=lambda name: ways[name]["return"])


def test_none_is_tried_without_a_goal():
    task = replace(get_task("acrobot"), max_steps=20)
    actor = TensorDictModule(lambda seen: 0.0 * seen[..., :1], ["observation"], ["action"])
    parts = {"dynamics": HybridDynamics.pure_prior(task), "actor": actor}
    phase = finished(Agent(task, **parts, planner_config=RESTLESS), CATCHING)
    assert not [name for name in phase.final["ways"] if name.startswith("caught")]
    assert phase.final["catch"] is None


def test_a_task_whose_functions_know_one_precision_loses_no_run(caplog):
    """Slopes are taken in double precision."""
    weights = torch.tensor([1.0, 0.1])

    def single(state, action, next_state):
        return -(next_state.square() @ weights)

    phase = finished(make_agent(reward=single), CATCHING)
    assert phase.final["catch"] is None
    assert "No regulator is tried near the goal, for none could be made" in caplog.text
    assert "RuntimeError" in caplog.text


def test_none_is_tried_where_the_agent_rests(monkeypatch):
    monkeypatch.setattr(Way, "mean_chatter", property(lambda self: 0.0))
    phase = finished(make_agent(), CATCHING)
    assert not [name for name in phase.final["ways"] if name.startswith("caught")]


def test_on_a_reference_it_is_tried_also_where_the_agent_rests(monkeypatch):
    monkeypatch.setattr(Way, "mean_chatter", property(lambda self: 0.0))
    phase = finished(make_follower(), CATCHING)
    assert "caught" in phase.final["ways"]
    found = phase.parts()["catch"]
    assert (found is None) == (phase.final["catch"] is None)
    assert found is None or isinstance(found, Settle)


@pytest.mark.parametrize("after", range(1, 6))
def test_a_resumed_phase_ends_as_one_that_was_not_stopped(after):
    whole = finished(make_agent(), CATCHING)
    begun, resumed = (CalibratePhase(make_agent(), CATCHING, seed=0) for _ in range(2))
    for _ in range(after):
        if not begun.done:
            begun.advance()
    resumed.load_state_dict(begun.state_dict())
    while not resumed.done:
        resumed.advance()
    assert resumed.final == whole.final
    theirs, ours = (phase.parts()["catch"] for phase in (whole, resumed))
    assert torch.equal(theirs.level, ours.level)
