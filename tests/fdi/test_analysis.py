"""The public Python interface: the lines of docs/python.md as they stand there, and what results can do."""
from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effect_files import restored_catalogue
from short_runs import HIDDEN, write_measured_runs

import fdi
from fdi.analysis import Plot, Result
from fdi.diagnosis.refine import SUSPECTS
from fdi.report.drawing import Drawing
from fdi.report.report import Figure, Report, Section
from plant import InputError, Model
from plant.effects import CATALOGUE

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text()
EXAMPLES = [re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in
            re.findall(r"(?:^    .*\n|^\n(?=    ))+", PAGE.split("## Functions")[0], re.MULTILINE)]
FEW = {"null_bias", "spool_friction", *(suspect.effect for suspect in SUSPECTS)}  # what `diagnose` needs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("runs"), HIDDEN)


@pytest.fixture(scope="module")
def lines(runs: dict[str, Path]) -> Iterator[dict[str, Any]]:
    """The names that the six examples of docs/python.md leave, run beside short traces with a small catalogue."""
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch, restored_catalogue():
        patch.chdir(runs["est"].parent)
        for name in set(CATALOGUE) - FEW:
            del CATALOGUE[name]
        for name, source in (("run", "est"), ("run2", "repeat"), ("held", "holdout")):
            shutil.copy(runs[source], f"{name}.csv")
        names["printed"] = []
        for example in EXAMPLES:
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(example, names)
            names["printed"].append(out.getvalue())
        yield names


def test_the_lines_of_the_page_find_the_hidden_effect(lines: dict[str, Any], runs: dict[str, Path]) -> None:
    folder = runs["est"].parent
    assert lines["explanation"].effects == ("null_bias",) and lines["explanation"].verdict == "EXPLAINED"
    result = lines["result"]
    assert result.helps and result.model.effects == ("null_bias",)
    interval = result.to_dict()["parameters"]["null_bias.current"]
    assert interval["low"] < HIDDEN["null_bias.current"] < interval["high"]
    assert fdi.compare(folder / "est.csv", folder / "model.toml", repeats=[folder / "repeat.csv"]
                       ).verdict == "WITHIN_FLOOR"
    assert (folder / "residual.svg").read_text().startswith("<svg")
    assert "Faults" in (folder / "diagnosis.html").read_text()


def test_there_are_six_short_examples_and_they_print_what_they_say(lines: dict[str, Any]) -> None:
    assert len(EXAMPLES) == len(re.findall(r"^\*\*\d\. ", PAGE, re.MULTILINE)) == 6
    assert all(len(example.strip().splitlines()) <= 7 for example in EXAMPLES)
    compared, plotted, explained, diagnosed, simulated, table = lines["printed"]
    assert compared.startswith("MODEL_INCOMPLETE") and "times the noise floor" in compared
    assert plotted == simulated == ""
    assert explained.splitlines() == ["EXPLAINED ('null_bias',)", "WITHIN_FLOOR"]
    assert diagnosed.startswith("<DiagnosisResult ") and "'low'" in diagnosed
    assert [row.split()[:2] for row in table.splitlines()] == [
        ["nominal", "MODEL_INCOMPLETE"], ["fitted", "WITHIN_FLOOR"], ["clogged", "MODEL_INCOMPLETE"]]


