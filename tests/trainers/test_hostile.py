"""Folders of runs from strangers: none of 23 kinds executes, reads or writes what it names."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import save
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError

from phihp_torchrl import load_config
from phihp_torchrl.config import STATE_VARIABLE, ConfigError, compose_yaml, digest_of, sealed
from phihp_torchrl.trainers import RunResult, read_request, read_run_config, run
from phihp_torchrl.trainers.files import check_contained
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.trust import CONTROLLER, check_trusted, named_code, sign

from .run_parts import Crash
from .tally import Tally, TallyConfig, tally_config

pytestmark = pytest.mark.usefixtures("tally")

OUTSIDE = "what is not the run's"


class Payload:
    """Unpickled, it leaves its mark."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.mark),)


class Folder:
    """A run of a stranger's that goes on, and where its payload would leave a mark."""

    def __init__(self, place: Path) -> None:
        self.run, self.mark, self.outside = place / "run", place / "mark", place / "outside"
        self.code = f"import os\nos.mkdir({str(self.mark)!r})\n"
        self.outside.mkdir()
        (self.outside / "unit-000000000009").mkdir()
        (self.outside / "metrics.csv").write_text(OUTSIDE)

    @property
    def newest(self) -> Path:
        return sorted((self.run / "checkpoints").glob("unit-*"))[-1]

    def file(self, name: str) -> Path:
        return next(self.newest.rglob(name))

    def set(self, **settings: Any) -> None:
        """Settings that all files of the folder agree on, signed by the stranger."""
        directory = RunDirectory(self.run)
        changed = {**directory.read_config(), **settings}
        directory.write_config(changed)
        metadata = {**directory.read_metadata(), "config": changed, "code": sign(changed)}
        directory.write_metadata(metadata)

    def manifest(self, change: Callable[[dict[str, Any]], None]) -> None:
        content = json.loads((self.newest / "manifest.json").read_text())
        change(content)
        (self.newest / "manifest.json").write_text(json.dumps(content))

    def payload(self, tree: Any, tensors: bytes) -> None:
        """A checkpoint whose digests all fit."""
        self.written(json.dumps({"tensors": digest_of(tensors), "tree": tree}), tensors)

    def written(self, text: str, tensors: bytes) -> None:
        """The same, with a tree that is text already."""
        self.file("tree.json").write_text(text)
        self.file("tensors.safetensors").write_bytes(tensors)
        self.manifest(lambda content: content["metadata"].update(sha256=digest_of(text)))

    def write(self, name: str, text: str) -> None:
        (self.run / name).write_text(text)


def plugin_file(folder: Folder) -> None:
    (folder.run / "evil.py").write_text(folder.code)
    folder.set(plugins=[str(folder.run / "evil.py")])


def plugin_module(folder: Folder) -> None:
    Path("evil_plugin.py").write_text(folder.code)  # the working directory, where it is looked for
    folder.set(plugins=["evil_plugin"])


def function_of_world(folder: Folder) -> None:
    folder.set(world={"kind": "torchrl", "make": "os:mkdir", "options": {"path": str(folder.mark)}})


def module_of_gymnasium(folder: Folder) -> None:
    Path("evil_world.py").write_text(folder.code)
    folder.set(world={"kind": "gymnasium", "id": "evil_world:Evil-v0", "options": {}})


def arguments_of_gymnasium(folder: Folder) -> None:
    options = {"xml_file": "/etc/passwd"}
    folder.set(world={"kind": "gymnasium", "id": "Pendulum-v1", "options": options})


def controller_of_exploration(folder: Folder) -> None:
    Path("evil_controller.py").write_text(folder.code)
    folder.set(model={"collect": {"exploration": {"controller": "evil_controller:act"}}})


def variable(folder: Folder) -> None:
    text = (folder.run / "config.yaml").read_text()
    folder.write("config.yaml", text.replace("preset: default", "preset: ${oc.env:HOSTILE_SECRET}"))


def resolver(folder: Folder) -> None:
    text = (folder.run / "config.yaml").read_text()
    folder.write("config.yaml", text.replace("preset: default", f"preset: ${{mark:{folder.mark}}}"))


def tag(folder: Folder) -> None:
    text = (folder.run / "config.yaml").read_text()
    evil = f"!!python/object/apply:os.mkdir [{folder.mark}]"
    folder.write("config.yaml", text.replace("preset: default", f"preset: {evil}"))


def references(folder: Folder) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30)]
    folder.write("config.yaml", "\n".join(lines))


def nesting(folder: Folder) -> None:
    folder.write("config.yaml", "a: " + "[" * 5000 + "]" * 5000)


def size(folder: Folder) -> None:
    with (folder.run / "config.yaml").open("r+b") as file:
        file.truncate(50_000_000_000)  # a sparse file, which takes no disk


def adapter_of_torch(folder: Folder) -> None:
    """The checkpoint says that it is one that torch unpickles."""
    (folder.file("tree.json").parent / "state.pt").write_bytes(pickle.dumps(Payload(folder.mark)))
    folder.manifest(
        lambda content: content["components"]["state"].update(
            adapter="torchrl.state_dict", adapter_version=1, files=["state.pt"]
        )
    )


