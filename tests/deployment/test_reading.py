"""Files that are missing, damaged, hostile or of another task: refused, by name, unharmed."""

from __future__ import annotations

import pickle

import pytest
import torch

from phihp_torchrl import get_task, load_agent, save_agent

from .agent_parts import SMALL, edit_json, edit_weights, make_agent, refused


@pytest.fixture
def saved(tmp_path):
    return save_agent(make_agent(), tmp_path, metadata={"seed": 0})


def test_missing_files(saved, tmp_path):
    assert "nowhere" in refused(tmp_path / "nowhere", "expected the directory of a saved agent")
    (saved / "weights.safetensors").rename(saved / "other")
    refused(saved, r"weights\.safetensors: expected this file")
    (saved / "agent.json").unlink()
    refused(saved, r"agent\.json: expected this file")
    refused(saved / "other", "expected the directory")


def test_other_tasks_and_versions(saved):
    refused(saved, "expected an agent for task 'acrobot', got one for 'pendulum'", task="acrobot")
    refused(saved, "expected an agent for task", task=get_task("acrobot"))
    refused(saved, "device: expected one that works", device="no-such-device")
    edit_json(saved, lambda c: c["task"].update(name="pendulum-swing-up"))
    refused(saved, "expected one of .*'pendulum-swingup'.* got 'pendulum-swing-up'")
    for version in (3, 0, -1, True, "2", None):
        edit_json(saved, lambda c, version=version: c.update(format_version=version))
        refused(
            saved, f"expected format_version 1 to 2, got {version!r}; it was written by version"
        )
    edit_json(saved, lambda c: c.update(format="soup"))
    refused(saved, "expected format 'phihp_torchrl agent', got 'soup'")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"", "expected JSON"),
        (b"{", "expected JSON"),
        (b"\xff\xfe\x00", "expected JSON"),
        (b"[" * 100_000, "expected JSON"),
        (b'{"format": NaN}', "NaN is not a number"),
        (b"[1]", "expected a JSON object, got list"),
        (b" " * 1_000_001, "expected at most 1000000 bytes"),
        (pickle.dumps({"format": 1}), "expected JSON"),
    ],
)
def test_what_is_not_json(saved, text, match):
    (saved / "agent.json").write_bytes(text)
    refused(saved, match)


