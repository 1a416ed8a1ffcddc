"""The public Python interface: the lines of docs/python.md as they stand there, what results can do, and progress."""

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effect_files import restored_catalogue
from refusals import catch_refusal
from rig_command import rig
from short_runs import HIDDEN, build_command, simulate_trace, write_measured_runs

import fdi
from fdi.analysis import Plot, Result
from fdi.diagnosis.diagnosis import diagnose
from fdi.diagnosis.refine import SUSPECTS
from fdi.discovery.runs import read_source
from fdi.trace import Trace
from plant import Model

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text()
EXAMPLES = [re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in
            re.findall(r"(?:^    .*\n|^\n(?=    ))+", PAGE.split("## Functions")[0], re.MULTILINE)]
FEW = ("null_bias", "spool_friction", *(suspect.effect for suspect in SUSPECTS))  # what `diagnose` needs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("runs"), HIDDEN)


@pytest.fixture(scope="module")
def lines(runs: dict[str, Path]) -> Iterator[dict[str, Any]]:
    """The names that the six examples of docs/python.md leave, run beside short traces with a small catalogue."""
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch, restored_catalogue(*FEW):
        patch.chdir(runs["est"].parent)
        for name, source in (("run", "est"), ("run2", "repeat"), ("held", "holdout")):
            shutil.copy(runs[source], f"{name}.csv")
        names["printed"] = []
        for example in EXAMPLES:
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(example, names)
            names["printed"].append(out.getvalue())
        yield names


def test_the_lines_of_the_page_find_the_hidden_effect(lines: dict[str, Any], runs: dict[str, Path]) -> None:
    folder, result = runs["est"].parent, lines["result"]
    assert (lines["explanation"].effects, lines["explanation"].verdict) == (("null_bias",), "EXPLAINED")
    assert (result.helps and result.model.effects == ("null_bias",)
            and result.update.provenance.repeats == (read_source("run2.csv"),))  # by which rig add knows it again
    interval = result.to_dict()["parameters"]["null_bias.current"]
    assert interval["low"] < HIDDEN["null_bias.current"] < interval["high"]
    compared = fdi.compare(folder / "est.csv", folder / "model.toml", repeats=[folder / "repeat.csv"])
    assert compared.verdict == "WITHIN_FLOOR" and (folder / "residual.svg").read_text().startswith("<svg")
    assert "Faults" in (folder / "diagnosis.html").read_text()


def test_there_are_six_short_examples_and_they_print_what_they_say(lines: dict[str, Any]) -> None:
    assert len(EXAMPLES) == len(re.findall(r"^\*\*\d\. ", PAGE, re.MULTILINE)) == 6
    assert all(len(example.strip().splitlines()) <= 7 for example in EXAMPLES)
    comparison, plot, explanation, diagnosis, simulation, table = lines["printed"]
    assert comparison.startswith("MODEL_INCOMPLETE") and "times the noise floor" in comparison
    assert plot == simulation == ""
    assert explanation.splitlines() == ["EXPLAINED ('null_bias',)", "WITHIN_FLOOR"]
    assert diagnosis.startswith("<DiagnosisResult ") and "'low'" in diagnosis
    assert [row.split()[:2] for row in table.splitlines()] == [
        ["nominal", "MODEL_INCOMPLETE"], ["fitted", "WITHIN_FLOOR"], ["clogged", "MODEL_INCOMPLETE"]]