def pickled_tensors(folder: Folder) -> None:
    folder.payload({"dict": []}, pickle.dumps(Payload(folder.mark)))


def tree_of_nonsense(folder: Folder) -> None:
    code = f"__import__('os').mkdir({str(folder.mark)!r})"
    folder.payload({"dict": [["trainer", {"eval": code}], ["phase", "tally-two"]]}, save({}))


def nested_tree(folder: Folder) -> None:
    tree = '{"list": [' * 50_000 + "1" + "]}" * 50_000
    tensors = save({})
    folder.written(f'{{"tensors": "{digest_of(tensors)}", "tree": {tree}}}', tensors)


def random_state_of_nonsense(folder: Folder) -> None:
    tree = [["phase", "tally-two"], ["trainer", {"dict": []}], ["random", {"dict": []}]]
    folder.payload({"dict": tree}, save({"0": torch.zeros(1)}))


def pickled_tensordict(folder: Folder) -> None:
    """TensorDict's own folders are unpickled where they say so."""
    TensorDict(weight=torch.zeros(2)).memmap(folder.file("tree.json").parent / "tensors")
    place = folder.file("tree.json").parent / "tensors"
    (place / "other.pickle").write_bytes(pickle.dumps(Payload(folder.mark)))
    folder.file("tensors.safetensors").unlink()


def path_outside(folder: Folder) -> None:
    folder.manifest(lambda c: c["components"]["state"].update(path="../../../outside"))


def giant_header(folder: Folder) -> None:
    folder.payload({"dict": []}, (2**62).to_bytes(8, "little") + b"{}" * 100)


def linked_checkpoints(folder: Folder) -> None:
    """Old checkpoints are removed, wherever they are."""
    (folder.run / "checkpoints").rename(folder.run / "moved")
    (folder.run / "checkpoints").symlink_to(folder.outside)


def linked_table(folder: Folder) -> None:
    (folder.run / "metrics.csv").unlink()
    (folder.run / "metrics.csv").symlink_to(folder.outside / "metrics.csv")


def pipe(folder: Folder) -> None:
    """Whoever reads it waits for ever."""
    (folder.run / "metadata.json").unlink()
    os.mkfifo(folder.run / "metadata.json")


KINDS = (
    plugin_file, plugin_module, function_of_world, module_of_gymnasium, arguments_of_gymnasium,
    controller_of_exploration, variable, resolver, tag, references, nesting, size,
    adapter_of_torch, pickled_tensors, tree_of_nonsense, nested_tree, random_state_of_nonsense,
    pickled_tensordict, path_outside, giant_header, linked_checkpoints, linked_table, pipe,
)  # fmt: skip


@pytest.fixture(scope="module")
def composed() -> Any:
    return compose_yaml(["task=pendulum"])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Folder:
    """A whole run of a stranger's, who has a key too, that goes on in its second phase."""
    made = Folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOSTILE_SECRET", "the user's")
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "stranger"))
    OmegaConf.register_new_resolver("mark", lambda path: os.mkdir(path), replace=True)
    with monkeypatch.context() as patch:
        patch.setattr(Tally, "fail_at", 2)
        with pytest.raises(Crash):
            run(tally_config(TallyConfig(units=1)), made.run)
    return made


def resume(composed: Any, place: Path, *words: str) -> RunResult:
    """What ``phihp train resume=...`` does."""
    request = read_request(composed, [f"resume={place}", *words])
    return run(request.config, request.path, resume=request.resume)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_nothing_of_a_strangers_folder_is_executed(
    kind: Callable[[Folder], None],
    folder: Folder,
    composed: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind(folder)
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "user"))
    refused = []
    try:
        resume(composed, folder.run)
    except (ConfigError, CheckpointError) as error:
        refused.append(str(error))
    assert not folder.mark.exists()
    assert "the user's" not in "".join(refused)
    assert (folder.outside / "metrics.csv").read_text() == OUTSIDE
    assert (folder.outside / "unit-000000000009").is_dir()
    if "checkpoint" not in str(refused) and kind not in DAMAGED:
        assert refused, "it went on as if nothing was wrong"


# Of these the checkpoint before is used, which is whole.
DAMAGED = (
    adapter_of_torch, pickled_tensors, pickled_tensordict, path_outside, giant_header,
    tree_of_nonsense, nested_tree, random_state_of_nonsense,
)  # fmt: skip


LOG = "core-debug-20260131_120000.log"  # as wandb's client calls the log of its service


