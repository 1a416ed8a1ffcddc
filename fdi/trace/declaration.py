"""The declaration of a plant's signals in a log, so that the log can be read without the plant that was recorded."""

import json
from collections.abc import Mapping
from typing import Any

from plant import InputError, Signal, Signals, escape_control_characters

DECLARATION = "signals"  # metadata record of a log, with one entry of the same name: a list of signals as JSON
USUAL = Signal("", "", "", "")._asdict()  # every field of a signal, as it usually is


def write_declaration(signals: Signals) -> dict[str, str]:
    """The signals as metadata of a log; fields that are as usual are left out."""
    return {DECLARATION: json.dumps([{key: value for key, value in s._asdict().items() if value != USUAL[key]}
                                     for s in signals[1:]])}


def read_declaration(where: object, metadata: Mapping[str, str]) -> Signals | None:
    """The signals that the metadata of a log declares; None if it declares none.

    Raises:
        InputError: metadata that are no declaration.
    """
    if DECLARATION not in metadata:
        return None
    try:
        signals = []
        for table in json.loads(metadata[DECLARATION]):
            values: dict[str, Any] = {key: table[key] for key in USUAL if key in table}
            for key, value in values.items():
                if type(value) is not type(USUAL[key]) and (type(value), type(USUAL[key])) != (int, float):
                    raise TypeError(f"{key} is {value!r:.40}")
                values[key] = escape_control_characters(value) if isinstance(value, str) else value
            signals.append(Signal(**values))
        return Signals(*signals)
    except (TypeError, ValueError, RecursionError, InputError) as error:
        raise InputError(where, f"metadata {DECLARATION}", f"the declaration of signals as JSON ({error})") from error
