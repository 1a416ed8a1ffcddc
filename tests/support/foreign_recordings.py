"""One run as other loggers write it: other names, units, rates, signs and formats."""

from pathlib import Path
from typing import Any

import numpy as np
from short_runs import HIDDEN, STEPS, build_command, simulate_trace

from fdi.trace import Trace
from plant import Model

DBC_TEXT = """VERSION ""

BU_: DAQ

BO_ 801 Demand: 8 DAQ
 SG_ Target : 0|32@1- (1E-5,0) [0|0] "mm" DAQ
BO_ 802 Ram: 8 DAQ
 SG_ Stroke : 0|32@1- (-1E-5,0) [0|0] "mm" DAQ
 SG_ DeltaP : 32|32@1- (1E-4,0) [0|0] "bar" DAQ
BO_ 803 Valve: 8 DAQ
 SG_ Current : 0|32@1- (1E-5,0) [0|0] "mA" DAQ
 SG_ Spool : 32|32@1- (1E-3,0) [0|0] "um" DAQ
"""

CAN_MAP = """
[signals.com]
source = "Demand.Target"
unit = "mm"
[signals.xj]
source = "Ram.Stroke"
unit = "mm"
[signals.p12]
source = "Ram.DeltaP"
unit = "bar"
[signals.cor]
source = "Valve.Current"
unit = "mA"
[signals.xs]
source = "Valve.Spool"
unit = "um"
"""

MDF_MAP = """
[signals.com]
source = "target"
unit = "mm"
[signals.xj]
source = "stroke"
unit = "mm"
sign = -1
[signals.p12]
source = "pressure_a"
unit = "bar"
minus = "pressure_b"
[signals.cor]
source = "current"
unit = "mA"
[signals.xs]
source = "spool"
unit = "um"
"""


def simulate_run(rows: int = 1500) -> Trace:
    """A run with a null bias, which compare finds."""
    return simulate_trace(Model().replace(HIDDEN), build_command()[:rows], seed=1, steps=STEPS)


def write_german_csv(trace: Trace, path: Path) -> None:
    """2 kHz, mm and bar, decimal comma, a comment, quoted names, a mark of UTF-8; XJ with the other sign.

    What the controller writes is held between its cycles; the sensors were sampled at 2 kHz.
    """
    columns = [np.arange(2 * len(trace) - 1) * 0.5, _hold(trace.com) * 1e3, -_refine(trace.xj) * 1e3,
               _hold(trace.cor) * 1e3, _refine(trace.p12) / 1e5, _refine(trace.xs) * 1e6]
    lines = ["# logger 7; test bench", '"Zeit [ms]";"Sollweg [mm]";"Kolbenweg [mm]";Ventilstrom;'
                                       '"Differenzdruck (bar)";Schieber;Status']
    for row in zip(*(column.tolist() for column in columns), strict=True):
        lines.append(";".join(repr(value).replace(".", ",") for value in row) + ";OK")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")


def _hold(x: np.ndarray) -> np.ndarray:
    return np.repeat(x, 2)[:-1]


def _refine(x: np.ndarray) -> np.ndarray:
    fine = np.empty(2 * len(x) - 1)
    fine[::2], fine[1::2] = x, 0.5 * (x[1:] + x[:-1])
    return fine


def write_mf4(trace: Trace, path: Path) -> None:
    """Three channel groups with times of their own: controller, sensors half a cycle late in the file, spool."""
    import asammdf

    def make_signal(name: str, unit: str, values: Any, late: float = 0.0) -> Any:
        return asammdf.Signal(np.asarray(values), trace.t + 100.0 + late, unit=unit, name=name)

    file = asammdf.MDF(version="4.10")
    file.append([make_signal("target", "mm", trace.com * 1e3), make_signal("current", "mA", trace.cor * 1e3)])
    file.append([make_signal("stroke", "mm", -trace.xj * 1e3, 2e-4),
                 make_signal("pressure_a", "bar", trace.p12 / 1e5 + 100.0, 2e-4),
                 make_signal("pressure_b", "bar", np.full(len(trace), 100.0), 2e-4)])
    file.append([make_signal("spool", "um", trace.xs * 1e6)])
    file.save(path, overwrite=True)
    file.close()


def write_can_log(trace: Trace, path: Path) -> None:
    """Three frames a cycle: demand before the sensors, valve after them, each up to 20 us early or late."""
    import can

    jitter = np.random.default_rng(0).uniform(-2e-5, 2e-5, (len(trace), 3))
    with can.Logger(path) as log:
        for k in range(len(trace)):
            frames = ((801, -3e-4, [(trace.com[k], 1e-8)]), (802, 0.0, [(-trace.xj[k], 1e-8), (trace.p12[k], 10.0)]),
                      (803, 3e-4, [(trace.cor[k], 1e-8), (trace.xs[k], 1e-9)]))
            for i, (number, late, values) in enumerate(frames):
                data = b"".join(round(value / lsb).to_bytes(4, "little", signed=True) for value, lsb in values)
                log(can.Message(timestamp=1.7e9 + trace.t[k] + late + jitter[k, i], arbitration_id=number,
                                data=data.ljust(8, b"\0"), is_extended_id=False, channel=0))
