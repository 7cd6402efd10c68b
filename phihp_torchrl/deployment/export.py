"""An agent's planner as one file that runs without Python or without torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.planners import plan

Act = Callable[[Tensor, Tensor], Tensor]
"""Observation ``[o]`` and standard normal noise (see :attr:`PlanModule.noise_shape`) to action."""


class PlanModule(nn.Module):
    """One plan as a module of tensors: observation ``[o]`` and noise in, action ``[m]`` out.

    Nothing random happens in it and nothing is remembered, so plans are made anew at every step,
    whatever ``replan_every`` and ``warm_start`` say.

    Args:
        agent: an agent with a planner.

    Raises:
        ValueError: for an agent without one, or whose model does not compile.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor, TwinQ
        >>> from phihp_torchrl.planners.factory import PlannerConfig
        >>> task = get_task("pendulum")
        >>> parts = {"actor": Actor(task), "qvalue": TwinQ(task), "planner_config": PlannerConfig()}
        >>> module = PlanModule(Agent(task, dynamics=HybridDynamics.hybrid(task), **parts))
        >>> module(torch.tensor([1.0, 0.0, 0.0]), torch.randn(module.noise_shape)).shape
        torch.Size([1])
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        planner = agent.planner
        if planner is None:
            raise ValueError("agent: expected one with a planner, got one that acts without.")
        if not planner.env.tensor_model.compiles:
            raise ValueError("agent: expected a model whose integrator compiles, got another.")
        self.planner = planner  # whose parameters are then this module's
        self.noise_shape = planner.settings.noise_shape((), agent.task.system.action_dim)
        self._observation = agent.task.system.observe(agent.task.reset.sample([]))

    def forward(self, observation: Tensor, noise: Tensor) -> Tensor:
        """The first action of a plan."""
        planner = self.planner
        found = plan(observation, noise, problem=planner.problem(), settings=planner.settings)
        return found.actions[0]

    def example(self) -> tuple[Tensor, Tensor]:
        """Inputs of the right shapes."""
        return self._observation, torch.randn(self.noise_shape)


def export_aoti(module: PlanModule, path: str | Path) -> Act:
    """Write an AOTInductor package (``.pt2``), which C++ and Python run.

    Args:
        module: the plan.
        path: where to write it.

    Returns:
        What the file computes, loaded again.
    """
    with torch.no_grad():
        program = torch.export.export(module, module.example())
        package = torch._inductor.aoti_compile_and_package(program, package_path=str(path))
    return torch._inductor.aoti_load_package(package)


def export_onnx(module: PlanModule, path: str | Path) -> Act:
    """Write an ONNX model, which ONNX Runtime runs.

    Args:
        module: the plan.
        path: where to write it.

    Returns:
        What the file computes, loaded into ONNX Runtime.

    Raises:
        ImportError: if the ``onnx`` extra is not installed.
    """
    try:
        import onnxruntime
        import onnxscript  # noqa: F401  (torch.onnx needs it)
    except ImportError as error:
        raise ImportError(
            f"{error.name}: expected it for ONNX, it is not installed; "
            "`pip install 'phihp_torchrl[onnx]'` brings it."
        ) from error
    with torch.no_grad():
        program = torch.onnx.export(
            module,
            module.example(),
            input_names=["observation", "noise"],
            output_names=["action"],
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # None comes from the older exporter alone
    program.save(str(path))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(str(path), options)

    def act(observation: Tensor, noise: Tensor) -> Tensor:
        inputs = {"observation": observation.numpy(), "noise": noise.numpy()}
        return torch.from_numpy(session.run(["action"], inputs)[0])

    return act


def largest_differences(act: Act, module: PlanModule, observations: Tensor) -> Tensor:
    """How far exported actions are from the eager ones at most, ``[N]``, same noise.

    Args:
        act: the exported plan.
        module: the eager one.
        observations: where to plan from, ``[N, o]``.
    """
    differences = []
    with torch.no_grad():
        for observation in observations:
            noise = torch.randn(module.noise_shape)
            expected = module(observation, noise)
            differences.append((act(observation, noise) - expected).abs().max())
    return torch.stack(differences)
