"""Iterative LQR with a receding horizon, in a model."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.control_problem import ControlProblem, Expansion, Trajectory
from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.config import ConfigError, check_count, check_fields, check_positive
from phihp_torchrl.tasks import Task

_HELD = 8
"""Changes of a first guess's random actions within the horizon."""
_LEAST, _MOST = 1e-6, 1e6
"""Bounds of the damping."""
_EASE, _BRAKE = 0.3, 10.0
"""Factors of the damping after a round that helped, and after one that did not."""


@dataclass(frozen=True)
class ILQRConfig:
    """How a plan is made.

    Args:
        horizon: steps of a plan.
        rounds: rounds of improvement of a plan that is left over from the step before.
        first_rounds: rounds of a first plan, at the start of an episode.
        guesses: random first plans, of which the best is improved.
        step_sizes: sizes of a step of improvement that are tried side by side.
        damping: first weight of a change of the action, in units of its bounds and of the reward's
            spread.

    Raises:
        ConfigError: for a number out of range; the message names it.
    """

    horizon: int = 50
    rounds: int = 2
    first_rounds: int = 20
    guesses: int = 32
    step_sizes: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1, 0.03)
    damping: float = 1e-3

    def __post_init__(self) -> None:
        check_fields(self)
        check_count(self, "horizon", "rounds", "first_rounds", "guesses")
        check_positive(self, "damping")
        if not self.step_sizes or not all(0.0 < size <= 1.0 for size in self.step_sizes):
            raise ConfigError(
                "step_sizes", f"expected some numbers in (0, 1], got {self.step_sizes}."
            )


