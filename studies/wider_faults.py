"""How often `rig fdi --faults` names the right fault of a list, and no other: each fault at its two limits.

    python -m studies.wider_faults FOLDER --seeds 2

Units have the scatter of the tolerances and are simulated as in `rig campaign`; the folder is one of a campaign, so an
interrupted study resumes. A unit with one fault is counted as: named alone, named in a group that the recording does
not tell apart, or missed; and for every fault that it does not have, whether that was reported.
"""

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi.diagnosis.faults import Fault, Level, choose_faults, classify_size
from fdi.estimation import Share, measure_share
from fdi.foreign_code import load_plant_of_model
from plant import Model, load_model
from rig.campaign.batch import Row, Workers
from rig.campaign.judge import HEALTHY, OK, WORKS, Matrix, build_matrix, run_campaign
from rig.campaign.summary import describe_progress

BEYOND = tuple(level.word for level in Level if level > Level.ACCEPTABLE)


def list_cases(model: Model, faults: Sequence[Fault], seeds: int, healthy: int, first: int = 0) -> Matrix:
    """A campaign of healthy units and of units with each fault at MidBand and at MaxBand."""
    cases: list[dict[str, Any]] = [{"seeds": healthy}]
    for fault in faults:
        limits = [fault.place_size(departure) for departure in fault.limits[1:]]
        cases.append({fault.name: limits, "seeds": seeds})
    return build_matrix({"first": first, "case": cases}, model, WORKS["fdi"], "studies.wider_faults", faults)


def count_answers(rows: Iterable[Row], faults: Sequence[Fault]) -> dict[str, dict[str, Share]]:
    """Shares by fault, and over all of them: named, grouped, right level, another fault reported, size in interval."""
    answers: dict[str, dict[str, list[bool]]] = {}
    for row in rows:
        name = row["label"].partition("=")[0]
        for word, is_so in _judge_row(row, name, faults):
            for group in (name, "all") if name != HEALTHY else (name,):
                answers.setdefault(group, {}).setdefault(word, []).append(is_so)
    return {name: {word: measure_share(sum(hits), len(hits)) for word, hits in words.items()}
            for name, words in answers.items()}


def _judge_row(row: Row, name: str, faults: Sequence[Fault]) -> Iterator[tuple[str, bool]]:
    levels = {fault.name: row.get(f"level_{fault.name}") for fault in faults}
    groups: list[list[str]] = row.get("groups") or []
    is_grouped = any(name in group for group in groups)
    for fault in faults:
        size = float(row[f"true_{fault.key}"])
        if fault.name == name:
            yield "named alone", levels[name] in BEYOND and row.get("ruling") == name
            yield "named in a group", is_grouped
            yield "right level, or group", is_grouped or levels[name] == classify_size(fault, size).word
        if row["status"] == OK:
            yield "size in interval", bool(row[f"{fault.key}_low"] <= size <= row[f"{fault.key}_high"])
    others = [fault for fault in faults if fault.name != name]
    yield "another reported", any(levels[f.name] in BEYOND for f in others) or any(name not in g for g in groups)
    yield "not explained", row.get("verdict") == "SOMETHING_ELSE" or row["status"] != OK


def format_table(shares: Mapping[str, Mapping[str, Share]]) -> str:
    """The shares in Markdown, with 95 % intervals in the line of all."""
    words = list(dict.fromkeys(word for row in shares.values() for word in row))
    lines = [f"| fault | {' | '.join(words)} |", "|---" * (len(words) + 1) + "|"]
    for name, row in shares.items():
        cells = [f"{row[w].good}/{row[w].of}" + (
            f" ({100 * row[w].low:.0f} .. {100 * row[w].high:.0f} %)" if name in ("all", HEALTHY) else "")
            if w in row else "" for w in words]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that the folder lacks, print the table; exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m studies.wider_faults", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the results go, or the folder of an interrupted study")
    parser.add_argument("--model", default="eha", help="the healthy plant: a shipped one, or a plant file")
    parser.add_argument("--faults", help="a fault file, or a shipped list (default: the plant's own; of eha wider)")
    parser.add_argument("--seeds", type=int, default=2, help="units of each size (default 2)")
    parser.add_argument("--healthy", type=int, default=10, help="units without a fault (default 10)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first unit (default 0)")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes")
    parser.add_argument("--most", type=int, help="stop after so many cases")
    args = parser.parse_args(arguments)
    load_plant_of_model(args.model, is_trusted=False)
    model = load_model(args.model)
    faults = choose_faults(args.faults or ("wider" if model.plant == "eha" else None), model.kind)
    matrix = list_cases(model, faults, args.seeds, args.healthy, args.first)
    rows = run_campaign(matrix, args.folder, Workers(args.jobs), count=args.most,
                        report_progress=lambda p: print(describe_progress(p), file=sys.stderr, flush=True))
    order = [HEALTHY, *(fault.name for fault in faults), "all"]
    shares = count_answers(rows, faults)
    print(format_table({name: shares[name] for name in order if name in shares}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