def part(name, /, **changes):
    """A change of one part of the description."""
    return lambda content: content[name].update(**changes)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c.pop("dynamics"), r"missing \[\], not expected \['dynamics"),
        (lambda c: c.pop("task"), "expected the key 'task'"),
        (lambda c: c.pop("kind"), "kind: expected one of .*'phihp'.* got None"),
        (lambda c: c.update(kind="soup"), "kind: expected one of .*'phihp'.* got 'soup'"),
        (lambda c: c.update(kind=["phihp"]), "agent.json: "),
        (lambda c: c.update(metadata=3), "metadata: expected a JSON object"),
        (lambda c: c.update(task="pendulum"), "task: expected the keys"),
        (lambda c: c["task"].pop("action_low"), "task: expected the keys .*'action_low'"),
        (part("task", name=["pendulum"]), r"task\.name: expected a text"),
        (part("task", action_high=[3.0]), r"expected its action_high \(3.0,\)"),
        (part("task", action_low=[-3.0]), r"expected its action_low \(-3.0,\)"),
        (part("task", constants=["mass"]), r"expected its constants \('mass',\), got"),
        (part("dynamics", prior={"kind": "soup"}), "prior: expected one of .* got 'soup'"),
        (part("dynamics", prior="soup"), "agent.json: "),
        (part("dynamics", integrator={"name": "euler"}), "integrator: expected one of"),
        (part("dynamics", integrator={"name": "rk4", "steps": 2}), "no such settings.*'steps'"),
        (part("dynamics", integrator={"name": "rk4", "substeps": 0}), "substeps: expected a whole"),
        (lambda c: c["dynamics"].pop("integrator"), "expected the key 'integrator'"),
        (part("dynamics", prior=None, residual=None), "expected at least one"),
        (lambda c: c["dynamics"]["residual"].update(outputs=[7]), "outputs: expected some of"),
        (lambda c: c["dynamics"]["residual"].update(activation="eval"), "activation: expected one"),
        (lambda c: c["dynamics"]["residual"].update(hidden_sizes=[0]), "hidden_sizes: expected"),
        (part("actor", kind="twin_q"), "kind: expected 'mlp_actor', got 'twin_q'"),
        (part("actor", hidden_sizes=[10**12]), "hidden_sizes: expected 1 to 32 widths up to 65536"),
        (part("actor", hidden_sizes=[4] * 100), "hidden_sizes: expected"),
        (part("actor", hidden_sizes=["8"]), "hidden_sizes: expected"),
        (part("actor", hidden_sizes=8), "agent.json: "),
        (part("planner", kind="soup"), r"planner\.kind: expected one of .*'cem'.* got 'soup'"),
        (part("planner", kind="mppi"), r"planner\.\w+: unknown key"),
        (part("planner", top_k=17), r"planner\.top_k: expected at most num_candidates = 16"),
        (part("planner", horizon=3), r"planner\.horizon: unknown key"),
        (part("planner", alpha="1"), r"planner\.alpha: expected a number, got '1'"),
        (lambda c: c.update(planner=3), "planner: expected keys and values, got 3"),
        (lambda c: c.update(weights_sha256="0"), "expected the weights that agent.json was"),
    ],
)
def test_bad_descriptions_are_named(saved, change, match):
    edit_json(saved, change)
    assert str(saved) in refused(saved, match)


def test_a_setting_that_came_later_has_its_default(saved):
    edit_json(saved, lambda c: c["planner"].pop("actor_margin"))
    assert load_agent(saved).planner_config == SMALL


def test_huge_sizes_take_no_memory(saved):
    edit_json(saved, part("actor", hidden_sizes=[65_536] * 30))
    refused(saved, r"hidden_sizes: expected ")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda w: w.pop("actor.mlp.0.bias"), r"missing \['actor.mlp.0.bias'\], not expected \[\]"),
        (lambda w: w.update(soup=torch.ones(1)), r"missing \[\], not expected \['soup'\]"),
        (
            lambda w: w.update({"actor.mlp.0.bias": torch.zeros(9)}),
            r"actor.mlp.0.bias: expected torch.float32 of shape \[8\], got .*\[9\]",
        ),
        (
            lambda w: w.update({"actor.mlp.0.bias": torch.zeros(8, dtype=torch.float64)}),
            "actor.mlp.0.bias: expected torch.float32",
        ),
        (lambda w: w["qvalue.layers.1"].fill_(torch.nan), "qvalue.layers.1: expected finite"),
    ],
)
def test_weights_that_do_not_fit(saved, change, match):
    edit_weights(saved, change)
    assert "weights.safetensors" in refused(saved, match)


def test_damaged_weights(saved):
    path = saved / "weights.safetensors"
    data = path.read_bytes()

    class Bomb:
        def __reduce__(self):
            return pytest.fail, ("code in the file was run",)

    hostile = [
        b"",
        data[:-1],
        data[:100],
        data[:4],
        data + b"\0",
        b"\xff" * 8 + data[8:],
        (2**40).to_bytes(8, "little") + data[8:],
        pickle.dumps(Bomb()),
    ]
    for payload in hostile:
        path.write_bytes(payload)
        refused(saved, r"weights\.safetensors: expected about \d+ bytes of safetensors")
    path.write_bytes(data + b"\0" * 200_000)
    refused(saved, "expected at most .* bytes, got 2")
    flipped = bytearray(data)
    flipped[-5] ^= 1
    path.write_bytes(flipped)
    refused(saved, "expected the weights that agent.json was written with")
    path.write_bytes(data)
    load_agent(saved)
