"""The systems that the paper compares, and which runs each is in."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperSystem:
    """A row or a column of the paper.

    Args:
        name: the paper's name.
        sources: methods whose runs it is in, and how it acts there (``None``: as that run does).
            The first that a seed was run with counts: PhIHP's actor alone is TD3-im-ph.
    """

    name: str
    sources: tuple[tuple[str, str | None], ...]


PHIHP = PaperSystem("PhIHP", (("phihp", "planner"),))
TD3_IM_PH = PaperSystem("TD3-im-ph", (("td3-im-ph", "actor"), ("phihp", "actor")))
TD3_IM_DD = PaperSystem("TD3-im-dd", (("td3-im-dd", "actor"),))
TD_MPC = PaperSystem("TD-MPC", (("td-mpc", None),))
TD3 = PaperSystem("TD3", (("td3", None),))
CEM_ORACLE = PaperSystem("CEM-oracle", (("cem-oracle", None),))
PH_CEM = PaperSystem("Ph-CEM", (("ph-cem", None),))
DD_CEM = PaperSystem("dd-CEM", (("dd-cem", None),))
PH_TD_MPC_STAR = PaperSystem("Ph-TD-MPC*", (("ph-td-mpc-star", "planner"),))
TD_MPC_STAR = PaperSystem("TD-MPC*", (("td-mpc-star", "planner"),))

BASELINES = (TD_MPC, TD3, CEM_ORACLE)
"""What the paper compares PhIHP with."""

ABLATIONS = (TD_MPC_STAR, PH_TD_MPC_STAR, DD_CEM, PH_CEM)
"""PhIHP without a part of it."""

IMAGINED = (TD3_IM_PH, TD3_IM_DD)
"""The policy alone, learned in either model."""

SYSTEMS = (PHIHP, *BASELINES, *ABLATIONS, *IMAGINED)
"""All systems of the paper."""
