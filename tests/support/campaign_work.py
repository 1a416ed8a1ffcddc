"""Judgements for the tests of rig campaign: quick, or held up where the environment says."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from fdi.trace.trace import Trace
from plant import Model


def count_rows(trace: Trace, model: Model) -> dict[str, Any]:
    """Next to nothing, of any plant."""
    return {"rows": len(trace)}


def judge_quickly(trace: Trace, model: Model) -> dict[str, Any]:
    """Some numbers that depend on every bit of the trace; each call leaves its mark in $CAMPAIGN_CALLS.

    After the first $CAMPAIGN_FREE calls each one waits until the file $CAMPAIGN_GATE is gone.
    """
    source = f"{trace.provenance['source']} {trace.provenance.get('seed')}"
    if "CAMPAIGN_CALLS" in os.environ:
        with (Path(os.environ["CAMPAIGN_CALLS"])).open("a") as out:
            out.write(f"{os.getpid()} {source}\n")
        if len(Path(os.environ["CAMPAIGN_CALLS"]).read_text().splitlines()) > int(os.environ.get("CAMPAIGN_FREE", 0)):
            while Path(os.environ.get("CAMPAIGN_GATE", "")).is_file():
                time.sleep(0.02)
    if source == "filter_clogging=0.9 1":
        raise ZeroDivisionError("nothing\nleft to divide")
    error = trace.com - trace.xj
    return {"rms": float(np.sqrt((error**2).mean())), "sum": float(trace.p12.sum()), "last": float(trace.xs[-1]),
            "events": [{"t": float(t)} for t in np.flatnonzero(error > 2e-3)[:3]]}
