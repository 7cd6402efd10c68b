"""NaN and infinities lose every comparison, and end a run by name with its last good state."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import Actor, act
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.planners import CEMConfig, Problem, cem_plan
from phihp_torchrl.tdmpc import TDMPCTrainer
from phihp_torchrl.trainers import (
    ModelTrainer,
    NonFiniteError,
    PolicyConfig,
    PolicySearch,
    PolicyTrainer,
    RealTD3Trainer,
    read_result,
    run,
)
from phihp_torchrl.trainers.checkpoints import load_latest
from phihp_torchrl.trainers.finite import check_finite
from phihp_torchrl.trainers.policy_evaluation import ActorEvaluation
from phihp_torchrl.trainers.policy_scales import training_scales
from phihp_torchrl.trainers.run_directory import RunDirectory

from .run_parts import CONFIG
from .tally import TASK, Tally, TallyConfig, tally_config

pytestmark = pytest.mark.usefixtures("tally")

TASKS = ("cartpole", "pendulum", "acrobot")


def weights(name: str, value: float) -> list[torch.Tensor]:
    """An actor's layers, the last of which has a number that is not finite."""
    layers = [layer.detach().clone() for layer in Actor(get_task(name), (8,)).mlp.parameters()]
    layers[-1].fill_(value)
    return layers


@pytest.mark.parametrize("name", TASKS)
def test_an_actor_that_left_the_finite_numbers_never_wins_in_imagination(name: str) -> None:
    """A limit that no comparison with NaN exceeds keeps a cart-pole of NaN up for ever."""
    task = get_task(name)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    rollouts = Rollouts(model, act, task.max_steps)
    start = task.sample_start([3], torch.Generator().manual_seed(0))
    assert rollouts.returns(weights(name, math.nan), start, 7).total.isnan().all()
    assert rollouts.returns(weights(name, 0.0), start, 7).total.isfinite().all()
    judge = ActorEvaluation(
        rollouts,
        training_scales(model, None, PolicyConfig(), 0),
        PolicyConfig(evaluation_steps=7, evaluation_episodes=3),
        world=None,
        seed=0,
        generator=torch.Generator().manual_seed(0),
        compile=False,
    )
    assert judge.imagined(weights(name, math.nan)).returns.eq(-math.inf).all()


def test_what_has_ended_may_do_as_it_likes_afterwards() -> None:
    task = get_task("cartpole")

    class Diverges(TaskWorldModel):
        def transition(self, state, action):
            return state * math.inf, torch.ones(len(state)), torch.ones(len(state)).bool()

    rollouts = Rollouts(Diverges(task, HybridDynamics.hybrid(task)), act, 50)
    start = task.sample_start([2], torch.Generator().manual_seed(0)).abs() + 1.0
    model = rollouts.returns(weights("cartpole", 0.0), start, 3)
    assert model.total.isnan().all()  # the step that ended it left the finite numbers itself


@pytest.mark.parametrize("value", [False, True])
def test_a_sequence_that_leads_to_nan_loses_in_a_plan(value: bool) -> None:
    """Its rewards of 1 are the best there are; its states are no states."""
    task = get_task("cartpole")
    truth = TaskWorldModel(task, HybridDynamics.hybrid(task))

    class Breaks:
        def locate(self, observation):
            return truth.locate(observation)

        def observe(self, state):
            return torch.nan_to_num(truth.observe(state))

        def transition(self, state, action):
            following, reward, terminated = truth.transition(state, action)
            pushed = action[..., :1] > 0
            return torch.where(pushed, math.nan, following), reward + pushed[..., 0], terminated

    settings = CEMConfig(planning_horizon=3, num_policy_candidates=0, select="best")
    noise = torch.randn(settings.noise_shape((4,), 1), generator=torch.Generator().manual_seed(0))
    observation = task.observe(torch.zeros(4, 4))
    problem = Problem(Breaks(), task.bounds, value=(lambda *_: 0.0) if value else None)
    plan = cem_plan(observation, noise, problem=problem, settings=settings)
    assert (plan.actions <= 0).all()
    assert plan.score.isfinite().all()


def test_a_policy_of_nan_earns_nan_and_not_the_most(caplog: pytest.LogCaptureFixture) -> None:
    broken = TensorDictModule(
        lambda obs: torch.full_like(obs[..., :1], math.nan), ["observation"], ["action"]
    )
    found = evaluate(broken, "cartpole", episodes=3)
    assert found.returns.isnan().all()
    assert math.isnan(found.mean)
    assert "In 3 of 3 episodes" in caplog.text
    assert not found.mean > -math.inf  # what every choice among policies asks


def test_a_run_stops_by_name_and_keeps_the_last_good_state(tmp_path: Path) -> None:
    config = tally_config(TallyConfig(units=5, spoil=2))
    with pytest.raises(
        NonFiniteError,
        match=r"phase 'tally-one' after 3 of 5 units: weight has 1 of 16 numbers .* lower learning",
    ):
        run(config, tmp_path / "run")
    directory = RunDirectory(tmp_path / "run")
    found = load_latest(directory.rotation, metadata={"task": TASK})
    assert found is not None
    assert (found[0], found[1]["trainer"]["count"]) == (2, 2)
    assert found[1]["trainer"]["weight"].isfinite().all()
    assert len((tmp_path / "run" / "metrics.csv").read_text().splitlines()) == 3


def test_losses_are_watched_and_returns_may_diverge(tmp_path: Path) -> None:
    phase = Tally(TallyConfig())
    options = {"name": "policy", "unit": "updates", "directory": tmp_path}
    fine = {"policy/imagined_return": -math.inf, "model/rollout_error_20": math.inf}
    check_finite(phase, fine, **options)
    with pytest.raises(NonFiniteError, match="policy/loss_qvalue is nan"):
        check_finite(phase, {"policy/loss_qvalue": math.nan}, **options)


@pytest.mark.parametrize("phase", ["model", "policy"])
def test_every_phase_that_learns_says_what_it_trains(
    phase: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert all(hasattr(k, "trained") for k in (PolicySearch, RealTD3Trainer, TDMPCTrainer))
    kind = {"model": ModelTrainer, "policy": PolicyTrainer}[phase]
    advance = kind.advance

    def spoil(self):
        metrics = advance(self)
        next(iter(self.trained().values())).data.view(-1)[0] = math.nan
        return metrics

    monkeypatch.setattr(kind, "advance", spoil)
    with pytest.raises(NonFiniteError, match=f"phase '{phase}' after .*has 1 of"):
        run(CONFIG, tmp_path / "run")


def test_an_agent_whose_episodes_diverge_is_saved_with_null(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules["phihp_torchrl.trainers.evaluate"]
    played = module.evaluate

    def diverging(*arguments, **options):
        found = played(*arguments, **options)
        returns = found.returns.clone()
        returns[0] = math.nan
        return replace(found, returns=returns)

    monkeypatch.setattr(module, "evaluate", diverging)
    assert run(CONFIG, tmp_path / "run").finished
    text = (tmp_path / "run" / "evaluation.json").read_text()
    assert json.loads(text)["actor"]["return_mean"] is None
    result = read_result(tmp_path / "run")
    assert result is not None
    assert math.isnan(result.actor[0])
