"""The paper's claims, each with its verdict."""

from __future__ import annotations

from pathlib import Path

from kept_runs import make_run, results

from report.claims import claims_section, fewer_samples, planning_improves
from report.paper_systems import (
    DD_CEM,
    PH_CEM,
    TD3_IM_DD,
    TD_MPC,
)


def test_each_claim_gets_its_verdict(tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(tmp_path, seed=seed, acting={"planner": [9.0, 9.5], "actor": [1.0, 2.0]}, ms=4.0)
        curve = ((2000, -9.0), (9000, 9.0), (20000, 9.0))
        acting = {"planner": [9.0, 9.0]}
        make_run(tmp_path, "td-mpc", seed=seed, samples=20000, curve=curve, acting=acting, ms=20.0)
        make_run(tmp_path, "td3", seed=seed, samples=300, acting={"actor": [9.0, 11.0]})
        make_run(tmp_path, "ph-cem", seed=seed, samples=500, acting={"planner": [5.0]})
        make_run(tmp_path, "ph-cem", seed=seed, samples=5000, acting={"planner": [1.0]})
        make_run(tmp_path, "dd-cem", seed=seed, samples=500, acting={"planner": [4.0]})
    found = results(tmp_path)
    lines = claims_section(found).text.splitlines()
    assert "borne out here: pendulum 9.0 times fewer (1000 against 9000)" in lines[0]
    assert "not borne out here: pendulum 9.2 against 10.0 (not)" in lines[1]
    assert "borne out here: pendulum +7.8 ± " in lines[2]
    assert "borne out here: Ph-CEM on pendulum 5.0 against 4.0" in lines[3]
    assert "borne out here: pendulum 5.0 times (4.0 ms against 20.0)" in lines[4]
    # Another task on which it is not.
    make_run(tmp_path, task="acrobot", acting={"planner": [1.0, 3.0], "actor": [1.0, 3.0]})
    assert "in 1 of 2 comparisons" in claims_section(results(tmp_path)).text.splitlines()[2]
    assert [finding.borne_out for finding in planning_improves(results(tmp_path))] == [True, False]
    assert [finding.what for finding in fewer_samples(found)] == ["pendulum"]


def test_hybrid_and_data_driven_are_compared_at_equal_samples_alone(tmp_path: Path) -> None:
    make_run(tmp_path, "td3-im-ph", samples=1000, acting={"actor": [-1.0]})
    make_run(tmp_path, "td3-im-dd", samples=500, acting={"actor": [-2.0]}, kind="data_driven")
    found = results(tmp_path)
    assert found.has_run(TD3_IM_DD, "pendulum")
    assert not found.has_run(DD_CEM, "pendulum")
    assert not found.has_run(PH_CEM, "pendulum")
    assert not found.has_run(TD_MPC, "pendulum")
    assert "not run" in claims_section(found).text.splitlines()[3]
