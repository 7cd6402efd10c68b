"""Strategies of the policy phase: other settings to learn by where the reward is sparse."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from phihp_torchrl.config import ConfigError, Registry
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.policy_config import PolicyConfig

AS_SET = "as-set"
"""The name under which the settings themselves are tried, before any strategy."""

# Shares of an episode's duration. With them an actor for dm_control's pendulum, a mountain car and
# other swing-ups of 10 to 30 s is found, whatever their time steps.
_CONSTANT, _LIFE, _EXPANSION = 0.4, 0.6, 0.01
_MOST_EXPANDED, _LEAST_EXPANDED = 5, 3
_SATURATION = 0.1  # its price
_WORLDS = 4  # times the imagined worlds
_GROWTH = 0.6  # share of the updates within which starts reach the coverage box


@dataclass(frozen=True)
class Strategy:
    """A way to change the settings of the policy phase.

    Args:
        about: what it does, for people.
        change: the changed settings for a task, from settings without texts of seconds; the same
            settings where it has nothing to change.

    Examples:
        >>> patient = Strategy("twice as long", lambda c, task: replace(c, updates=2 * c.updates))
        >>> from phihp_torchrl import get_task
        >>> patient.change(PolicyConfig(), get_task("pendulum")).updates
        16000
    """

    about: str
    change: Callable[[PolicyConfig, Task], PolicyConfig]


def look_further(config: PolicyConfig, task: Task) -> PolicyConfig:
    """A discount nearer 1, a longer value expansion, and lives that leave time for starts.

    The time constant of the discount becomes 0.4 of an episode's duration and lives last 0.6 of it,
    unless they are set; the expansion is a hundredth of it, but 3 to 5 steps, as its time grows
    with them. A discount or an expansion that reaches further already is kept. Saturated actions
    have a price: an actor that meets no reward for long ends at its bounds everywhere, and would
    stay there, for tanh has no slope, when at last it meets one.

    Args:
        config: settings of the phase.
        task: the task, for the length of its episodes.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> far = look_further(PolicyConfig(), replace(get_task("pendulum"), max_steps=500))
        >>> round(far.td3.gamma, 3), far.td3.value_expansion, far.max_age
        (0.995, 5, 300)
    """
    steps = task.max_steps
    gamma = math.exp(-1.0 / (_CONSTANT * steps))
    expansion = min(_MOST_EXPANDED, max(_LEAST_EXPANDED, round(_EXPANSION * steps)))
    td3 = replace(
        config.td3,
        gamma=max(config.td3.gamma, gamma),
        value_expansion=max(config.td3.value_expansion, expansion),
        saturation_cost=max(config.td3.saturation_cost, _SATURATION),
    )
    return replace(config, td3=td3, max_age=config.max_age or max(1, round(_LIFE * steps)))


def start_wider(config: PolicyConfig, task: Task) -> PolicyConfig:
    """As :func:`look_further`, with nearly all starts over the coverage and wilder actions.

    Args:
        config: settings of the phase.
        task: the task; without a coverage box there is nothing wider.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> start_wider(PolicyConfig(), get_task("pendulum")).random_fraction
        0.3
    """
    if task.coverage is None:
        return config
    start = replace(config.start, reset=0.1, coverage=0.9, data=0.0, goal=0.0, rewarding=0.0)
    return replace(look_further(config, task), start=start, random_fraction=0.3)


def start_at_goal(config: PolicyConfig, task: Task) -> PolicyConfig:
    """As :func:`look_further`, with most starts where the reward is met.

    That is the task's goal box, or else the states of its coverage box that earn most at once, and
    those around them (:func:`~phihp_torchrl.imagination.rewarding_states`). There are four times
    as many imagined worlds, for such lives differ, but plans in no more of them. The critics are
    fitted at the end alone: to go on from the best actor so far, again and again, would hold up
    what returns show last.

    Args:
        config: settings of the phase.
        task: the task; without either box there is nothing to start near.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> start_at_goal(PolicyConfig(), get_task("cartpole-swingup")).start.goal
        0.6
        >>> start_at_goal(PolicyConfig(), get_task("pendulum")).start.rewarding
        0.6
    """
    if task.goal is None and task.coverage is None:
        return config
    kind = "rewarding" if task.goal is None else "goal"
    start = replace(config.start, reset=0.2, coverage=0.2, data=0.0, goal=0.0, rewarding=0.0)
    return replace(
        look_further(config, task),
        start=replace(start, **{kind: 0.6}),
        num_worlds=_WORLDS * config.num_worlds,
        planned=config.planned / _WORLDS,
        refit=replace(config.refit, start=0),
    )


def start_backwards(config: PolicyConfig, task: Task) -> PolicyConfig:
    """As :func:`look_further`, with starts near the goal at first and from ever further away.

    Args:
        config: settings of the phase.
        task: the task; without a goal box and a coverage box there is no way back from the goal.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> start_backwards(PolicyConfig(), get_task("cartpole-swingup")).start.growth
        0.6
    """
    if task.goal is None or task.coverage is None:
        return config
    start = replace(config.start, reset=0.1, coverage=0.0, data=0.0, goal=0.9, rewarding=0.0)
    start = replace(start, growth=_GROWTH)
    return replace(look_further(config, task), start=start)


def learn_by_gradients(config: PolicyConfig, task: Task) -> PolicyConfig:
    """As :func:`look_further`, by policy gradients through the model where that is smooth.

    Args:
        config: settings of the phase.
        task: the task; a model with stops (``position_limits``) is not smooth.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> learn_by_gradients(PolicyConfig(), get_task("pendulum")).method
        'analytic'
    """
    if task.position_limits or config.method == "analytic":
        return config
    further, analytic = look_further(config, task), config.analytic
    together = config.num_worlds * analytic.horizon
    # One actor update has this many of the critics, which has to divide all three.
    count = math.gcd(analytic.critic_updates, config.updates, config.evaluation_interval, together)
    analytic = replace(analytic, critic_updates=count)
    return replace(further, method="analytic", analytic=analytic)


STRATEGIES: Registry[Strategy] = Registry("policy.strategies")
"""Strategies by name, in the order in which ``auto`` tries them."""

STRATEGIES.register("goal", Strategy("starts where the reward is met", start_at_goal))
STRATEGIES.register("analytic", Strategy("learns by gradients", learn_by_gradients))
STRATEGIES.register("further", Strategy("looks further ahead", look_further))
STRATEGIES.register("wide", Strategy("starts everywhere", start_wider))
STRATEGIES.register("backwards", Strategy("starts ever further from the goal", start_backwards))


def strategies_of(config: PolicyConfig) -> tuple[str, ...]:
    """The names of the strategies that ``config.strategies`` asks for.

    Raises:
        ConfigError: for a name of no strategy.

    Examples:
        >>> strategies_of(PolicyConfig()), strategies_of(PolicyConfig(strategies="none"))
        (('goal', 'analytic', 'further', 'wide', 'backwards'), ())
    """
    asked = config.strategies
    if isinstance(asked, str):
        return tuple(STRATEGIES) if asked == "auto" else ()
    if unknown := [name for name in asked if name not in STRATEGIES]:
        raise ConfigError(
            "policy.strategies", f"expected some of {list(STRATEGIES)}, got {unknown}."
        )
    return asked
