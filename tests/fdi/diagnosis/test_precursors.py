"""Precursors against closed forms, their table of sensitivities, and the page that shows them."""
from __future__ import annotations

import json
import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rig_command import rig

from fdi.diagnosis.bands import (
    MEANINGS,
    Precursor,
    UnitKind,
    compute_features,
    find_kind,
    format_precursor,
    load_default_bands,
    measure_precursors,
    simulate_units,
    smooth_spikes,
)
from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate
from fdi.report.diagnosis_report import draw_precursor_shifts, draw_sizes
from fdi.trace.sections import Section, find_sections
from fdi.trace.trace import Trace
from plant import load_model, simulate
from rig.sequences import load_sequence

MS = 1e-3


@cache
def command() -> np.ndarray:
    return load_sequence("preflight").main_profile().command


@cache
def run(clogging: float = 0.0, friction: float = 5.0) -> Trace:
    model = load_model().replace({"filter.clogging": clogging, "spool.static_friction": friction,
                                  "spool.dynamic_friction": friction / 1.5})
    return Trace.from_columns(simulate(model, command(), seed=11)._asdict(), MS, {})


def second_order(zeta: float, omega: float, rows: int, size: float) -> np.ndarray:
    t = np.arange(rows) * MS
    damped = omega * math.sqrt(1 - zeta**2)
    return size * (1 - np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t)))


def measure_features(com: np.ndarray, xj: np.ndarray) -> dict[str, float]:
    return {name: float(v[0]) for name, v in compute_features(com, xj[None], MS, find_sections(com)).items()}


def measured(trace: Trace, xj: np.ndarray) -> dict[str, Precursor]:
    """Precursors of a trace with another position."""
    return measure_precursors(Trace.from_columns({"com": trace.com, "xj": xj, "cor": trace.cor}, MS, {}))


@pytest.mark.parametrize(("zeta", "omega"), [(0.3, 100.0), (0.5, 80.0), (0.7, 150.0)])
def test_a_step_of_second_order(zeta: float, omega: float) -> None:
    """Overshoot exp(-pi zeta / root), its square back, peak at pi / omega_d; rise and settling as on a fine grid."""
    com = np.r_[np.zeros(300), np.full(700, 2e-3)]
    x = np.r_[np.zeros(300), second_order(zeta, omega, 700, 2e-3)]
    found = measure_features(com, x)
    root = math.sqrt(1 - zeta**2)
    over = math.exp(-math.pi * zeta / root)
    fine = np.arange(700_000) * 1e-6
    y = 1 - np.exp(-zeta * omega * fine) * (np.cos(omega * root * fine) + zeta / root * np.sin(omega * root * fine))
    for name, expected in {
            "overshoot_2mm": pytest.approx(100 * over, abs=0.6),
            "undershoot_2mm": pytest.approx(100 * over**2, abs=0.3),
            "peak_time_2mm": pytest.approx(math.pi / (omega * root), abs=4e-4),
            "rise_time_2mm": pytest.approx(fine[np.argmax(y > 0.9)] - fine[np.argmax(y > 0.1)], abs=5e-4),
            "settling_time_2mm": pytest.approx(fine[np.flatnonzero(np.abs(y - 1) > 0.05)[-1]], abs=1.5e-3),
            "rest_error": pytest.approx(0.0, abs=1e-6)}.items():
        assert found[name] == expected, name


def test_an_oscillation_on_a_ramp() -> None:
    """A sine of 8 Hz and 50 um about a lag of 7 um gives back just that; a shift of both ramps is the asymmetry."""
    ramp = 5e-4 * np.arange(2000) * MS
    com = np.r_[np.zeros(300), ramp, np.full(300, 1e-3), 1e-3 - ramp, np.zeros(300)]
    wave = 5e-5 * np.sin(2 * np.pi * 8 * np.arange(len(com)) * MS)
    way = np.repeat([0.0, 1.0, 0.0, -1.0, 0.0], [300, 2000, 300, 2000, 300])
    found, loaded = (measure_features(com, com - 7e-6 * way + more) for more in (wave, -4e-5))
    for name, expected in {
            "stick_slip_frequency": pytest.approx(8.0, abs=0.4), "stick_slip_amplitude": pytest.approx(5e-5, rel=0.02),
            "break_away": pytest.approx(5e-5, rel=0.02), "mean_ramp_error": pytest.approx(7e-6, abs=1.5e-6),
            "ramp_asymmetry": pytest.approx(0.0, abs=2e-6),
            "speed_ripple": pytest.approx(2 * np.pi * 8 * 5e-5 / math.sqrt(2), rel=0.06)}.items():
        assert found[name] == expected, name
    assert loaded["ramp_asymmetry"] == pytest.approx(4e-5, rel=0.03)


def test_closed_forms_of_the_plant() -> None:
    """Mean ramp error: rate/Kpos + FDJ 5.56e-9 m/N; break-away: 3.9 um per N of FSS, and 1/(1 - Kintas) of that."""
    healthy, stuck, both = (measure_precursors(run(*f)) for f in ((0.0, 5.0), (0.0, 35.0), (0.35, 35.0)))
    kpos = 3.8 * 2.27 * 0.30 / (14.5 * 1.5e-3)
    assert healthy["mean_ramp_error"].value == pytest.approx(5e-4 / kpos + 500 * 5.56e-9, abs=1.5e-6)
    small, large, clogged = (found["break_away"].value for found in (healthy, stuck, both))
    assert (small, large) == pytest.approx((3.9e-6 * 5, 3.9e-6 * 35), rel=0.12)
    assert clogged / large == pytest.approx(1 / 0.65, rel=0.04)


