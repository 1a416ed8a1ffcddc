"""`rig compare` and `rig diff` as typed: words, JSON, exit statuses, pages, and what they refuse in one line."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from noisy_traces import record_healthy, record_plant
from rig_command import Said, answer, refuse, rig
from synthetic_run import record_run

from fdi.trace.csv_table import write_csv
from fdi.trace.trace import Trace


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """est, repeat of a healthy plant; fault with spool friction."""
    folder = tmp_path_factory.mktemp("traces")
    record_healthy(2).write_csv(folder / "est.csv")
    record_healthy(3).write_csv(folder / "repeat.csv")
    record_plant({"spool.static_friction": 30.0, "spool.dynamic_friction": 20.0}).write_csv(folder / "fault.csv")
    return folder


@pytest.fixture(scope="module")
def fault(folder: Path) -> Said:
    return rig("compare", folder / "fault.csv", "--out", folder / "fault.html")


def test_json_of_a_model_that_fits(folder: Path) -> None:
    told = answer("compare", folder / "est.csv", "--repeat", folder / "repeat.csv")
    assert (told["verdict"], told["repeats"]) == ("WITHIN_FLOOR", 1)
    assert {name: signal["unit"] for name, signal in told["signals"].items()} == {"xj": "m", "p12": "Pa", "xs": "m"}
    for name, floor in (("xj", 2e-6), ("p12", 2e4), ("xs", 1e-6)):
        signal = told["signals"][name]
        assert (signal["error"], signal["floor"]) == pytest.approx((floor, floor), rel=0.05)
        assert signal["ratio"] == pytest.approx(signal["error"] / signal["floor"]) and signal["closed_loop_error"] > 0
    assert 0 < told["solver_error"] < 0.1 * told["signals"]["xj"]["floor"]
    assert set(told["blocks"]) == {"controller", "servovalve", "jack", "sensor"}
    assert all({"section", "t0", "t1", "share", "condition"} <= set(place) for place in told["where"])
    assert sum(place["share"] for place in told["where"]) == pytest.approx(1.0, abs=0.01)


def test_words_of_a_model_that_does_not(fault: Said, folder: Path) -> None:
    assert (fault.status, fault.err) == (1, "")
    assert re.match(r"MODEL_INCOMPLETE  The model does not explain this trace: XJ error [\d.]+ um, noise floor "
                    r"[\d.]+ um; the servovalve disagrees; controller, jack and sensor fit.\n", fault.out)
    assert [words for words in (
        "from the command alone", "equal to the last digit", "halving the step", "floor     the model's sensor noise",
        "where     motion within 3 mm", "scatter   scatter", f"page      {folder / 'fault.html'}",
        f"next      rig explain {folder / 'fault.csv'}") if words not in fault.out] == []
    assert "nan" not in fault.out and not re.search(r"\d[eE][-+]\d", fault.out)


def test_a_page_that_needs_no_network(fault: Said, folder: Path) -> None:
    page = (folder / "fault.html").read_text()
    assert "MODEL_INCOMPLETE" in page and page.count("<svg") == 5 and "</html>" in page
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//|@import|<script[^>]*src""", page)
    assert page.count("<script") == 1 and len(page) < 3_000_000
    assert not re.search(r"\bnan\b", re.sub(r"<(svg|script).*?</\1>", "", page, flags=re.DOTALL))
    assert [words for words in ("Com and XJ to Cor", "Is the residual noise", "By speed and amplitude",
                                "What the residual depends on", "jack.damping", "share of the squared")
            if words not in page] == []


def test_the_right_parameters_bring_it_to_the_floor(folder: Path) -> None:
    friction = ["--set", "spool.static_friction=30", "--set", "spool.dynamic_friction=20"]
    assert answer("compare", folder / "fault.csv", *friction)["verdict"] == "WITHIN_FLOOR"
    (folder / "model.toml").write_text('name = "stiff"\n[spool]\nstatic_friction = 30.0\ndynamic_friction = 20.0\n')
    said = rig("compare", folder / "fault.csv", "--model", folder / "model.toml")
    assert said.status == 0 and said.out.startswith("WITHIN_FLOOR  The model explains this trace")
    assert "next" not in said.out


