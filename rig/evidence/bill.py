"""Software bill of materials: this program and the packages that it can load, as CycloneDX 1.5 in JSON."""
from __future__ import annotations

import platform
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Any

ROOT = "eha-rig"


def build_bill(created: str) -> dict[str, Any]:
    """The bill of this Python environment: the program, what it requires, and those of its extras that are installed.

    `created`: time in UTC, ISO 8601.
    """
    found: dict[str, Distribution] = {}
    needs: dict[str, list[str]] = {}
    waiting = [ROOT]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:  # of an extra that is not installed, or for another system
            continue
        needs[name] = sorted({_normalise(text) for text in found[name].requires or ()
                              if name == ROOT or "extra ==" not in text})
        waiting += needs[name]
    components = {name: _describe(name, each) for name, each in sorted(found.items())}
    own = {**components.pop(ROOT, {"name": ROOT, "bom-ref": ROOT}), "type": "application"}
    python = {"type": "platform", "name": platform.python_implementation(), "version": platform.python_version(),
              "bom-ref": "python"}
    return {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1,
            "metadata": {"timestamp": created, "component": own}, "components": [python, *components.values()],
            "dependencies": [{"ref": found_ref["bom-ref"],
                              "dependsOn": [components[need]["bom-ref"] for need in needs[name] if need in components]}
                             for name, found_ref in {ROOT: own, **components}.items() if name in needs]}


def _normalise(requirement: str) -> str:
    """The normal form of a package's name (PEP 503): "Python_CAN>=4" is python-can."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement, maxsplit=1)[0]).lower()


def _describe(name: str, package: Distribution) -> dict[str, Any]:
    purl = f"pkg:pypi/{name}@{package.version}"
    component = {"type": "library", "name": name, "version": package.version, "bom-ref": purl, "purl": purl}
    said = package.metadata.json  # its license as an expression, or in words that may be all of its text
    if "license_expression" in said:
        return {**component, "licenses": [{"expression": said["license_expression"]}]}
    named = str(said.get("license", "")).splitlines()
    return {**component, "licenses": [{"license": {"name": named[0]}}]} if len(named) == 1 else component