def test_each_fault_where_it_shows() -> None:
    """Clogging in overshoot and settling, friction in break-away and slips; neither in the other's best sign."""
    faults = (0.0, 5.0), (0.35, 5.0), (0.0, 35.0)
    healthy, clogged, stuck = (measure_precursors(run(*f), load_default_bands()) for f in faults)
    assert all(abs(p.departure) < 4.5 for p in healthy.values() if math.isfinite(p.departure))
    assert clogged["settling_time_1mm"].departure > 5 and clogged["overshoot_5mm"].departure > 2
    assert stuck["break_away"].departure > 100 and stuck["slip_speed"].departure > 20
    assert clogged["break_away"].departure < 0.1 * stuck["break_away"].departure


def test_the_table_tells_what_tells() -> None:
    """Break-away is worth a hundred scatters of friction, the mean ramp error hardly three; fresh units say so."""
    table = measure_precursors(run(), load_default_bands())
    assert table["break_away"].friction_ratio > 100 and abs(table["mean_ramp_error"].friction_ratio) < 4
    assert abs(table["mean_ramp_error"].clogging_ratio) < 1 < abs(table["settling_time_5mm"].clogging_ratio)
    com = command()
    x = simulate_units(load_model(), com, np.zeros_like(com), UnitKind(""), 64, seed=77)
    fresh = compute_features(com, x, MS, find_sections(com))
    for name in ("overshoot_5mm", "break_away", "mean_ramp_error", "speed_ripple"):
        assert float(fresh[name].mean()) == pytest.approx(table[name].healthy, abs=0.5 * table[name].noise)
        assert float(fresh[name].std()) == pytest.approx(table[name].noise, rel=0.4)


def test_spikes_and_holes() -> None:
    """Single outliers move nothing that a peak or a range decides; a hole too large leaves nothing to measure."""
    clean, rows = run(), np.arange(len(run()))
    right = measure_precursors(clean)
    spiked = measured(clean, clean.xj + 4e-3 * np.isin(rows, [535, 1540, 2528, 4700, 7000]))
    for name in ("overshoot_5mm", "overshoot_1mm", "break_away", "settling_time_5mm", "slip_speed"):
        assert spiked[name].value == pytest.approx(right[name].value, rel=0.05)
    few, many = (measured(clean, np.where((rows >= 2000) & (rows < stop), np.nan, clean.xj)) for stop in (2030, 2500))
    assert (few.keys(), many) == (right.keys(), {})


def test_what_a_command_does_not_show() -> None:
    """No ramps, no stick-slip; no steps, no overshoot; an oscillation that goes on has no settling time."""
    com = np.r_[np.zeros(200), np.full(800, 1e-3)]
    found = measure_features(com, com + 2e-4 * np.sin(2 * np.pi * 10 * np.arange(1000) * MS))
    assert "break_away" not in found and math.isnan(found["settling_time_1mm"])
    assert format_precursor(math.nan, "settling_time_1mm") == "-"
    assert compute_features(np.zeros(500), np.zeros((1, 500)), MS, [Section("hold", 0, 500, 0.0, 0.0, 0.0)]) == {}


def test_words_and_units() -> None:
    """Every precursor has a name that a person reads, and a unit; JSON can carry them."""
    found = measure_precursors(run(), load_default_bands())
    assert {find_kind(name) for name in found} == set(MEANINGS)
    assert found["overshoot_5mm"].words == "first overshoot, 5 mm"
    assert {p.unit for p in found.values()} == {"%", "s", "m", "m/s", "Hz"}
    json.dumps({name: p._asdict() for name, p in found.items()})
    assert smooth_spikes(np.array([[0.0, 0, 0, 9, 0, 0, 0]])).max() == 0.0


def test_the_page(tmp_path: Path) -> None:
    """One file without network: verdict, levels, pictures of bands and maps, precursors; a trace's name is text."""
    source = tmp_path / "<b>run<b>.csv"
    run(0.35, 60.0).write_csv(source)
    assert rig("fdi", source, "--out", tmp_path / "p.html", "--quiet").status == 1
    page = (tmp_path / "p.html").read_text()
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", page) and page.count("<script") == 1
    assert "&lt;b&gt;run&lt;b&gt;.csv" in page and "<b>run<b>" not in page and len(page) < 3_000_000
    assert [words for words in ("Response in its bands", "RMS maps", "Precursors", "MaxBand", "break-away",
                                "command_hash") if words not in page] == []
    assert page.count("<svg") == len(re.findall(r'<g id="figure_\d+"', page)) == 6


def test_pictures_without_bands() -> None:
    """Sizes can be drawn without grid and bands; precursors without a table are not."""
    sizes = {CLOGGING.name: Estimate(0.9, 0.8, 0.97), FRICTION.name: Estimate(150.0, 140.0, 170.0)}
    assert draw_sizes(sizes, None, None).startswith("<svg")
    assert draw_precursor_shifts(measure_precursors(run())) == ""

