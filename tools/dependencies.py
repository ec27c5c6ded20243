"""What dnrpipe depends on: versions that the tests ran with, and licences.

    python -m tools.dependencies --pin       # constraints.txt from what is installed, docs/dependencies.md from both
    python -m tools.dependencies --check     # every dependency of pyproject.toml is pinned, and in the page

``make setup`` installs by constraints.txt; ``make audit`` looks its versions up among known vulnerabilities. Licences
are what the installed packages say of themselves.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

from dnrtrain.atomic import write_text

REPO = Path(__file__).resolve().parents[1]
CONSTRAINTS = REPO / "constraints.txt"
PAGE = REPO / "docs" / "dependencies.md"
OWN = "dnrpipe"
HEAD = """\
# Versions that `make setup` installs and that the tests ran with, on Python 3.11; pyproject.toml says what else may do.
# Made by `python -m tools.dependencies --pin`; `make audit` looks them up among known vulnerabilities.
"""
MARKER = '; python_version == "3.11"'
TEXT = """\
# Dependencies

Versions are those of [`constraints.txt`](../constraints.txt), which `make setup` installs and the tests ran with;
`pyproject.toml` says what else may do. `make audit` looks all of them up among known vulnerabilities (pip-audit; it
needs pypi.org's own address, mirrors do not have that list). Licences are what the packages say of themselves.
`python -m tools.dependencies --pin` makes this page.

bpy is under the GPL: it is not part of dnrpipe and not shipped with it, is imported in one package
(`dnrpipe.blender`) and runs in processes of its own. Who passes on dnrpipe and bpy as one program is bound by the GPL.

| package | version | for | licence |
| --- | --- | --- | --- |
"""


def canonical(name: str) -> str:
    """A name as package indexes compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def direct() -> dict[str, list[str]]:
    """Name of each dependency in pyproject.toml -> the extras that ask for it; "always" for the core."""
    project = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {"always": project["dependencies"], **project["optional-dependencies"]}
    found: dict[str, list[str]] = {}
    for extra, requirements in wanted.items():
        for requirement in requirements:
            match = re.match(r"[\w.-]+", requirement)
            assert match is not None
            found.setdefault(canonical(match[0]), []).append(extra)
    return found


def pinned() -> dict[str, str]:
    """Name -> version of constraints.txt."""
    lines = CONSTRAINTS.read_text(encoding="utf-8").splitlines()
    pairs = (line.split(";")[0].strip().split("==") for line in lines if line and not line.startswith("#"))
    return {canonical(name): version for name, version in pairs}


def pin() -> None:
    """Write constraints.txt and the page from what is installed."""
    installed = {canonical(found.name): found for found in metadata.distributions()}
    for tool in (OWN, "pip", "setuptools"):
        installed.pop(tool, None)
    # A local version (torch's +cpu) is one build of the same release.
    lines = [f"{name}=={installed[name].version.split('+')[0]}{MARKER}\n" for name in sorted(installed)]
    write_text(CONSTRAINTS, HEAD + "".join(lines))
    rows = []
    for name, extras in sorted(direct().items()):
        if name in installed:
            version = installed[name].version.split("+")[0]
            rows.append(f"| {name} | {version} | {', '.join(extras)} | {licence(installed[name])} |\n")
    write_text(PAGE, TEXT + "".join(rows))


def licence(package: metadata.Distribution) -> str:
    """What a package says: an SPDX expression, else classifiers, else the first line of the field, else its file."""
    about = package.metadata
    if expression := about.get("License-Expression"):
        return expression
    kinds = [text.rsplit(" :: ", 1)[1] for text in about.get_all("Classifier") or [] if text.startswith("License :: ")]
    kinds = [kind for kind in kinds if kind not in ("OSI Approved", "DFSG approved")]
    text = (about.get("License") or "").strip().splitlines()
    files = [file.name for file in package.files or [] if "licen" in file.name.lower()]
    return ", ".join(kinds) or (text[0] if text else f"see its {files[0]}" if files else "not said")


def problems() -> list[str]:
    """What pyproject.toml, constraints.txt and the page do not agree on."""
    versions = pinned()
    page = PAGE.read_text(encoding="utf-8")
    found = []
    for name in direct():
        if name not in versions:
            found.append(f"{name}: not in {CONSTRAINTS.name}")
        elif f"| {name} | {versions[name]} |" not in page:
            found.append(f"{name} {versions[name]}: not in {PAGE.name}")
    return found


def main() -> int:
    """Exit code 1 where the check finds something."""
    parser = argparse.ArgumentParser(prog="python -m tools.dependencies", description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--pin", action="store_true")
    what.add_argument("--check", action="store_true")
    if parser.parse_args().pin:
        pin()
        return 0
    found = problems()
    for problem in found:
        print(f"{problem}; run `python -m tools.dependencies --pin`", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
