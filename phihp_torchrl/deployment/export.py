"""Export of an agent's planner as one file, which runs without Python or without torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.planners import CEMPlanner, cem_plan, colored

Act = Callable[[Tensor, Tensor], Tensor]
"""A function from observation ``[o]`` and standard normal noise to an action ``[m]``."""


class PlanModule(nn.Module):
    """One plan of an agent as a module of tensors, for export: observation and noise to action.

    It reads an observation ``[o]`` and standard normal noise of shape ``noise_shape``, and returns
    an action ``[m]``. It draws no random numbers and keeps nothing between steps, so it plans at
    every step, regardless of ``replan_every``, ``warm_start`` and ``keep_incumbent``, and the first
    action of a plan has no ``change_cost``.

    Args:
        agent: an agent that plans by a :class:`~phihp_torchrl.CEMPlanner`.

    Raises:
        ConfigError: for an agent without such a planner, or whose model does not compile.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor, TwinQ
        >>> from phihp_torchrl.planners import CEMConfig
        >>> task = get_task("pendulum")
        >>> parts = {"actor": Actor(task), "qvalue": TwinQ(task), "planner_config": CEMConfig()}
        >>> module = PlanModule(Agent(task, dynamics=HybridDynamics.hybrid(task), **parts))
        >>> module(torch.tensor([1.0, 0.0, 0.0]), torch.randn(module.noise_shape)).shape
        torch.Size([1])
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        planner = agent.planner
        if planner is None:
            raise ConfigError("agent", "expected one with a planner, got one that acts without.")
        if not isinstance(planner, CEMPlanner):
            raise ConfigError(
                "agent",
                f"expected one that plans with a CEMPlanner, got a {type(planner).__name__}: it "
                "starts each plan from the one before, and a plan by itself is not what it does.",
            )
        if not getattr(planner.env.tensor_model, "compiles", True):
            raise ConfigError("agent", "expected a model whose integrator compiles, got another.")
        self.planner = planner  # whose parameters are then this module's
        self.noise_shape = planner.settings.noise_shape((), agent.task.action_dim)
        colored(
            torch.zeros(self.noise_shape), planner.settings.noise_beta, dim=1
        )  # cached for export
        self._observation = agent.task.observe(agent.task.sample_start([]))

    def forward(self, observation: Tensor, noise: Tensor) -> Tensor:
        """Return the first action of a plan, ``[m]``."""
        planner = self.planner
        noise = colored(noise, planner.settings.noise_beta, dim=1)
        found = cem_plan(observation, noise, problem=planner.problem(), settings=planner.settings)
        return found.actions[0]

    def example(self) -> tuple[Tensor, Tensor]:
        """Return an observation and noise of the right shapes."""
        return self._observation, torch.randn(self.noise_shape)


def export_aoti(module: PlanModule, path: str | Path) -> Act:
    """Write a plan as an AOTInductor package (``.pt2``), which C++ and Python can run.

    Args:
        module: the plan.
        path: the file to write.

    Returns:
        The function in the file, loaded again: observation ``[o]`` and noise to action ``[m]``.

    Examples:
        The export compiles C++ code, which takes about a minute.

        >>> from phihp_torchrl import load_agent
        >>> module = PlanModule(load_agent("results/agents/pendulum"))  # doctest: +SKIP
        >>> act = export_aoti(module, "plan.pt2")  # doctest: +SKIP
        >>> act(*module.example()).shape  # doctest: +SKIP
        torch.Size([1])
    """
    with torch.no_grad():
        program = torch.export.export(module, module.example())
        package = torch._inductor.aoti_compile_and_package(program, package_path=str(path))
    return torch._inductor.aoti_load_package(package)


def export_onnx(module: PlanModule, path: str | Path) -> Act:
    """Write a plan as an ONNX model, which ONNX Runtime can run.

    Args:
        module: the plan.
        path: the file to write.

    Returns:
        The function in the file, loaded into ONNX Runtime: observation ``[o]`` and noise to action
        ``[m]``.

    Raises:
        ImportError: if the ``onnx`` extra is not installed.

    Examples:
        This needs the ``onnx`` extra.

        >>> from phihp_torchrl import load_agent
        >>> module = PlanModule(load_agent("results/agents/pendulum"))  # doctest: +SKIP
        >>> act = export_onnx(module, "plan.onnx")  # doctest: +SKIP
        >>> act(*module.example()).shape  # doctest: +SKIP
        torch.Size([1])
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
    """Return the largest difference of exported and eager actions for each observation, ``[N]``.

    Args:
        act: the exported plan.
        module: the eager plan, which gets the same noise.
        observations: observations to plan from, ``[N, o]``.
    """
    differences = []
    with torch.no_grad():
        for observation in observations:
            noise = torch.randn(module.noise_shape)
            expected = module(observation, noise)
            differences.append((act(observation, noise) - expected).abs().max())
    return torch.stack(differences)