def test_a_plot_is_a_matplotlib_figure_and_files(lines: dict[str, Any], runs: dict[str, Path], tmp_path: Path) -> None:
    plot = lines["comparison"].plot()
    residual = plot.figure.axes[2]
    drawn = max((len(line.get_xdata()) for line in residual.lines), default=0)
    assert residual.get_ylabel() == "residual of\nXJ [um]" and drawn == len(lines["trace"]), "all points"
    assert (runs["est"].parent / "close_up.png").read_bytes().startswith(b"\x89PNG")
    shares = lines["comparison"].plot("Where")  # a small one
    for name, begin in (("a.svg", b"<svg"), ("a.png", b"\x89PNG"), ("a.pdf", b"%PDF")):
        shares.write(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(begin)
    with pytest.raises(InputError, match=r"a\.xyz: expected a file of a known kind .*supported formats: .*png"):
        shares.write(tmp_path / "a.xyz")
    with pytest.raises(InputError, match="No such file"):
        shares.write(tmp_path / "none" / "a.png")


def test_a_plot_converts_to_plotly(lines: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    comparison = lines["comparison"]
    found = comparison.plot().to_plotly()
    residual = comparison.comparison.replay.residual["xj"]
    curves = [curve for curve in found.data if curve.yaxis == "y3"]
    assert any(len(curve.y) == len(residual) and np.allclose(curve.y, 1e6 * residual, equal_nan=True)
               for curve in curves)
    assert found.layout.xaxis3.matches == "x" and found.layout.yaxis3.title.text == "residual of<br>XJ [um]"
    assert {curve.name for curve in found.data if curve.showlegend} >= {"measured", "model, from the current"}
    floor = 2e6 * comparison.comparison.signals["xj"].floor.value
    assert any(curve.fill == "toself" and max(curve.y) == pytest.approx(floor) for curve in curves), "the noise floor"
    shares = comparison.plot("Where")
    shares.write(tmp_path / "where.html")
    assert "Plotly.newPlot" in (tmp_path / "where.html").read_text()
    assert len(shares.to_plotly().layout.yaxis.ticktext) == len(comparison.comparison.where)


def test_without_plotly_the_message_says_what_to_install(
        lines: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    with pytest.raises(InputError, match=r"pip install 'eha-rig\[plots\]'"):
        lines["comparison"].plot("Where").to_plotly()


def test_values_have_a_short_repr(lines: dict[str, Any]) -> None:
    texts = [repr(lines[name]) for name in ("comparison", "explanation", "result", "diagnosis", "trace", "plot")]
    texts += [repr(Model()), repr(lines["result"].model)]
    assert all(len(text) < 180 and "\n" not in text and text[0] == "<" for text in texts), texts
    assert texts[0].startswith("<ComparisonResult MODEL_INCOMPLETE: The model does not explain")
    assert texts[4] == "<Trace of run.csv: 4000 cycles of 1 ms, 4 s, xj, p12, xs>"
    assert texts[6] == "<Model eha of plant eha: nominal>"
    assert texts[7].startswith("<Model eha of plant eha with null_bias: ")


def test_every_result_prints_shows_plots_and_converts(lines: dict[str, Any]) -> None:
    results = [lines["comparison"], lines["explanation"], lines["result"]]
    for result in [*results, fdi.diagnose(lines["trace"])]:
        assert isinstance(result, Result)
        assert str(result).startswith(f"{result.verdict}  {result.sentence}\n")
        page, cell, answer, drawn = result.to_html(), result._repr_html_(), result.to_dict(), result.plot()
        assert result.verdict in page and "</html>" in page
        assert cell.startswith("<iframe srcdoc=") and "<script" not in cell
        assert json.loads(json.dumps(answer, allow_nan=False)) == answer
        assert isinstance(drawn, Plot) and drawn.startswith("<svg") and drawn.caption in page
        with pytest.raises(InputError, match=f"one of {re.escape(result.figures[0])}"):
            result.plot("nothing of this name")
    for result in results:
        plots = [result.plot(title) for title in result.figures]
        assert len(plots) > 1 and len({str(plot) for plot in plots}) == len(plots)


def test_a_figure_without_data_is_an_error() -> None:
    empty = Figure("caption", lambda: "")
    result = Result(Report("compare", "run 7", sections=[Section("Empty", [empty])]))
    with pytest.raises(InputError, match="for which the trace has data"):
        result.plot()
    drawn = Figure("a line", lambda: Drawing("<svg></svg>"))
    result = Result(Report("compare", "run 7", sections=[Section("Empty", [empty, drawn])]))
    assert result.figures == ("Empty", "Empty 2")
    assert result.plot() == result.plot("Empty 2") == "<svg></svg>" and result.plot().caption == "a line"


def test_the_dictionary_is_the_answer_of_the_command(lines: dict[str, Any], runs: dict[str, Path]) -> None:
    from rig_command import rig

    said = rig("compare", runs["est"], "--repeat", runs["repeat"], "--json").json
    own = fdi.compare(runs["est"], repeats=[runs["repeat"]]).to_dict()
    assert own == said
    from_memory = lines["comparison"].to_dict()
    assert {**from_memory, "trace": said["trace"]} == said


def test_traces_in_memory_do_for_files(runs: dict[str, Path]) -> None:
    trace = fdi.read_trace(runs["est"])
    with pytest.raises(InputError, match="the same command run again"):
        fdi.explain(trace, repeats=[trace])
    with pytest.raises(InputError, match="a run that no fit has seen"):
        fdi.add_effect("null_bias", trace, holdout=trace)


def test_a_model_is_a_value_a_file_or_a_name(runs: dict[str, Path], tmp_path: Path) -> None:
    model = Model().replace(HIDDEN)
    (tmp_path / "biased.toml").write_text(model.to_toml())
    found = [fdi.compare(runs["est"], given).verdict for given in (model, tmp_path / "biased.toml", "eha")]
    assert found == ["WITHIN_FLOOR", "WITHIN_FLOOR", "MODEL_INCOMPLETE"]


def test_bad_input_names_the_file(tmp_path: Path, runs: dict[str, Path]) -> None:
    with pytest.raises(InputError, match=r"nowhere\.csv"):
        fdi.compare(tmp_path / "nowhere.csv")
    with pytest.raises(InputError, match="xq"):
        fdi.compare(runs["est"], signals=["xq"])
    with pytest.raises(InputError, match="nosuch: expected an effect of the catalogue"):
        fdi.add_effect("nosuch", runs["est"])
    with pytest.raises(InputError, match="path"):
        fdi.compare(runs["est"]).write_html(tmp_path / "none" / "page.html")


def test_importing_fdi_loads_neither_numba_nor_matplotlib() -> None:
    code = "import sys, fdi; print([m for m in ('numba', 'matplotlib', 'numpy', 'rich', 'jinja2') if m in sys.modules])"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"
