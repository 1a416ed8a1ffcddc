"""The model file of an identification: values with intervals, and where they come from."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fdi.discovery.model_file import Provenance, format_model_file
from fdi.estimation.fit import Value
from fdi.identification.identify import Identification
from fdi.output import replace_text
from fdi.sources import name_software


def write_identified_model(found: Identification, path: str | Path, command: str = "", date: str = "") -> Path | None:
    """Write the model file; return where the file that was there before is now, None if there was none.

    Args:
        found: the identification.
        path: the file.
        command: what the user typed.
        date: of today, as text.

    Raises:
        InputError: a file that cannot be written.
    """
    return replace_text(path, format_identified_model(found, command, date))


def format_identified_model(found: Identification, command: str = "", date: str = "") -> str:
    """The text of the model file."""
    intervals = {e.name: Value(e.value, e.low, e.high, e.unit) for e in found.estimates if e.is_identifiable}
    errors = found.errors
    origin: dict[str, str | list[str]] = {
        "verdict": found.verdict, "date": date,
        "runs": [e.source.file for e in errors if not e.is_held_out],
        "runs_sha256": [e.source.sha256 for e in errors if not e.is_held_out],
        "holdouts": [e.source.file for e in errors if e.is_held_out],
        "holdouts_sha256": [e.source.sha256 for e in errors if e.is_held_out],
        "not_identifiable": [e.name for e in found.estimates if not e.is_identifiable]}
    known = Provenance(name_software(), (command,) if command else (), floor=found.floor, signals=tuple(found.floor),
                       identification=origin)
    text = format_model_file(found.model, intervals, known)
    return _mark_unseen(text, {e.name: f"{e.low:.3g} .. {e.high:.3g}" for e in found.estimates
                               if not e.is_identifiable})


def _mark_unseen(text: str, unseen: Mapping[str, str]) -> str:
    """The text with a remark beside each parameter that the runs do not show."""
    group, lines = "", []
    for line in text.splitlines():
        if line.startswith("["):
            group = line.strip("[]").removeprefix("design.")
        name = f"{group}.{line.partition(' = ')[0]}"
        if name in unseen:
            line += f"{',' if '#' in line else '  #'} not identifiable from the runs, {unseen[name]}"
        lines.append(line)
    return "\n".join(lines) + "\n"
