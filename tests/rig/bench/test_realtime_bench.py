"""`rig bench realtime`: the contenders do what they are measured for, and the figures are what they say."""
from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from bus_stations import gather, spec
from rig_command import rig
from vcan_host import kernel_has_vcan0

from fdi.report.terminal import format_report
from rig.bench import realtime
from rig.bench.realtime import (
    COMPILED,
    CYCLICTEST,
    IN_C,
    PYTHON,
    build_realtime_report,
    parse_histogram,
    summarise_contenders,
)
from rig.bench.responders import run_c_responder, run_emulator
from rig.network import codec
from rig.network.bus import open_can
from rig.network.frame import Frame
from rig.network.link import Link
from rig.nodes.emulator import MISSED_LIMIT

raw_kinds = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)
needs_gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="gcc is not installed")

HISTOGRAM = """# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000023 000002
000024 000001
# Total: 000000003
# Min Latencies: 00023
# Avg Latencies: 00023
# Max Latencies: 00777
# Histogram Overflows: 00001
# Histogram Overflow at cycle number:
# Thread 0: 00002
"""


def test_the_histogram_of_cyclictest() -> None:
    assert sorted(parse_histogram(HISTOGRAM)) == pytest.approx([23e-6, 23e-6, 24e-6, 777e-6])


@needs_gcc
@raw_kinds
def test_the_responder_in_c_sends_the_frames_of_the_emulator(bus_kind: str) -> None:
    where = spec(bus_kind)
    link = Link(open_can(where), lambda: 0)
    with run_c_responder(where):
        for cycle in range(300):
            link.send(codec.SYNC, b"")
            feedback, valve = gather(link, 2)
            assert (feedback.cob_id, len(feedback.data), valve.cob_id) == (codec.FEEDBACK, 8, codec.VALVE_STATE)
            assert codec.unpack_valve_state(valve.data).cycle == cycle
    link.close()


@pytest.mark.parametrize("is_compiled", [False, True])
def test_the_emulator_answers_alone(is_compiled: bool) -> None:
    where = spec("udp_multicast")
    with run_emulator(where, is_compiled):
        link = Link(open_can(where), lambda: 0)
        errors: list[int] = []
        for cycle in range(5):
            link.send(codec.SYNC, b"")
            frames: list[Frame] = []
            while not {codec.FEEDBACK, codec.VALVE_STATE} <= {frame.cob_id for frame in frames}:
                frames += (more := gather(link, 1))
                assert more, f"no answer in cycle {cycle}"
            valves = [codec.unpack_valve_state(frame.data) for frame in frames if frame.cob_id == codec.VALVE_STATE]
            assert [valve.cycle for valve in valves] == [cycle]
            # Nobody answers: one EMCY after three cycles, which may be read with the answers of the cycle after.
            usual = {codec.FEEDBACK, codec.VALVE_STATE, 0x703}  # the last: it has the default heartbeat of 100 ms
            errors += [frame.cob_id for frame in frames if frame.cob_id not in usual]
            assert not errors or cycle >= MISSED_LIMIT
        assert errors in ([], [0x083])
        link.close()


def test_percentiles_ratios_and_targets() -> None:
    count = 10_001
    us = np.linspace(0.0, 100.0, count) * 1e-6
    answered = {"lateness": us, "feedback_response": 2 * us, "valve_response": 3 * us, "execution": us}
    times = {CYCLICTEST: {"lateness": us}, COMPILED: answered | {"feedback_response": 2.2 * us},
             IN_C: answered, PYTHON: answered | {"feedback_response": np.where(us > 90e-6, np.nan, us)}}
    figures = summarise_contenders(times)
    assert figures["times_us"]["lateness"][CYCLICTEST] == pytest.approx(
        {"p50": 50, "p99": 99, "p99_9": 99.9, "max": 100})
    assert figures["lost"] == {COMPILED: 0, IN_C: 0, PYTHON: 1000}
    targets = {target["name"]: (target["value"], target["is_met"]) for target in figures["targets"]}
    assert targets["feedback response p99, compiled / C"] == (pytest.approx(1.1), True)
    assert targets["lateness p50, compiled / cyclictest"] == (pytest.approx(1.0), True)
    assert targets["execution p99.9"] == (pytest.approx(99.9), True)
    slower = summarise_contenders(times | {COMPILED: {name: 1.31 * each for name, each in answered.items()}})
    assert not any(target["is_met"] for target in slower["targets"])


def test_what_is_not_there_is_no_target_met() -> None:
    us = np.array([1e-6, 2e-6])
    only = dict.fromkeys(("lateness", "feedback_response", "valve_response", "execution"), us)
    figures = summarise_contenders({COMPILED: only, PYTHON: only})
    assert [target["value"] for target in figures["targets"]] == [None] * 6 + [pytest.approx(1.999)]
    assert sum(target["is_met"] for target in figures["targets"]) == 1
    text = format_report(build_realtime_report(figures | {
        "bus": "udp_multicast:239.0.0.1", "seconds": 1.0, "blocks": 1, "cpus": 1, "priority": 0,
        "missing": ["cyclictest", "gcc"]}))
    assert "1 of 7 targets" in text and "apt-get install rt-tests" in text and "apt-get install gcc" in text
    assert "no real-time priority" in text


# The guest has a clock of 100 Hz: no real time there.
@pytest.mark.parametrize("bus_kind", ["udp_multicast"] + ["socketcan"] * ("EHA_RIG_GUEST" not in os.environ
                                                                          and kernel_has_vcan0()), indirect=True)
def test_the_command_measures_everybody(bus_kind: str) -> None:
    """At least the cycles asked for: where Python is late, the last input is repeated until the next one comes."""
    said = rig("bench", "realtime", "--bus", spec(bus_kind), "--seconds", 0.5, "--blocks", 1, "--json")
    assert said.status in (0, 1) and said.err == ""
    figures = said.json
    there = {COMPILED, PYTHON} | ({IN_C} if shutil.which("gcc") else set())
    assert figures["times_us"]["feedback_response"].keys() == there
    for name in there:
        assert figures["cycles"][name] >= 400 and figures["lost"][name] < figures["cycles"][name]
    if realtime.find_cyclictest():
        assert figures["times_us"]["lateness"][CYCLICTEST]["p50"] > 0


@pytest.mark.parametrize(("words", "says"), [
    (("--bus", "virtual:x"), "--bus: virtual:x: expected socketcan:INTERFACE"),
    (("--blocks", 0), "--blocks"), (("--seconds", 0.1), "--seconds"),
    (("--seconds", "nan"), "--seconds"),
])
def test_bad_input_is_one_line(words: tuple[object, ...], says: str) -> None:
    said = rig("bench", "realtime", *words)
    assert said.status == 2 and says in said.err and said.err.count("\n") == 1
