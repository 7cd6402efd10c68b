"""The classes of agents that files may name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from phihp_torchrl.config import Registry
from phihp_torchrl.deployment.agent import Agent

AGENT_KINDS: Registry[type[Agent]] = Registry("kind")
"""Registered classes of agents, by the ``kind`` in their files."""

AGENT_KINDS.register(Agent.kind, Agent)

# Of ours that come with a folder of their own, where it is: a file may name a kind, never a module.
_HOMES = {"td-mpc": "phihp_torchrl.tdmpc"}


def register_agent(agent: type[Agent], *, replace: bool = False) -> type[Agent]:
    """Register a class of agents, so that files of its ``kind`` can be loaded; returns the class.

    Raises:
        ConfigError: if the kind is taken and ``replace`` is false.

    Examples:
        >>> register_agent(Agent, replace=True).kind
        'phihp'
    """
    return AGENT_KINDS.register(agent.kind, agent, replace=replace)


def find_kind(kind: Any) -> type[Agent]:
    """Return the class of a kind; raises ConfigError for an unknown one."""
    if isinstance(kind, str) and kind in _HOMES and kind not in AGENT_KINDS:
        import_module(_HOMES[kind])
    return AGENT_KINDS.find(kind)