def test_a_plot_is_a_matplotlib_figure_and_files(lines: dict[str, Any], runs: dict[str, Path], tmp_path: Path) -> None:
    residual = lines["comparison"].plot().figure.axes[2]
    point_count = max(len(line.get_xdata()) for line in residual.lines)
    assert residual.get_ylabel() == "residual of\nXJ [um]" and point_count == len(lines["trace"]), "all points"
    assert (runs["est"].parent / "close_up.png").read_bytes().startswith(b"\x89PNG")
    shares = lines["comparison"].plot("Where")  # a small one
    for name, begin in (("a.svg", b"<svg"), ("a.png", b"\x89PNG"), ("a.pdf", b"%PDF")):
        shares.write(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(begin)
    assert re.search(r"a\.xyz: expected a file of a known kind .*supported formats: .*png",
                     catch_refusal(shares.write, tmp_path / "a.xyz"))
    assert "No such file" in catch_refusal(shares.write, tmp_path / "none" / "a.png")


def test_a_plot_converts_to_plotly(lines: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    plots, comparison = lines["comparison"], lines["comparison"].comparison
    figure = plots.plot().to_plotly()
    residual, floor = 1e6 * comparison.replay.residual["xj"], 2e6 * comparison.signals["xj"].floor.value
    curves = [curve for curve in figure.data if curve.yaxis == "y3"]
    assert any(len(curve.y) == len(residual) and np.allclose(curve.y, residual, equal_nan=True) for curve in curves)
    assert any(curve.fill == "toself" and max(curve.y) == pytest.approx(floor) for curve in curves), "the noise floor"
    assert figure.layout.xaxis3.matches == "x" and figure.layout.yaxis3.title.text == "residual of<br>XJ [um]"
    assert {curve.name for curve in figure.data if curve.showlegend} >= {"measured", "model, from the current"}
    plots.plot("Where").write(tmp_path / "where.html")
    assert "Plotly.newPlot" in (tmp_path / "where.html").read_text()
    assert len(plots.plot("Where").to_plotly().layout.yaxis.ticktext) == len(comparison.where)


def test_without_plotly_the_message_says_what_to_install(
        lines: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    assert "pip install 'eha-rig[plots]'" in catch_refusal(lines["comparison"].plot("Where").to_plotly)


@pytest.mark.parametrize(("name", "begin"), [
    ("comparison", "<ComparisonResult MODEL_INCOMPLETE: The model does not explain"), ("explanation", "<"),
    ("trace", "<Trace of run.csv: 4000 cycles of 1 ms, 4 s, xj, p12, xs>"), ("result", "<"), ("diagnosis", "<"),
    ("plot", "<"), ("model", "<Model eha of plant eha: nominal>"),
    ("fitted", "<Model eha of plant eha with null_bias: ")])
def test_values_have_a_short_repr(name: str, begin: str, lines: dict[str, Any]) -> None:
    text = repr({**lines, "model": Model(), "fitted": lines["result"].model}[name])
    assert text.startswith(begin) and len(text) < 180 and "\n" not in text, text


@pytest.mark.parametrize("name", ["comparison", "explanation", "result", "diagnosis"])
def test_every_result_prints_shows_plots_and_converts(name: str, lines: dict[str, Any]) -> None:
    result: Any = lines[name]
    assert isinstance(result, Result) and str(result).startswith(f"{result.verdict}  {result.sentence}\n")
    page, cell, document, plot = result.to_html(), result._repr_html_(), result.to_dict(), result.plot()
    assert result.verdict in page and "</html>" in page
    assert cell.startswith("<iframe srcdoc=") and "<script" not in cell
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert isinstance(plot, Plot) and plot.startswith("<svg") and plot.caption in page
    assert f"one of {result.figures[0]}" in catch_refusal(result.plot, "nothing of this name")


def test_the_dictionary_is_the_answer_of_the_command(lines: dict[str, Any], runs: dict[str, Path]) -> None:
    answer = rig("compare", runs["est"], "--repeat", runs["repeat"], "--json").json
    assert fdi.compare(runs["est"], repeats=[runs["repeat"]]).to_dict() == answer
    assert {**lines["comparison"].to_dict(), "trace": answer["trace"]} == answer  # from memory


def test_a_model_is_a_value_a_file_or_a_name(runs: dict[str, Path], tmp_path: Path) -> None:
    model = Model().replace(HIDDEN)
    (tmp_path / "biased.toml").write_text(model.to_toml())
    verdicts = [fdi.compare(runs["est"], source).verdict for source in (model, tmp_path / "biased.toml", "eha")]
    assert verdicts == ["WITHIN_FLOOR", "WITHIN_FLOOR", "MODEL_INCOMPLETE"]


@pytest.mark.parametrize(("call", "says"), [
    (lambda est, file: fdi.compare("nowhere.csv"), "nowhere.csv"),
    (lambda est, file: fdi.compare(est, signals=["xq"]), "xq"),
    (lambda est, file: fdi.add_effect("nosuch", est), "nosuch: expected an effect of the catalogue"),
    (lambda est, file: fdi.compare(est).write_html("none/page.html"), "path"),
    (lambda est, file: fdi.explain(est, repeats=[est]), "the same command run again"),
    (lambda est, file: fdi.add_effect("null_bias", est, holdout=est), "a run that no fit has seen"),
    (lambda est, file: fdi.add_effect("null_bias", est, holdout=file), "a run that no fit has seen")])
def test_bad_input_is_one_line(call: Callable[[Trace, Path], object], says: str, runs: dict[str, Path]) -> None:
    assert says in catch_refusal(call, fdi.read_trace(runs["est"]), runs["est"])


def test_importing_fdi_loads_neither_numba_nor_matplotlib() -> None:
    code = "import sys, fdi; print([m for m in ('numba', 'matplotlib', 'numpy', 'rich', 'jinja2') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_bar_of_a_diagnosis_moves_within_its_long_stage() -> None:
    run = simulate_trace(Model().replace({"filter.clogging": 0.2}), build_command(), seed=1, steps=50)
    stages: list[tuple[str, float]] = []
    diagnose(run, workers=1, progress=lambda name, share: stages.append((name, share)))
    shares = [share for _, share in stages]
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert len({share for name, share in stages if name == "refinement"}) > 8