class ILQR(Controller):
    r"""Model-predictive control by iterative LQR: a plan at each step, whose first action is used.

    A plan is improved in rounds. Each expands the model around the plan's states, solves the
    quadratic problem backwards in time for a law :math:`\bar a + \alpha k + K (s - \bar s)`, and
    rolls it out for several α at once; the cheapest is kept, or the plan as it was
    (Tassa, Erez and Todorov, 2012, https://doi.org/10.1109/IROS.2012.6386025; with bounds as in
    Tassa, Mansard and Todorov, 2014, https://doi.org/10.1109/ICRA.2014.6907001, whose active set is
    found in m passes and then kept). Where a round does not help, changes are damped more.

    The cost is the negative reward, with prices. Behind the horizon the cost-to-go of the
    :class:`LQR` counts, where the task has a goal and no reference. Where the reward has no slope
    at all, as one for staying alive, the weights of the LQR take its place, and without a goal
    there is then nothing to plan for. Everything under way in an actuator belongs to the state. It
    ignores ends of an episode, and finds one local optimum: from the best of some first guesses at
    the start of an episode, and from the plan before at every other step.

    Args:
        problem: the task in a model.
        config: how to plan.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> ilqr = ILQR.from_model(task, HybridDynamics.pure_prior(task))
        >>> leaning = task.observe(torch.tensor([[0.1, 0.0], [-0.1, 0.0]]))
        >>> action = ilqr(TensorDict(observation=leaning, batch_size=[2]))["action"]
        >>> action.shape, bool(action[0] < 0 < action[1])
        (torch.Size([2, 1]), True)
    """

    def __init__(self, problem: ControlProblem, config: ILQRConfig | None = None) -> None:
        super().__init__(problem.task)
        self.problem, self.config = problem, config or ILQRConfig()
        held = -(-self.config.horizon // _HELD)
        shape = [self.config.guesses, _HELD, self.task.action_dim]
        noise = 2.0 * torch.rand(shape, generator=torch.Generator().manual_seed(0)) - 1.0
        guesses = noise.repeat_interleave(held, 1)[:, : self.config.horizon]
        self.register_buffer("_guesses", torch.cat([torch.zeros_like(guesses[:1]), guesses]))
        self.reset()

    @property
    def dynamics(self) -> nn.Module:
        """The model that it was made in."""
        return self.problem.dynamics

    @classmethod
    def from_model(cls, task: Task, dynamics: nn.Module, config: ILQRConfig | None = None) -> ILQR:
        """Build it for a task in a model.

        Args:
            task: the task.
            dynamics: the model, ``(state, action) -> next state``, which can be differentiated.
            config: how to plan.

        Raises:
            ConfigError: for a task without a goal whose reward has no slope.
        """
        if task.reference is not None:
            return cls(ControlProblem(task, dynamics, None, "it follows a reference"), config)
        try:
            lqr, reason = LQR.from_model(task, dynamics), ""
        except ConfigError as error:
            lqr, reason = None, str(error)
        return cls(ControlProblem(task, dynamics, lqr, reason), config)

    def reset(self) -> None:
        """Forget the plans."""
        self._plan: Trajectory | None = None
        self._damping: Tensor | None = None

    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        rows = state.reshape(-1, state.shape[-1])
        new = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        new = new if starts is None else starts.reshape(-1)
        kept, damping = self._plan, self._damping
        if kept is None or damping is None or kept.states[0].shape != rows.shape:
            plans, new = self._first(rows), torch.ones_like(new)
            damping = torch.full_like(rows[:, 0], self.config.damping)
        else:
            plans = self._shifted(kept).to(rows)
            damping = damping.to(rows).masked_fill(new, self.config.damping)
            if new.any():
                plans = torch.where(new[:, None], self._first(rows), plans)
        plan = self._follow(rows, plans)
        for k in range(self.config.first_rounds if new.any() else self.config.rounds):
            plan, damping = self._improve(plan, damping, new | (k < self.config.rounds))
        self._plan, self._damping = plan, damping
        return self.problem.physical(plan.actions[0]).reshape(*state.shape[:-1], -1)

    def _first(self, rows: Tensor) -> Tensor:
        """The cheapest first guess of each row, ``[H, N, m]``; the regulator makes one of them."""
        guesses = self._guesses.to(rows)
        many = rows.expand(len(guesses), *rows.shape)
        tried = [self.problem.roll(many, lambda k, s: guesses[:, k, None].expand(*s.shape[:-1], -1),
                                   self.config.horizon)]  # fmt: skip
        if (lqr := self.problem.lqr) is not None:
            law = lambda k, s: self.problem.unit(lqr.act(s))  # noqa: E731
            tried.append(self.problem.roll(rows[None], law, self.config.horizon))
        best = torch.cat([each.cost for each in tried]).argmin(0)
        actions = torch.cat([each.actions for each in tried], 1)
        return actions[:, best, torch.arange(len(rows), device=rows.device)]

    def _shifted(self, plan: Trajectory) -> Tensor:
        """The plans of the step before without their first action; the regulator adds the last."""
        lqr, end = self.problem.lqr, plan.states[-1]
        last = plan.actions[-1] if lqr is None else self.problem.unit(lqr.act(end))
        return torch.cat([plan.actions[1:], last[None]])

    def _follow(self, rows: Tensor, actions: Tensor) -> Trajectory:
        return self.problem.roll(rows, lambda k, s: actions[k], self.config.horizon)

    def _improve(
        self, plan: Trajectory, damping: Tensor, active: Tensor
    ) -> tuple[Trajectory, Tensor]:
        """One round for the active rows ``[N]``; a plan never gets dearer."""
        change, gain = solve(self.problem.expand(plan), plan.actions, damping)
        sizes = damping.new_tensor((0.0, *self.config.step_sizes))[:, None, None]

        def law(k: int, state: Tensor) -> Tensor:
            error = self.problem.difference(state, plan.states[k].expand_as(state))
            back = (gain[k] @ error.unsqueeze(-1)).squeeze(-1)
            return plan.actions[k] + sizes * change[k] + back

        start = plan.states[0].expand(len(sizes), *plan.states[0].shape)
        tried = self.problem.roll(start, law, len(plan.actions))
        best = tried.cost.argmin(0)
        better = active & (tried.cost.min(0).values < plan.cost)
        best = torch.where(better, best, 0)
        rows = torch.arange(len(best), device=best.device)
        taken = Trajectory(tried.states[:, best, rows], tried.actions[:, best, rows],
                           tried.cost[best, rows])  # fmt: skip
        factor = torch.where(best > 0, _EASE, _BRAKE)
        damping = torch.where(active, (damping * factor).clamp(_LEAST, _MOST), damping)
        # A row whose plan is kept keeps it to the bit.
        kept = Trajectory(
            torch.where(better[:, None], taken.states, plan.states),
            torch.where(better[:, None], taken.actions, plan.actions),
            torch.where(better, taken.cost, plan.cost),
        )
        return kept, damping


def solve(problem: Expansion, actions: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the quadratic problem backwards in time, with the actions within -1 and 1.

    Args:
        problem: the problem around the actions.
        actions: ``[H, N, m]``.
        damping: the weight of a change, ``[N]``.

    Returns:
        Changes of the actions ``[H, N, m]``, and gains ``[H, N, m, n]``; an action that meets its
        bound has none.
    """
    n, m = problem.slope.shape[-2], actions.shape[-1]
    value, curve = problem.last_gradient, problem.last_curvature
    damped = damping[:, None, None] * torch.eye(m).to(damping)
    changes, gains = [], []
    for k in reversed(range(len(actions))):
        slope = problem.slope[k]
        q = problem.gradient[k] + (slope.mT @ value.unsqueeze(-1)).squeeze(-1)
        qq = problem.curvature[k] + slope.mT @ curve @ slope
        qu, quu, qux = q[:, n:], qq[:, n:, n:], qq[:, n:, :n]
        change, gain = _bounded(quu + damped, qu, qux, actions[k])
        moved = (quu @ change.unsqueeze(-1)).squeeze(-1) + qu
        value = q[:, :n] + (gain.mT @ moved.unsqueeze(-1) + qux.mT @ change.unsqueeze(-1))[..., 0]
        crossed = gain.mT @ qux
        curve = qq[:, :n, :n] + gain.mT @ quu @ gain + crossed + crossed.mT
        curve = (curve + curve.mT) / 2
        changes.append(change)
        gains.append(gain)
    return torch.stack(changes[::-1]), torch.stack(gains[::-1])


def _bounded(quu: Tensor, qu: Tensor, qux: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """The change ``[N, m]`` that is cheapest in the bounds, and the gain of the free actions."""
    change, free = torch.zeros_like(qu), torch.ones_like(qu, dtype=torch.bool)
    same = torch.eye(qu.shape[-1]).to(qu)
    for _ in range(qu.shape[-1]):
        matrix = torch.where(free[:, :, None] & free[:, None], quu, same)
        held = torch.where(free, 0.0, change)
        right = torch.where(free, -qu - (quu @ held.unsqueeze(-1)).squeeze(-1), held)
        change = torch.linalg.solve(matrix, right)
        inside = (-1.0 - action <= change) & (change <= 1.0 - action)
        change = change.clamp(-1.0 - action, 1.0 - action)
        free = free & inside
    matrix = torch.where(free[:, :, None] & free[:, None], quu, same)
    return change, -torch.linalg.solve(matrix, torch.where(free[:, :, None], qux, 0.0))
