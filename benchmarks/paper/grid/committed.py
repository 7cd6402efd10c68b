"""The code that a grid runs must be that of the commit which its cells record."""

from __future__ import annotations

from pathlib import Path

from phihp_torchrl import origin
from phihp_torchrl.config import ConfigError
from phihp_torchrl.origin import ask_git, commit_text, has_changes, source_commit
from phihp_torchrl.trainers import RunDirectory

CLONE = Path(__file__).parents[3]
_FOLDERS = ("phihp_torchrl", "benchmarks/paper")
_ENDINGS = ("py", "yaml")

source_commit()  # asked while the code is imported, so that cells record the commit of that code


def check_committed() -> None:
    """Refuse code that is not, file by file, that of the commit which a cell would record.

    Raises:
        ConfigError: if the package is imported from elsewhere than this clone, if the clone has
            uncommitted changes or code that git does not know, if ``HEAD`` has moved since the
            code was imported, and if git does not answer.
    """
    package = Path(origin.__file__).resolve().parent
    if package != (ours := CLONE.resolve() / "phihp_torchrl"):
        raise _refusal(f"{ours} as the package that is imported", f"{package}")
    commit, changed = source_commit(), has_changes()
    now = ask_git(CLONE, "rev-parse", "HEAD")
    patterns = [f":(top){folder}/*.{ending}" for folder in _FOLDERS for ending in _ENDINGS]
    unknown = ask_git(CLONE, "ls-files", "--others", "--", *patterns)
    if commit is None or changed is None or now is None or unknown is None:
        raise _refusal("git to say whether the tree has changes", f"no answer in {CLONE}")
    if now != commit:
        raise _refusal(
            f"HEAD at {commit}, whose code this process has imported", f"{now}: start it again"
        )
    if changed:
        raise _refusal("a tree without uncommitted changes", "some; git status shows them")
    if unknown:
        raise _refusal("no code that git does not know", ", ".join(unknown.splitlines()))


def check_sessions(folder: Path) -> None:
    """Refuse a run, or what is kept of it, if other code than this commit's made a part of it.

    Raises:
        ConfigError: for the first such session; it names both commits.
    """
    ours = source_commit()
    for session in RunDirectory(folder).read_metadata().get("sessions", []):
        if (session["commit"], session["dirty"]) != (ours, False):
            raise ConfigError(
                str(folder),
                f"expected a proof by the code of commit {ours} alone, got a session of "
                f"{commit_text(session)}. Go back to that commit, or move the cell and its run "
                "away and say so where the proof is reported.",
            )


def _refusal(expected: str, found: str) -> ConfigError:
    return ConfigError(
        "allow_dirty", f"expected {expected}, or allow_dirty=true for a trial; got {found}."
    )
