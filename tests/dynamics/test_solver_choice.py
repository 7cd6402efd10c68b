"""The choice of a model's integrator by its held-out error."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import DynamicsLoss, HybridDynamics, get_task
from phihp_torchrl.dynamics import FitConfig, FitReport, fit, fit_solver
from phihp_torchrl.dynamics.solver_choice import SolverTrial, choose
from phihp_torchrl.integrators import RK4, SemiImplicitEuler
from phihp_torchrl.trainers import CollectConfig, ModelConfig, ModelTrainer
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

TASK = get_task("pendulum")


def data(integrator, count: int = 80) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    truth = HybridDynamics.pure_prior(TASK, constants={"mass": 1.3}, integrator=integrator)
    state = TASK.coverage.sample([count], generator=generator)
    action = 4.0 * torch.rand(count, 1, generator=generator) - 2.0
    following = TensorDict(observation=TASK.observe(truth(state, action)), batch_size=[count])
    parts = {"observation": TASK.observe(state), "action": action, "next": following}
    return TensorDict(parts, batch_size=[count]).detach()


@pytest.mark.parametrize(
    "truth", [SemiImplicitEuler(), SemiImplicitEuler(2), RK4(), SemiImplicitEuler(4)], ids=str
)
def test_the_solver_of_the_world_is_found(truth):
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    known = data(truth)
    fit_solver(loss, known, known, FitConfig(steps=20))
    chosen = loss.dynamics.integrator
    assert (chosen.name, chosen.settings) == (truth.name, truth.settings)


def test_the_result_is_that_of_a_fit_with_the_chosen_solver():
    known, config = data(RK4()), FitConfig(steps=8, batch_size=40)
    results = []
    for chooses in (True, False):
        torch.manual_seed(0)
        model = HybridDynamics.hybrid(TASK, hidden_sizes=(4,), integrator="rk4")
        loss, generator = DynamicsLoss(model), torch.Generator().manual_seed(1)
        if chooses:
            fit_solver(loss, known, known, config, generator)
        else:
            fit(loss, known, known, config, generator)
        results.append((model.state_dict(), generator.get_state()))
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)


def test_no_other_solver_is_tried_where_the_cheapest_is_good():
    known = data(SemiImplicitEuler())
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    _, trials = fit_solver(loss, known, known, FitConfig(steps=20))
    assert [str(trial.integrator) for trial in trials] == ["semi_implicit_euler (substeps 1)"]


@pytest.mark.parametrize(
    ("errors", "index"), [([1.0, 0.9, 0.8], 0), ([1.0, 0.3, 0.2], 1), ([1.0, 0.9, 0.1], 2)]
)
def test_a_finer_solver_must_halve_the_error(errors, index):
    trials = [SolverTrial(RK4(), FitReport(0.0, 0.0, 1, 0.0), e) for e in errors]
    assert choose(trials) == index


def test_a_run_chooses_and_remembers():
    world = SimulatedWorld(TASK, SimulatedConfig(integrator="rk4"))
    collect = CollectConfig(
        planning_horizon=5, replan_every=5, num_candidates=8, top_k=2, optim_steps=1
    )
    config = ModelConfig(
        real_steps=100,
        steps_per_iteration=100,
        hidden_sizes=(4,),
        fit=FitConfig(steps=25),
        collect=collect,
    )
    trainer = ModelTrainer(TASK, config, seed=3, world=world)
    trainer.advance()
    assert trainer.dynamics.integrator.name == "rk4"
    resumed = ModelTrainer(TASK, config, seed=3, world=world)
    resumed.load_state_dict(trainer.state_dict())
    assert resumed.dynamics.config == trainer.dynamics.config
