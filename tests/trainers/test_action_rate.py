"""Who learns from a world's steps pays the price of the action's changes; who reports does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import get_task, load_config
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.tdmpc import TDMPCTrainConfig, TDMPCTrainer
from phihp_torchrl.trainers import (
    ModelConfig,
    ModelTrainer,
    RealTD3Config,
    RealTD3Trainer,
    read_run_config,
    run,
)

CALM = {"action_rate_limit": 20.0, "action_rate_cost": 7.0}
TASK = replace(get_task("pendulum"), actuator=Actuator(delay_steps=1.0), **CALM)


def earned(task, state, action, next_state):
    """What a world gives for transitions."""
    before, registers = task.split(state)
    return task.reward(before, task.command(registers, action), task.split(next_state)[0])


def test_phase_1_hands_on_rewards_less_prices_and_keeps_to_the_rate():
    config = ModelConfig(real_steps=40, steps_per_iteration=20, fit=FitConfig(steps=2))
    trainer = ModelTrainer(TASK, config, seed=0)
    trainer.advance()
    trainer.advance()  # which plans
    batch = trainer.transitions()
    given = trainer.data["next", "reward"][:, 0]
    torch.testing.assert_close(
        given, earned(TASK, batch.state, batch.action, batch.next_state), rtol=1e-4, atol=1e-4
    )
    last = batch.state[:, -1]
    paid = 7.0 * ((batch.action[:, 0] - last) / 2.0).square()
    torch.testing.assert_close(given - batch.reward, paid)
    assert 0.1 < (batch.action[:, 0] - last).abs().max() <= 20.0 * TASK.time_step + 1e-5


def test_td3_on_real_steps_learns_with_the_price_and_reports_without():
    config = RealTD3Config(real_steps=40, evaluation_interval=40, random_steps=20)
    trainer = RealTD3Trainer(TASK, config, seed=0)
    trainer.advance()
    batch = trainer.replay.sample(40, torch.Generator())
    full = earned(TASK, batch.state, batch.action, batch.next_state)
    torch.testing.assert_close(full - batch.reward, TASK.price(batch.state, batch.action))
    assert TASK.price(batch.state, batch.action).max() > 0.01
    free = RealTD3Trainer(TASK.unpriced(), config, seed=0)
    free.update.load_state_dict(trainer.update.state_dict())
    torch.testing.assert_close(trainer.evaluate(), free.evaluate())


def test_td_mpc_learns_with_the_price():
    config = TDMPCTrainConfig(real_steps=30, seed_steps=30, batch_size=4)
    trainer = TDMPCTrainer(replace(TASK, max_steps=30), config, seed=0)
    given = trainer.advance()["tdmpc/episode_return"]
    free = TDMPCTrainer(replace(TASK, max_steps=30).unpriced(), config, seed=0)
    assert free.advance()["tdmpc/episode_return"] == pytest.approx(given)
    slices, others = trainer.replay.sample(), free.replay.sample()
    assert (slices["next", "reward"] < others["next", "reward"] - 1e-3).any()


@pytest.mark.slow
def test_a_run_with_rates_resumes_and_refuses_others(tmp_path):
    words = ["policy.updates=8", "policy.evaluation_interval=4", "policy.evaluation_steps=5"]
    words += ["policy.refit.interval=0", "model.real_steps=40", "model.fit.steps=2"]
    words += ["compile=false", "action_rate_limit=20", "action_rate_cost=7", "progress=false"]
    words += ["actuator.delay_steps=1", "phases=[model]"]
    words += ["policy.num_worlds=8", "policy.batch_size=8"]
    words += ["policy.random_steps=16", "model.hidden_sizes=[8]"]
    config = read_run_config(load_config("pendulum", overrides=words))
    assert run(config, tmp_path / "run").finished
    assert run(config, tmp_path / "run", resume=True).finished
    with pytest.raises(ValueError, match="action_rate_cost"):
        run(replace(config, action_rate_cost=1.0), tmp_path / "run", resume=True)
    after = replace(config, phases=("policy",), start_from=str(tmp_path / "run"))
    result = run(after, tmp_path / "policy")
    assert result.finished
    assert "policy/imagined_return" in result.metrics
