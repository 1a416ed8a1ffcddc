"""The reference page of the public Python names, from their docstrings."""
from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from markdown_text import MADE, escape_markup

PUBLIC = ("fdi", "plant", "plant.effects", "rig.sequences", "rig.recorder", "rig.device")  # packages with __all__
MORE_PUBLIC = {  # what the functions of these packages return, and the bench of the pytest plugin
    "fdi.analysis": ("Result", "ComparisonResult", "ExplanationResult", "ModelResult", "IdentificationResult",
                     "DiagnosisResult", "Plot"),
    "rig.testing.bench": ("Bench", "BenchRun", "CheckFailedError")}


def write_python_page() -> list[str]:
    """The page of the public functions and classes."""
    lines = ["# Python", "", MADE, "", "[The Python interface](../docs/python.md) has examples."]
    names = {**{module: tuple(import_module(module).__all__) for module in PUBLIC}, **MORE_PUBLIC}
    for module_name in sorted(names):
        module = import_module(module_name)
        lines += ["", f"## {module_name}", "", format_docstring(inspect.getdoc(module) or ""), ""]
        for name in names[module_name]:
            lines += describe_object(name, getattr(module, name), module_name)
    return lines


def describe_object(name: str, value: object, module: str) -> list[str]:
    """A function, a class with its public members, or a value, as directives of Sphinx."""
    if inspect.isclass(value):
        members: list[str] = []
        for member, inner in vars(value).items():
            if not member.startswith("_") and is_documented(inner):
                members += describe_member(member, inner)
        try:
            signature = format_signature(value)
        except ValueError:
            signature = ""
        return make_directive("class", f"{name}{signature}", module, value, members)
    if inspect.isfunction(value):
        return make_directive("function", f"{name}{format_signature(value)}", module, value)
    return make_directive("data", name, module, type(value))


def is_documented(value: object) -> bool:
    """Whether a member of a class is a method or a property with a docstring."""
    inner = getattr(value, "__func__", value)
    return isinstance(inner, property) or inspect.isfunction(inner) or hasattr(inner, "attrname")


def describe_member(name: str, value: Any) -> list[str]:
    """A method or a property."""
    inner = getattr(value, "__func__", value)
    if inspect.isfunction(inner):
        kind = type(value).__name__ if isinstance(value, staticmethod | classmethod) else "method"
        return make_directive(kind, f"{name}{format_signature(inner, drop_first=kind != 'staticmethod')}", "", inner)
    return make_directive("property", name, "", value)


def make_directive(kind: str, signature: str, module: str, value: Any, inner: Sequence[str] = ()) -> list[str]:
    """A description of a Python object: Sphinx makes an anchor and an entry of the search of it."""
    fence = "````" if inner else "```"
    options = [f":module: {module}"] if module else []
    text = format_docstring(inspect.getdoc(value) or "")
    return ["", f"{fence}{{py:{kind}}} {signature}", *options, "", *text.splitlines(), *inner, fence, ""]


def format_signature(value: Any, drop_first: bool = False) -> str:
    """The signature of a function, with types as they are written."""
    signature = inspect.signature(value)
    if drop_first:
        signature = signature.replace(parameters=list(signature.parameters.values())[1:])
    text = re.sub(r"(: |-> )'([^']*)'", r"\1\2", str(signature))
    return re.sub(r"<[^>]*>", "...", text)  # a default that is no literal


def format_docstring(text: str) -> str:
    """A docstring as Markdown: its sections become lists."""
    out: list[str] = []
    section = ""
    for line in text.splitlines():
        if re.fullmatch(r"(Args|Raises|Returns|Yields):", line):
            section = line
            out += ["", f"**{line}**", ""]
        elif section and line.startswith("    "):
            entry = re.fullmatch(r"    (\*{0,2}\w+): (.*)", line)
            if entry:
                out.append(f"- `{entry[1]}`: {escape_markup(entry[2])}")
            else:
                out.append(f"  {escape_markup(line.strip())}")
        else:
            section = section if line else ""
            out.append(line if line.startswith("    ") else escape_markup(line))
    return "\n".join(out).strip()
