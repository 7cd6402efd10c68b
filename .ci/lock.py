"""Write requirements.lock and sbom.json: every package of an environment, with its digest.

    make lock

Asks pip which archives it would install here for the package, its extra ``dev`` and the tools that
build it, at the versions of constraints.txt, and installs none of them. The lock is therefore for
this platform and this version of Python, which its first lines name; ``make LOCKED=1`` installs
from it, and pip refuses an archive with another digest. The bill of materials (CycloneDX) names the
same archives.
"""

from __future__ import annotations

import json
import platform
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

TOP = Path(__file__).parents[1]
LOCK, SBOM = TOP / "requirements.lock", TOP / "sbom.json"
OURS = "phihp_torchrl"


def main() -> None:
    """Ask pip, and write the two files; with ``--fits`` only see whether the lock is for here."""
    if "--fits" in sys.argv[1:]:
        told = LOCK.read_text(encoding="utf-8").splitlines()[0]
        if platform_text() not in told:
            sys.exit(f"error: {LOCK.name} fits not here ({told[2:]}); make without LOCKED")
        return
    archives = sorted((archive(item) for item in asked()), key=lambda each: each["name"])
    LOCK.write_text(lock(archives), encoding="utf-8")
    SBOM.write_text(json.dumps(bill(archives), indent=2) + "\n", encoding="utf-8")
    print(f"wrote {LOCK.name} and {SBOM.name}: {len(archives)} packages")


def asked() -> list[dict[str, Any]]:
    """What pip would install, as its report says."""
    with tempfile.TemporaryDirectory() as place:
        report = Path(place) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed"]
        command += ["--quiet", "--report", str(report), "-c", str(TOP / "constraints.txt")]
        subprocess.run([*command, *requirements()], check=True)
        return list(json.loads(report.read_text(encoding="utf-8"))["install"])


def requirements() -> list[str]:
    """What the package needs, with the extra ``dev`` and what builds an editable install."""
    content = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))
    project = content["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *content["build-system"]["requires"], "editables"]
    for line in extras["dev"]:
        found = re.fullmatch(rf"{OURS}\[(.+)\]", line)
        inner = [] if found is None else found[1].split(",")
        wanted += [each for name in inner for each in extras[name]] if inner else [line]
    return wanted


def archive(item: dict[str, Any]) -> dict[str, str]:
    """Name, version, licence and digest of an archive in pip's report."""
    metadata = item["metadata"]
    return {
        "name": re.sub(r"[-_.]+", "-", metadata["name"]).lower(),
        "version": metadata["version"],
        "license": metadata.get("license_expression") or "",
        "sha256": item["download_info"]["archive_info"]["hashes"]["sha256"],
    }


def platform_text() -> str:
    """The platform that the archives are for."""
    version = ".".join(platform.python_version_tuple()[:2])
    return f"{platform.system()} {platform.machine()}, {platform.python_implementation()} {version}"


def lock(archives: list[dict[str, str]]) -> str:
    """The text of the lock."""
    lines = [
        f"# For {platform_text()}; written by `make lock`, installed by `make LOCKED=1`.",
        "# pip refuses an archive with another digest (--require-hashes).",
        "--require-hashes",
    ]
    for each in archives:
        lines.append(f"{each['name']}=={each['version']} \\")
        lines.append(f"    --hash=sha256:{each['sha256']}")
    return "\n".join(lines) + "\n"


def bill(archives: list[dict[str, str]]) -> dict[str, Any]:
    """The bill of materials, as CycloneDX 1.6 writes it."""
    project = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    components = []
    for each in archives:
        url = f"pkg:pypi/{each['name']}@{each['version'].replace('+', '%2B')}"
        told: dict[str, Any] = {
            "type": "library",
            "bom-ref": url,
            "name": each["name"],
            "version": each["version"],
            "purl": url,
            "hashes": [{"alg": "SHA-256", "content": each["sha256"]}],
        }
        if each["license"]:
            told["licenses"] = [{"expression": each["license"]}]
        components.append(told)
    ours = {"type": "library", "name": project["name"], "version": project["version"]}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {**ours, "bom-ref": OURS, "licenses": [{"expression": "MIT"}]},
            "properties": [{"name": f"{OURS}:platform", "value": platform_text()}],
        },
        "components": components,
    }


if __name__ == "__main__":
    main()
