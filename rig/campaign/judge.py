"""What a campaign does with a run: the judgements by name, each from trace and healthy model to a flat row."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi.trace import Trace
from plant import Model

WORKS: Mapping[str, str] = {"fdi": "rig.campaign.judge:fdi"}
"""Short names of judgements."""


def fdi(trace: Trace, model: Model) -> dict[str, Any]:
    """`rig fdi` on the trace."""
    raise NotImplementedError
