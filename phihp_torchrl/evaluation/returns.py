"""Returns of a policy in a world, over many episodes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, SerialEnv

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import plain_defaults
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation.acted import acted, whole
from phihp_torchrl.evaluation.episode import Episode
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.evaluation.tally import Tally
from phihp_torchrl.evaluation.violations import Violations
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.worlds import SimulatedWorld, World

AT_ONCE = 64
"""Environments of a world in which evaluation plays at once, at most."""
DOING = "playing episodes"
"""What a run says that it is doing while this is on its stack."""


@dataclass(frozen=True)
class Evaluation:
    """The returns and lengths of the episodes that a policy played.

    Args:
        task: name of the task.
        seed: seed of the episodes.
        returns: undiscounted return of each episode, ``[episodes]``.
        lengths: steps of each episode, int64 ``[episodes]``.
        terminated: whether each episode was terminated, not truncated, bool ``[episodes]``.
        seconds: duration of the evaluation.
        chatter: mean change of the action from step to step in the second half of each episode, as
            a share of its half-range, ``[episodes]``; ``None`` where it was not measured.
        violations: violations of the task's constraints by their names; ``None`` without any.
        first: the first episode in full, without pictures; ``None`` where the world was not a
            simulated one.

    Examples:
        >>> returns, lengths = torch.tensor([-200.0, -100.0]), torch.tensor([200, 200])
        >>> result = Evaluation("pendulum", 0, returns, lengths, lengths < 200, seconds=1.0)
        >>> result.mean, round(result.standard_error, 1), result.summary()["terminated_share"]
        (-150.0, 50.0, 0.0)
    """

    task: str
    seed: int
    returns: Tensor
    lengths: Tensor
    terminated: Tensor
    seconds: float
    chatter: Tensor | None = None
    violations: Mapping[str, Violations] | None = None
    first: Episode | None = field(default=None, repr=False, compare=False)

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
        """Return statistics of the episodes as numbers for a logger or a JSON file."""
        measured = {} if self.chatter is None else {"chatter": self.chatter.mean().item()}
        for name, found in (self.violations or {}).items():
            measured |= found.summary(name, self.lengths)
        return {
            "return_mean": self.mean,
            "return_std": self.std,
            "return_min": self.returns.min().item(),
            "return_max": self.returns.max().item(),
            "length_mean": self.lengths.float().mean().item(),
            "terminated_share": self.terminated.float().mean().item(),
            **measured,
            "episodes": float(len(self.returns)),
            "seconds": self.seconds,
        }


@plain_defaults()
def evaluate(
    policy: TensorDictModuleBase,
    task: str | Task,
    *,
    episodes: int = 50,
    seed: int = EVALUATION_SEED,
    noise_seed: int | None = None,
    world: World | None = None,
    env: EnvBase | None = None,
    device: torch.device | str | None = None,
) -> Evaluation:
    """Evaluate a policy: play episodes in a world and return their undiscounted returns.

    In a simulated world all episodes are played at once as a batch; so are up to 64 in a world of
    which there may be several (:attr:`~phihp_torchrl.worlds.World.copies`); in other worlds they
    are played one after the other. Two policies that are evaluated with the same seed start from
    the same states. Global random states are restored.

    Args:
        policy: a module that reads ``"observation"`` and writes ``"action"``, called with all
            episodes as its batch. ``"is_init"`` is true where an episode starts.
        task: a task or the name of a registered one.
        episodes: number of episodes.
        seed: seed of the first states. See :func:`~phihp_torchrl.evaluation.evaluation_seed`.
        noise_seed: seed of torch's global generator, from which a policy draws its noise. Defaults
            to ``seed``.
        world: the world. Defaults to the simulated world of the task.
        env: a TorchRL environment to use instead of a world, of batch size ``[]`` or ``[n]``; it
            is reset as often as needed, and stepped ``task.max_steps`` times at most.
        device: device of the policy, for a simulated world.

    Raises:
        ConfigError: if ``episodes`` is not positive, ``env`` has more than one batch dimension, or
            the policy writes no action of the right shape.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> still = TensorDictModule(lambda obs: 0 * obs[..., :1], ["observation"], ["action"])
        >>> result = evaluate(still, "cartpole", episodes=10)
        >>> result.returns.shape, bool((result.lengths < 500).all())
        (torch.Size([10]), True)
    """
    episodes = whole("episodes", episodes, "a positive whole number", 1)
    seed = whole("seed", seed, "a whole number from 0 on", 0)
    task = find_task(task)
    with ExitStack() as stack:
        model = None
        if env is None:
            world = SimulatedWorld(task) if world is None else world
            model = world.model()
            env = None if model else stack.enter_context(_environments(world, episodes))
        if env is not None and len(env.batch_size) > 1:
            raise ConfigError("env", f"expected batch size [] or [n], got {list(env.batch_size)}.")
        where = device if env is None else env.device
        device = torch.device(where or "cpu")
        start, first = time.perf_counter(), None
        cuda = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices=cuda), torch.no_grad():
            torch.manual_seed(seed if noise_seed is None else noise_seed)
            if model is not None:
                played, first = _play_model(policy, model, task, episodes, seed, device)
            else:
                assert env is not None  # one of the two is there
                played = _play_rounds(policy, env, task, episodes, seed)
    returns, lengths, terminated, chatter, steps, largest = (column.cpu() for column in played)
    seconds = time.perf_counter() - start
    found = zip(task.limits.names, steps.unbind(-1), largest.unbind(-1), strict=True)
    violations = {name: Violations(*each) for name, *each in found} or None
    own = returns, lengths, terminated, seconds, chatter, violations
    return Evaluation(task.name, seed, *own, first)


@contextmanager
def _environments(world: World, episodes: int) -> Iterator[EnvBase]:
    """An environment of the world, or a batch of them where each is a world of its own."""
    count = min(episodes, AT_ONCE)
    if not world.copies or count == 1:
        yield world.make_env()
        return
    threads, several = torch.get_num_threads(), SerialEnv(count, world.make_env)
    try:
        yield several
    finally:
        several.close()
        torch.set_num_threads(threads)  # which the end of a batch of environments changes


def _play_model(
    policy: TensorDictModuleBase,
    world: TaskWorldModel,
    judged: Task,
    episodes: int,
    seed: int,
    device: torch.device,
) -> tuple[tuple[Tensor, ...], Episode]:
    """What a tally has of the episodes in a simulated world, and the first episode.

    ``judged`` has the constraints.

    An actor alone is four times as fast on the world's tensors as in the TorchRL environment.
    """
    task, generator = world.task, torch.Generator().manual_seed(seed)
    state, outside = task.sample_start([episodes], generator).to(device), task.outside
    # By a generator of their own, as the first states are.
    drawn = outside.draw([episodes], task.max_steps + 1, torch.Generator().manual_seed(seed))
    drawn = {name: values.to(device) for name, values in drawn.items()}
    tally = Tally(judged, episodes, device)
    observed, taken = [world.observe(state)[0]], []
    for step in range(task.max_steps):
        if outside:
            state = task.with_signals(state, outside.window(drawn, step))
        tensordict = TensorDict(
            observation=world.observe(state),
            is_init=torch.full([episodes, 1], step == 0, device=device),
            batch_size=[episodes],
        )
        action = acted(policy(tensordict), (episodes, task.action_dim))
        next_state, reward, terminated = world.transition(state, action)
        if judged.limits:
            tally.judge(task.split(next_state)[0], task.command(task.split(state)[1], action))
        observed.append(world.observe(next_state[:1])[0])
        taken.append((action[0], reward[0]))
        # The state of an episode that has ended is not changed any more.
        state = torch.where((tally.alive & ~terminated).unsqueeze(-1), next_state, state)
        finite = next_state.isfinite().all(-1)
        if tally.add(action, reward, terminated, terminated, finite):
            break
    return tally.result(), _first_episode(judged, tally, observed, taken)


def _first_episode(
    task: Task, tally: Tally, observed: list[Tensor], taken: list[tuple[Tensor, Tensor]]
) -> Episode:
    """The first of the episodes, of which all observations, actions and rewards are given."""
    length = int(tally.lengths[0])
    columns = (torch.stack(list(column)[:length]) for column in zip(*taken, strict=True))
    actions, rewards = (column.double().cpu().numpy() for column in columns)
    states = task.locate(torch.stack(observed[: length + 1]).double()).cpu().numpy()
    return Episode(task, states, actions, rewards, bool(tally.terminated[0]))


def _play_rounds(
    policy: TensorDictModuleBase, env: EnvBase, task: Task, episodes: int, seed: int
) -> tuple[Tensor, ...]:
    """What a tally has of the episodes, played in as many rounds as the environments need."""
    count, columns, following = env.batch_size.numel(), [], env.set_seed(seed)
    for k in range(math.ceil(episodes / count)):
        # Where an episode was over early, its environment has begun others, by what it drew next.
        if k and env.batch_size:
            following = env.set_seed(following)
        columns.append(_play_env(policy, env, task))
    return tuple(torch.cat(column)[:episodes] for column in zip(*columns, strict=True))


def _play_env(policy: TensorDictModuleBase, env: EnvBase, task: Task) -> tuple[Tensor, ...]:
    """What a tally has of an episode in each world of ``env``."""
    tensordict = env.reset()
    tally = Tally(task, env.batch_size.numel(), tensordict.device)
    is_init = torch.ones([*env.batch_size, 1], dtype=torch.bool, device=tensordict.device)
    for _ in range(task.max_steps):
        tensordict = policy(tensordict.set("is_init", is_init))
        acted(tensordict, env.action_spec.shape)
        # A world whose episode is over starts another, which does not count.
        tensordict, following = env.step_and_maybe_reset(tensordict)
        step = tensordict.get("next")
        if task.limits:
            tally.judge(*_judged(task, tensordict))
        is_init = step["done"]
        if tally.add(tensordict["action"], step["reward"], step["terminated"], is_init):
            break
        tensordict = following
    return tally.result()


def _judged(task: Task, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
    """The physical state after a step of an environment, as it was shown, and the command."""
    before, after = tensordict["observation"], tensordict["next", "observation"]
    state = task.system.locate(after[..., : task.system.observation_dim])
    if before.shape[-1] != task.observation_dim:  # what is under way is not shown
        return state, task.clip_action(tensordict["action"])
    registers = task.split(task.locate(before))[1]
    return state, task.command(registers, tensordict["action"])