def test_results_go_where_they_should(folder: Path) -> None:
    for words in (["--out", folder / "told.json", "--signals", "xj, xs"], ["--report"]):
        assert rig("compare", folder / "est.csv", "--quiet", *words) == (0, "", "")
    assert set(json.loads((folder / "told.json").read_text())["signals"]) == {"xj", "xs"}
    assert "WITHIN_FLOOR" in (folder / "compare.html").read_text()


@pytest.mark.parametrize(("words", "refusal"), [
    (["nowhere.csv"], "nowhere.csv: expected a readable file"),
    (["{}/est.csv", "--signals", "xj,speed"], "--signals: speed: expected some of xj,p12,xs"),
    (["{}/est.csv", "--signals", ""], "--signals: : expected some of|--signals: expected some of"),
    (["{}/est.csv", "--repeat", "{}/other.csv"], "--repeat other.csv: com: expected the command of the trace"),
    (["{}/est.csv", "--set", "spool.fiction=1"], "spool.fiction: expected a field of spool; did you mean"),
    (["{}/est.csv", "--out", "{}/x.pdf"], "FILE.html for a page, or FILE.json"),
    (["{}/est.csv", "--out", "{}/none/x.html"], "a place that can be written"),
    (["{}/mm.csv"], "mm.csv: xj: expected values in m; the largest, 5.* times jack.travel"),
    (["{}/nocor.csv"], "nocor.csv: line 1: cor: expected a column of this name"),
    (["{}/dead.csv"], "dead.csv: xs: expected a signal that changes"),
])
def test_bad_input_is_one_line(folder: Path, words: list[str], refusal: str) -> None:
    columns = {name: getattr(record_healthy(2), name) for name in ("t", "com", "xj", "cor", "xs")}
    write_csv(folder / "other.csv", columns | {"com": -columns["com"]})
    write_csv(folder / "mm.csv", columns | {"xj": 1e3 * columns["xj"]})
    write_csv(folder / "nocor.csv", {name: x for name, x in columns.items() if name != "cor"})
    write_csv(folder / "dead.csv", columns | {"xs": np.zeros(len(columns["xs"]))})
    assert re.match(f"rig compare: .*(?:{refusal})", refuse("compare", *(word.format(folder) for word in words)))


def test_a_run_of_the_bench(preflight: Path) -> None:
    """The log of a whole run over the bus, quantised as its frames are."""
    told = answer("compare", preflight)
    assert told["verdict"] == "WITHIN_FLOOR" and told["blocks"]["controller"] < 1.2


def test_few_rows_still_have_a_page(tmp_path: Path) -> None:
    short = {name: getattr(record_healthy(2), name)[:300] for name in ("com", "xj", "cor", "p12", "xs")}
    Trace.from_columns(short, 1e-3, {}).write_csv(tmp_path / "short.csv")
    said = rig("compare", tmp_path / "short.csv", "--out", tmp_path / "short.html")
    assert said.status in (0, 1) and (tmp_path / "short.html").exists(), said.err


def test_a_run_is_the_same_as_itself_in_any_format_and_another_differs(tmp_path: Path) -> None:
    log, csv, other = record_run(tmp_path / "trace.mcap", stop=2000), tmp_path / "run.csv", tmp_path / "other.csv"
    Trace.read(log, all=True).write_csv(csv)
    same = answer("diff", log, csv)
    assert (same["verdict"], same["pairs"][0]["same_command"], same["runs"][1]["source"]) == ("SAME", True, str(csv))
    assert not any(check["changed"] for check in same["checks"])
    trace = Trace.read(csv)
    write_csv(other, {"t": trace.t, "com": trace.com, "xj": trace.xj + 1e-4 * (trace.t > 1.0), "cor": trace.cor})
    said = rig("diff", csv, other, "--report")
    page = (tmp_path / "diff.html").read_text(encoding="utf-8")
    assert said.status == 1 and said.out.startswith("DIFFERENT") and "P12 of B: only A has it" in said.out
    assert "B - A" in page and page.count("<svg") == 1
