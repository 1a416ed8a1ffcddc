"""What a recording for the viewer holds."""

import math
from pathlib import Path

from rig.view.recording import TIMELINE

Rows = dict[str, list[tuple[float, object]]]
_SHOWN = {"StateChange:state", "TextLog:text", "Scalars:scalars", "TextDocument:text"}


def read_recording(path: Path) -> Rows:
    """Entity -> time, s (NaN: always), and value of each of its rows."""
    from rerun.chunk import RrdReader

    entities: Rows = {}
    for chunk in RrdReader(path).stream():
        table = chunk.to_record_batch()
        for column in _SHOWN & {*table.schema.names}:
            values = [value[0] for value in table.column(column).to_pylist()]
            times = [math.nan] * len(values)
            if TIMELINE in table.schema.names:
                times = (table.column(TIMELINE).cast("int64").to_numpy() / 1e9).tolist()
            entities.setdefault(chunk.entity_path, []).extend(zip(times, values, strict=True))
    return {entity: sorted(rows, key=lambda row: row[0]) for entity, rows in entities.items()}


def read_names(path: Path) -> dict[str, str]:
    """Entity of each line -> the name that its legend shows."""
    from rerun.chunk import RrdReader

    names = {}
    for chunk in RrdReader(path).stream():
        table = chunk.to_record_batch()
        if "SeriesLines:names" in table.schema.names:
            names[chunk.entity_path] = table.column("SeriesLines:names").to_pylist()[0][0]
    return names
