"""What a policy earns in the real world, over many episodes at once."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.tasks import Task, get_task


@dataclass(frozen=True)
class Evaluation:
    """The episodes that a policy played.

    Args:
        task: name of the task.
        seed: where the episodes' randomness came from.
        returns: undiscounted return of each episode, ``[episodes]``.
        lengths: steps of each episode, int64 ``[episodes]``.
        terminated: which ended before time ran out, bool ``[episodes]``.
        seconds: how long it took.
    """

    task: str
    seed: int
    returns: Tensor
    lengths: Tensor
    terminated: Tensor
    seconds: float

    @property
    def mean(self) -> float:
        """Mean return."""
        return self.returns.mean().item()

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes; 0 for one episode."""
        return self.returns.std().item() if len(self.returns) > 1 else 0.0

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return."""
        return self.std / math.sqrt(len(self.returns))

    def summary(self) -> dict[str, float]:
        """Numbers for a logger or a JSON file."""
        return {
            "return_mean": self.mean,
            "return_std": self.std,
            "return_min": self.returns.min().item(),
            "return_max": self.returns.max().item(),
            "length_mean": self.lengths.float().mean().item(),
            "terminated_share": self.terminated.float().mean().item(),
            "episodes": float(len(self.returns)),
            "seconds": self.seconds,
        }


def evaluate(
    policy: TensorDictModuleBase,
    task: str | Task,
    *,
    episodes: int = 50,
    seed: int = EVALUATION_SEED,
    env: EnvBase | None = None,
    device: torch.device | str | None = None,
) -> Evaluation:
    """Play ``episodes`` episodes, all at once, and sum their rewards until each is over.

    Two policies evaluated with one seed start from the same states, so their returns are paired.
    The global random state is left as it was.

    Args:
        policy: reads ``"observation"``, writes ``"action"``. It is called with all episodes as its
            batch; one that remembers is told by ``"is_init"`` where an episode starts.
        task: a task or the name of a registered one.
        episodes: how many.
        seed: seed of the starts and of what the policy draws from torch's global generator. See
            :func:`~phihp_torchrl.evaluation.evaluation_seed`.
        env: another world than the task's own, a TorchRL environment of batch size ``[]`` or
            ``[n]``; it plays as many rounds as are needed, of ``task.max_steps`` at most.
        device: where the policy acts, if ``env`` does not say so.

    Raises:
        ValueError: if ``episodes`` is not positive, or ``env`` has more than one batch dim.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> still = TensorDictModule(lambda obs: 0 * obs[..., :1], ["observation"], ["action"])
        >>> result = evaluate(still, "cartpole", episodes=10)
        >>> result.returns.shape, bool((result.lengths < 500).all())
        (torch.Size([10]), True)
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int) or episodes < 1:
        raise ValueError(f"episodes: expected a positive whole number, got {episodes!r}.")
    task = get_task(task) if isinstance(task, str) else task
    if env is not None and len(env.batch_size) > 1:
        raise ValueError(f"env: expected batch size [] or [n], got {list(env.batch_size)}.")
    device = torch.device(device or "cpu") if env is None else (env.device or torch.device("cpu"))
    start = time.perf_counter()
    cuda = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=cuda), torch.no_grad():
        torch.manual_seed(seed)
        if env is None:
            played = _play_task(policy, task, episodes, seed, device)
        else:
            env.set_seed(seed)
            rounds = math.ceil(episodes / env.batch_size.numel())
            columns = zip(
                *(_play_env(policy, env, task.max_steps) for _ in range(rounds)), strict=True
            )
            played = tuple(torch.cat(column)[:episodes] for column in columns)
    returns, lengths, terminated = (column.cpu() for column in played)
    seconds = time.perf_counter() - start
    return Evaluation(task.name, seed, returns, lengths, terminated, seconds)


def _play_task(
    policy: TensorDictModuleBase, task: Task, episodes: int, seed: int, device: torch.device
) -> tuple[Tensor, ...]:
    """Returns, lengths and terminations ``[episodes]`` in the task's own world.

    On its tensors: an actor alone plays four times as fast as by way of the TorchRL environment.
    """
    generator = torch.Generator().manual_seed(seed)
    world = TaskWorldModel(task, HybridDynamics.oracle(task))
    state = task.reset.sample([episodes], generator=generator).to(device)
    tally = _Tally(episodes, device)
    for step in range(task.max_steps):
        tensordict = TensorDict(
            observation=world.observe(state),
            is_init=torch.full([episodes, 1], step == 0, device=device),
            batch_size=[episodes],
        )
        next_state, reward, terminated = world.transition(state, policy(tensordict)["action"])
        # An episode that is over stays where it was, whatever lies beyond.
        state = torch.where((tally.alive & ~terminated).unsqueeze(-1), next_state, state)
        if tally.add(reward, terminated, terminated):
            break
    return tally.returns, tally.lengths, tally.terminated


def _play_env(
    policy: TensorDictModuleBase, env: EnvBase, max_steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns, lengths and terminations ``[n]`` of one episode in each world of ``env``."""
    tensordict = env.reset()
    tally = _Tally(env.batch_size.numel(), tensordict.device)
    is_init = torch.ones([*env.batch_size, 1], dtype=torch.bool, device=tensordict.device)
    for _ in range(max_steps):
        tensordict = policy(tensordict.set("is_init", is_init))
        # A world whose episode is over starts another, which does not count.
        tensordict, following = env.step_and_maybe_reset(tensordict)
        step = tensordict.get("next")
        is_init = step["done"]
        if tally.add(step["reward"], step["terminated"], is_init):
            break
        tensordict = following
    return tally.returns, tally.lengths, tally.terminated


class _Tally:
    """Sums of the episodes that are not over, ``[n]``."""

    def __init__(self, count: int, device: torch.device | None) -> None:
        self.returns = torch.zeros(count, dtype=torch.float64, device=device)
        self.lengths = torch.zeros(count, dtype=torch.int64, device=device)
        self.terminated = torch.zeros(count, dtype=torch.bool, device=device)
        self.alive = torch.ones(count, dtype=torch.bool, device=device)

    def add(self, reward: Tensor, terminated: Tensor, done: Tensor) -> bool:
        """Count a step; whether all episodes are over."""
        self.returns += torch.where(self.alive, reward.reshape(-1).to(torch.float64), 0.0)
        self.lengths += self.alive
        self.terminated |= self.alive & terminated.reshape(-1)
        self.alive &= ~done.reshape(-1)
        return not self.alive.any()
