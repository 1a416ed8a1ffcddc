"""A run to record without a bench: the plant over the preflight command (docs/physics.md), as frames and cycles."""

from collections.abc import Iterator
from pathlib import Path

import codec
import numpy as np
from physics_cases import PREFLIGHT

from fdi.trace import CheckResult
from plant import load_model, simulate
from rig.network import Frame
from rig.recorder import Event, NmtState, Recorder, Signals, Timing

ATTACHMENTS = {"sequence.toml": ("application/toml", b"title = 'synthetic'\n"),
               "model.toml": ("application/toml", b"name = 'eha'\n"),
               "eha.dbc": ("text/plain", b'VERSION ""\n')}
METADATA = {"seed": "1", "bus": "embedded", "pace": "lockstep", "period": "0.001", "model": "eha"}


def build_cycles(seed: int = 1,
           settings: dict[str, float] | None = None) -> Iterator[tuple[int, list[Frame], Signals, Timing]]:
    """(t_ns, frames, signals, timing) of each cycle: 300 of set-up, the preflight command, 200 of clean-up."""
    com = np.concatenate([np.zeros(300), PREFLIGHT, np.zeros(200)])
    run = simulate(load_model().replace(settings or {}), com, seed=seed)
    phase = np.concatenate([np.zeros(300), np.ones(len(com) - 500), np.full(200, 2)]).astype(int)
    rng = np.random.default_rng(seed)
    late, answer = 2e-5 + rng.gamma(1.5, 2e-5, len(com)), 1.5e-4 + rng.gamma(2.0, 1.5e-5, len(com))
    for k, (x, xj, cor, p12, xs) in enumerate(zip(*(c.tolist() for c in (run.com, run.xj, run.cor, run.p12, run.xs)),
                                                  strict=True)):
        t_ns = k * 1_000_000
        frames = [Frame(t_ns, codec.COMMAND, codec.pack_command(x, 7, k & 0xFFFF)),
                  Frame(t_ns, codec.SYNC, b""),
                  Frame(t_ns, codec.FEEDBACK, codec.pack_feedback(xj, p12)),
                  Frame(t_ns, codec.VALVE_STATE, codec.pack_valve_state(xs, 0, k & 0xFFFF)),
                  Frame(t_ns, codec.DRIVE, codec.pack_drive(cor, 15, k & 0xFFFF))]
        yield (t_ns, frames, Signals(k, int(phase[k]), x, xj, cor, p12, xs, 0.0, 7, 15, 0),
               Timing(k, bool(late[k] > 1e-3), float(late[k]), float(answer[k]), float(answer[k] + 1e-4)))


def record_run(path: Path, seed: int = 1, settings: dict[str, float] | None = None, stop: int | None = None) -> Path:
    """Record the run (the first `stop` cycles of it) as `path`."""
    recorder = Recorder(path, ATTACHMENTS, METADATA)
    recorder.put(0, Event("INFO", "phase", "set-up"))
    for node in (2, 3):
        recorder.put(0, NmtState(node, 0, "boot-up"))
        recorder.put(50_000_000, NmtState(node, 127, "pre-operational"))
        recorder.put(100_000_000, NmtState(node, 5, "operational"))
    for t_ns, frames, signals, timing in build_cycles(seed, settings):
        if signals.cycle == stop:
            break
        if signals.cycle in EVENTS:
            recorder.put(t_ns, EVENTS[signals.cycle])
        for frame in frames:
            recorder.frame(frame)
        recorder.cycle(t_ns, signals, timing)
    for check in CHECKS:
        recorder.put(14_000_000_000, check)
    recorder.metadata("verdict", {"status": "FAIL" if stop is None else "ABORTED"})
    recorder.close()
    return path


EVENTS = {300: Event("INFO", "phase", "main"), 6300: Event("WARN", "fault", "sensors.position_offset: ramps in"),
          13800: Event("INFO", "phase", "clean-up")}  # by their cycle
CHECKS = [
    CheckResult(name="overshoot of the 5 mm step", kind="overshoot", signal="xj", value=2.4, unit="%", high=5.0,
                passed=True, t0=0.5, t1=1.5),
    CheckResult(name="settling of the 1 mm step", kind="settling_time", signal="xj", value=61.0, unit="ms", high=80.0,
                passed=True, t0=2.5, t1=3.25),
    CheckResult(name="ramp error", kind="ramp_error", signal="error", value=9.1e-6, unit="m", low=2e-6, high=8e-6,
                passed=False, t0=4.5, t1=6.0, detail="mean of com - xj over the slope"),
    CheckResult(name="pressure", kind="never_exceeds", signal="p12", value=0.61, unit="MPa", low=-1.0, high=1.0,
                passed=True, t0=0.0, t1=13.5),
]
