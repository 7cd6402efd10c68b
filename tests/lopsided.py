"""A task whose action reaches twice as far up as down."""

from __future__ import annotations

from dataclasses import replace

from phihp_torchrl import get_task

LOPSIDED = replace(
    get_task("pendulum"), name="lopsided-pendulum", action_low=(-6.0,), action_high=(12.0,)
)