@pytest.mark.parametrize(
    ("link", "target", "refused"),
    [
        ("wandb/offline-run-1/logs/debug-core.log", LOG, False),
        ("wandb/offline-run-1/logs/debug-core.log", ".bashrc", True),
        ("wandb/offline-run-1/logs/debug.log", LOG, True),
        ("wandb/offline-run-1/files/logs/debug-core.log", LOG, True),
        ("wandb/debug-core.log", LOG, True),
        ("checkpoints/wandb/offline-run-1/logs/debug-core.log", LOG, True),
        ("wandb/offline-run-1/logs", LOG, True),
        ("wandb", LOG, True),
    ],
)
def test_the_log_of_wandbs_service_alone_may_lie_elsewhere(
    tmp_path: Path, link: str, target: str, refused: bool
) -> None:
    (tmp_path / target).write_text("")
    path = tmp_path / "run" / link
    path.parent.mkdir(parents=True)
    path.symlink_to(tmp_path / target)
    with pytest.raises(ConfigError, match="a link out") if refused else nullcontext():
        check_contained(tmp_path / "run")


def test_the_flag_is_named_and_does_what_it_says(
    folder: Folder, composed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a mark would never be left, whatever the tests above say."""
    plugin_file(folder)
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "user"))
    with pytest.raises(ConfigError, match=r"trust: .*evil\.py.*say trust=true"):
        resume(composed, folder.run)
    assert not folder.mark.exists()
    with suppress(CheckpointError):  # made with the settings without the plugin
        resume(composed, folder.run, "trust=true")
    assert folder.mark.exists()
    with pytest.raises(ConfigError, match="trust: expected true or false"):
        resume(composed, folder.run, "trust=yes_please")


def test_the_code_of_ones_own_run_needs_no_flag_until_it_changes(
    composed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "user"))
    plugin = tmp_path / "my_plugin.py"
    plugin.write_text("x = 1\n")
    run(tally_config(plugins=(str(plugin),)), tmp_path / "run")
    assert resume(composed, tmp_path / "run").finished
    plugin.write_text("x = 2\n")
    with pytest.raises(ConfigError, match=r"my_plugin\.py was changed since the run was started"):
        resume(composed, tmp_path / "run")
    assert resume(composed, tmp_path / "run", f"plugins=['{plugin}']").finished
    assert resume(composed, tmp_path / "run", "trust=true").finished
    plugin.write_text("x = 1\n")
    assert resume(composed, tmp_path / "run").finished
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "another"))
    with pytest.raises(ConfigError, match="not started like this by this user"):
        resume(composed, tmp_path / "run")


def test_phases_of_a_stranger_bring_no_code(
    folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tally_config(TallyConfig(units=1)), folder.run, resume=True)
    plugin_file(folder)
    later = tally_config(phases=("tally-two",), start_from=str(folder.run))
    with pytest.raises(ConfigError, match=r"plugins: .*nothing that a folder names is imported"):
        run(later, tmp_path / "later")
    assert not folder.mark.exists()


def test_a_model_of_a_stranger_brings_no_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("evil_controller.py").write_text(f"import os\nos.mkdir({str(tmp_path / 'mark')!r})\n")
    word = f"{CONTROLLER}=evil_controller:act"
    theirs = load_config("pendulum", overrides=[word])
    (tmp_path / "run").mkdir()
    RunDirectory(tmp_path / "run").write_config(theirs)
    later = ["phases=[policy]", f"from={tmp_path / 'run'}"]
    with pytest.raises(ConfigError, match=f"^{CONTROLLER}: .*nothing that a folder names"):
        run(read_run_config(load_config("pendulum", overrides=later)), tmp_path / "later")
    assert not (tmp_path / "mark").exists()
    with pytest.raises(CheckpointError):  # for there is no model, but the controller is asked for
        run(read_run_config(load_config("pendulum", overrides=[*later, word])), tmp_path / "later")


def test_which_function_of_a_controller_is_called_is_signed() -> None:
    exploration = {"controller": "math:cos"}
    settings = {"model": {"collect": {"exploration": exploration}}}
    record = sign(settings)
    check_trusted(settings, record)
    exploration["controller"] = "math:sin"
    with pytest.raises(ConfigError, match="not started like this"):
        check_trusted(settings, record)
    check_trusted(settings, record, given=[CONTROLLER])


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"model": "none", "world": "simulated"}, {}),
        ({"world": "simulated"}, {}),
        ({"world": None, "plugins": None}, {}),
        ({"world": {"kind": "recorded", "files": "logs/*.csv"}}, {}),
        ({"world": {"kind": "gymnasium", "id": "Pendulum-v1", "options": {}}}, {}),
        ({"plugins": "one.py"}, {"plugins[0]": "one.py"}),
        ({"world": {"id": "mine:Rig-v0"}}, {"world.id": "mine"}),
    ],
)
def test_what_counts_as_code(settings: dict[str, Any], named: dict[str, str]) -> None:
    assert named_code(settings) == named
    assert (sign(settings) is None) == (named == {})
    with suppress(ConfigError):
        check_trusted(settings, None)
        assert named == {}
    assert json.loads(sealed(settings))


def test_without_a_place_for_the_key_the_flag_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "file" / "inside"))
    settings = {"plugins": ["mine.py"]}
    record = sign(settings)
    assert "say trust=true" in caplog.text
    with pytest.raises(ConfigError, match="trust=true"):
        check_trusted(settings, record)
    check_trusted(settings, record, trust=True)
    check_trusted(settings, record, given=["plugins"])
