"""The lock, the bill of materials and the tested versions say the same."""

from __future__ import annotations

import json
import re
from pathlib import Path

TOP = Path(__file__).parents[1]


def test_every_locked_archive_has_a_digest_a_tested_version_and_a_place_in_the_bill() -> None:
    text = (TOP / "requirements.lock").read_text(encoding="utf-8")
    entry = re.compile(r"^([a-z0-9-]+)==(\S+) \\\n    --hash=sha256:([0-9a-f]{64})$", re.M)
    locked = {name: (version, digest) for name, version, digest in entry.findall(text)}
    assert "--require-hashes" in text.splitlines()
    assert len(locked) == text.count("==") > 100
    pinned = dict(re.findall(r"^([^=#\s]+)==(\S+)$", (TOP / "constraints.txt").read_text(), re.M))
    for name, version in pinned.items():
        name = re.sub(r"[-_.]+", "-", name).lower()
        if name in locked:
            assert locked[name][0].split("+")[0] == version, name
    bill = json.loads((TOP / "sbom.json").read_text(encoding="utf-8"))
    assert {c["name"]: (c["version"], c["hashes"][0]["content"]) for c in bill["components"]} == (
        locked
    )


def test_what_the_package_needs_is_locked() -> None:
    project = (TOP / "pyproject.toml").read_text(encoding="utf-8")
    needed = re.search(r"^dependencies = \[(.*?)^\]", project, re.M | re.S)
    assert needed is not None
    names = re.findall(r'"([A-Za-z0-9_-]+)[>=<]', needed[1])
    lock = (TOP / "requirements.lock").read_text(encoding="utf-8")
    assert [name for name in names if f"\n{name.replace('_', '-')}==" not in lock] == []
