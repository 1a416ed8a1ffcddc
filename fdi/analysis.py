"""The public Python interface: read a trace, compare, explain, add an effect, identify, diagnose (docs/python.md).

Each function answers with a `Result`. It can be printed, shown in a notebook, written as an HTML page, plotted and
turned into the dictionary that the command of the same name prints with --json.
"""
from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import fdi.report  # a report's function, and what it needs, is loaded at its first use
from fdi.foreign_code import load_effects_of_model, load_plant_of_model
from fdi.output import write_text
from fdi.report import Drawing, Figure, Medium, Report, convert_figure, render_html, save_drawing, to_plain
from fdi.trace import Trace
from plant import InputError, Model, load_model

if TYPE_CHECKING:
    from fdi.comparison.compare import Comparison
    from fdi.diagnosis.diagnosis import Diagnosis
    from fdi.discovery.explain_runs import Answer
    from fdi.discovery.runs import Runs
    from fdi.discovery.update_model import ModelUpdate, Provenance
    from fdi.identification.identify import Identification

TraceOrPath = Trace | str | Path
ModelOrPath = Model | str | Path


class Plot(Drawing):
    """A figure as SVG text, with its caption and as `figure` of matplotlib. A notebook shows it as a picture."""

    caption: str

    def __new__(cls, drawing: str, caption: str) -> Plot:
        plot = super().__new__(cls, drawing)
        plot.caption = caption
        vars(plot).update(vars(drawing))
        return plot

    def to_plotly(self) -> Any:
        """The figure as a Figure of plotly, which can be zoomed and read off.

        Raises:
            InputError: plotly is not installed.
        """
        return convert_figure(self.figure)

    def write(self, path: str | Path) -> None:
        """Write the figure: .svg as a page shows it; .png, .pdf and what else matplotlib writes; .html by plotly.

        Raises:
            InputError: a path that cannot be written, a format that matplotlib does not know, or no plotly for .html.
        """
        if Path(path).suffix == ".html":
            write_text(path, self.to_plotly().to_html(include_plotlyjs=True), "path")
        else:
            save_drawing(self, Path(path), "path")

    def _repr_svg_(self) -> str:
        return str(self)

    def __repr__(self) -> str:
        return f"<Plot: {shorten(self.caption, 90, placeholder=' ..')}>"


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What an analysis found: a verdict in a word and in a sentence, tables, figures, and the JSON answer."""

    report: Report = field(repr=False)

    @property
    def verdict(self) -> str:
        """The verdict word, as in the JSON answer."""
        return self.report.verdict

    @property
    def sentence(self) -> str:
        """The verdict in plain English."""
        return self.report.sentence

    @property
    def figures(self) -> tuple[str, ...]:
        """Titles of the figures that `plot` can draw."""
        return tuple(title for title, _ in self._list_figures())

    def plot(self, title: str | None = None) -> Plot:
        """Draw a figure of the page; by default the first that has something to show.

        Raises:
            InputError: a title that is not one of `figures`, or a figure that this trace leaves empty.
        """
        figures = self._list_figures()
        matches = [figure for figure_title, figure in figures if title in (None, figure_title)]
        if not matches:
            known_titles = f"one of {', '.join(self.figures)}" if figures else "a result with figures"
            raise InputError("plot", title or "", known_titles)
        for figure in matches:
            if svg := figure.draw():
                return Plot(svg, figure.caption)
        raise InputError("plot", title or "", "a figure for which the trace has data")

    def _list_figures(self) -> list[tuple[str, Figure]]:
        """(title, figure) in the order of the page; a second figure of a section is numbered."""
        return [(section.title if number == 1 else f"{section.title} {number}", figure)
                for section, items in self.report.select_sections(Medium.PAGE)
                for number, figure in enumerate((item for item in items if isinstance(item, Figure)), 1)]

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer as plain values: SI units, None for NaN and infinity."""
        return dict(to_plain(self.report.data))

    def to_html(self) -> str:
        """The page as text; it needs no network."""
        return render_html(self.report)

    def write_html(self, path: str | Path) -> None:
        """Write the page.

        Raises:
            InputError: a path that cannot be written.
        """
        write_text(path, self.to_html(), "path")

    def to_text(self, width: int = 100) -> str:
        """The report as the terminal shows it, without colours; `width` in characters."""
        return fdi.report.format_report(self.report, width)

    def __str__(self) -> str:
        return self.to_text()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.verdict}: {shorten(self.sentence, 90, placeholder=' ..')}>"

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{html.escape(self.to_html())}" style="width: 100%; height: 720px; border: 0"></iframe>'


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonResult(Result):
    """A model compared with a trace; `comparison` holds every number, as numpy columns where it has many."""

    comparison: Comparison = field(repr=False)


@dataclass(frozen=True, eq=False, repr=False)
class ExplanationResult(Result):
    """Which effect is missing from a model."""

    answer: Answer = field(repr=False)

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that explain the residual, or that the data cannot discriminate; () if none does."""
        return self.answer.explanation.effects


@dataclass(frozen=True, eq=False, repr=False)
class ModelResult(Result):
    """A model with one more effect, fitted to a trace."""

    update: ModelUpdate = field(repr=False)

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.update.model

    @property
    def helps(self) -> bool:
        """Whether the effect explains more than noise."""
        return bool(self.update.helps)

    def write_model(self, path: str | Path) -> None:
        """Write the model file, with intervals and provenance; a file that was there before gets the suffix .bak.

        Raises:
            InputError: a path that cannot be written.
        """
        from fdi.discovery.update_model import write_model_file

        write_model_file(self.update, path)


@dataclass(frozen=True, eq=False, repr=False)
class IdentificationResult(Result):
    """The parameters of an actuator, from its runs."""

    identification: Identification = field(repr=False)

    @property
    def model(self) -> Model:
        """The identified model."""
        return self.identification.model

    def write_model(self, path: str | Path) -> None:
        """Write the model file, with intervals and provenance; a file that was there before gets the suffix .bak.

        Raises:
            InputError: a path that cannot be written.
        """
        from fdi.identification.identify import write_identified_model

        write_identified_model(self.identification, path, "fdi.identify")


@dataclass(frozen=True, eq=False, repr=False)
class DiagnosisResult(Result):
    """Levels and sizes of the two faults of a servovalve."""

    diagnosis: Diagnosis = field(repr=False)


def read_trace(path: str | Path, model: ModelOrPath = "eha", *, trust: bool = False) -> Trace:
    """Read a trace: trace.mcap, the folder of a run, or a CSV with t and the signals of the model's plant in SI units.

    Raises:
        InputError: a file that cannot be read, naming its line or field.
    """
    return Trace.read(path, signals=_load_model(model, trust).kind.signals)


def compare(trace: TraceOrPath, model: ModelOrPath = "eha", *, repeats: Sequence[TraceOrPath] = (),
            signals: Sequence[str] | None = None, trust: bool = False) -> ComparisonResult:
    """Compare a model with a trace: how large the error is beside the noise floor, where, when and in which block.

    Args:
        trace: the measured run, or its file.
        model: a `Model`, a model file, or the name of a nominal plant.
        repeats: runs of the same command; they measure the noise floor.
        signals: names of outputs of the plant; default: all that the trace has.
        trust: whether effect files that a model file names may run; each is listed first, with its SHA-256.

    Raises:
        InputError: a trace, a model or a signal that cannot be used.
    """
    from fdi.comparison.compare import compare as compare_trace

    own_model = _load_model(model, trust)
    run = _load_trace(trace, own_model)
    comparison = compare_trace(run, own_model, [_load_trace(r, own_model) for r in repeats], signals,
                               source=run.provenance.get("source", "trace"))
    return ComparisonResult(fdi.report.build_comparison_report(comparison), comparison)


def explain(trace: TraceOrPath, model: ModelOrPath = "eha", *, repeats: Sequence[TraceOrPath] = (),
            holdout: TraceOrPath | None = None, signals: Sequence[str] | None = None, seed: int = 0,
            effect_file: str | Path | None = None, trust: bool = False) -> ExplanationResult:
    """Find the physical effect that a model lacks.

    Args:
        trace: the measured run, or its file.
        model: a `Model`, a model file, or the name of a nominal plant.
        repeats: runs of the same command; they discriminate noise from physics.
        holdout: a run of another command that no fit sees; it reveals overfitting.
        signals: names of outputs of the plant; default: all that the trace has.
        seed: of the simulated runs behind the p-values.
        effect_file: where to write the shape of the residual as an effect to edit.
        trust: whether effect files that a model file names may run; each is listed first, with its SHA-256.

    Raises:
        InputError: a trace, a model or a signal that cannot be used.
    """
    from fdi.discovery.explain_runs import explain_runs

    own_model = _load_model(model, trust)
    runs = _collect_runs(own_model, trace, repeats, holdout, signals)
    answer, pattern = explain_runs(runs, seed, effect_file)
    return ExplanationResult(fdi.report.build_explanation_report(
        answer, runs.sources[0].file, own_model.name, runs.sources, pattern=pattern, notes=runs.notes), answer)


def add_effect(effect: str | Sequence[str], trace: TraceOrPath, model: ModelOrPath = "eha", *,
               repeats: Sequence[TraceOrPath] = (), holdout: TraceOrPath | None = None,
               signals: Sequence[str] | None = None, trust: bool = False) -> ModelResult:
    """Add an effect, or several in this order, to a model and fit everything; the file of a model keeps its ledger.

    Args:
        effect: a name of the catalogue, or several.
        trace: the measured run to fit, or its file.
        model: a `Model`, a model file, or the name of a nominal plant.
        repeats: runs of the same command, which are fitted as well.
        holdout: a run of another command that no fit sees.
        signals: names of outputs of the plant; default: all that the trace has.
        trust: whether effect files that a model file names may run; each is listed first, with its SHA-256.

    Raises:
        InputError: an effect that this model cannot take, or runs that cannot be used.
    """
    from fdi.discovery.update_model import add_effects, remove_all_effects

    effects = [effect] if isinstance(effect, str) else list(effect)
    own_model, provenance = _load_model_file(model, trust)
    runs = _collect_runs(remove_all_effects(own_model, provenance), trace, repeats, holdout, signals)
    update = add_effects(effects, runs, own_model, provenance, f"fdi.add_effect({', '.join(map(repr, effects))})")
    return ModelResult(fdi.report.build_model_report(update), update)


def identify(runs: TraceOrPath | Sequence[TraceOrPath], model: ModelOrPath = "eha", *,
             holdouts: Sequence[TraceOrPath] = (), signals: Sequence[str] | None = None,
             free: Mapping[str, Any] | None = None, seed: int = 0, trust: bool = False) -> IdentificationResult:
    """Find the parameters of an actuator from its runs.

    Args:
        runs: measured runs of any commands, or their files.
        model: with the values of the data sheet: a `Model`, a model file, or the name of a nominal plant.
        holdouts: runs that no fit sees.
        signals: names of outputs of the plant; default: all that every run has.
        free: what is free, as the table [identify] of a model file: {"jack": {"area": 4.0}}; default: what the model
            file, or that of the nominal model, says.
        seed: of the scattered starts.
        trust: whether effect files that a model file names may run; each is listed first, with its SHA-256.

    Raises:
        InputError: runs, a model, a signal or a range that cannot be used.
    """
    from fdi.identification.identify import (
        identify_model,
        parse_free_parameters,
        read_free_parameters,
        read_identification_runs,
    )

    own_model = _load_model(model, trust)
    source = None if isinstance(model, Model) else model
    ranges = read_free_parameters(own_model, source) if free is None else parse_free_parameters(free, own_model, "free")
    fitted_runs = [runs] if isinstance(runs, Trace | str | Path) else runs
    own_runs = read_identification_runs(own_model, ranges, [_pass_run(r) for r in fitted_runs],
                                        [_pass_run(r) for r in holdouts], signals)
    identification = identify_model(own_runs.model, ranges, own_runs.fitted, own_runs.held_out, own_runs.sources, seed)
    return IdentificationResult(fdi.report.build_identification_report(identification, own_model.name), identification)


def diagnose(trace: TraceOrPath, model: ModelOrPath = "eha", *, bands: str | Path | None = None,
             faults: str | Path | None = None, trust: bool = False) -> DiagnosisResult:
    """Judge faults: levels, sizes with 95 % intervals, other deviations.

    Args:
        trace: a run of any command, or its file.
        model: the healthy unit: a `Model`, a model file, or "eha".
        bands: a file of `rig fdi --learn-bands`; default: the bands that come with the software.
        faults: a fault file, or a shipped list; default: those of the plant file, or clogging and spool friction.
        trust: whether effect files that a model file names may run; each is listed first, with its SHA-256.

    Raises:
        InputError: a trace, a model or bands that cannot be used.
    """
    from fdi.diagnosis.bands import load_bands
    from fdi.diagnosis.diagnosis import diagnose as diagnose_trace
    from fdi.diagnosis.faults import choose_faults

    own_model = _load_model(model, trust)
    known_bands = None if bands is None else load_bands(bands, own_model.kind)
    run = _load_trace(trace, own_model)
    diagnosis = diagnose_trace(run, own_model, known_bands, source=run.provenance.get("source", "trace"),
                               faults=choose_faults(faults, own_model.kind))
    return DiagnosisResult(fdi.report.build_diagnosis_report(diagnosis), diagnosis)


def _load_trace(trace: TraceOrPath, model: Model) -> Trace:
    """A trace of the plant of `model`; one that was read gets the name of its file, so that messages can say it."""
    if isinstance(trace, Trace):
        return trace
    run = Trace.read(trace, signals=model.kind.signals)
    return replace(run, provenance={**run.provenance, "source": str(trace)})


def _load_model(model: ModelOrPath, trust: bool) -> Model:
    if isinstance(model, Model):
        return model
    load_plant_of_model(model, is_trusted=trust)
    load_effects_of_model(model, is_trusted=trust)
    return load_model(model)


def _load_model_file(model: ModelOrPath, trust: bool) -> tuple[Model, Provenance]:
    """A model and where it comes from, which only a model file knows."""
    from fdi.discovery.update_model import Provenance, load_model_file

    if not isinstance(model, Model) and Path(model).suffix != ".py" and Path(model).is_file():
        load_plant_of_model(model, is_trusted=trust)
        load_effects_of_model(model, is_trusted=trust)
        return load_model_file(Path(model))
    return _load_model(model, trust), Provenance()


def _collect_runs(model: Model, trace: TraceOrPath, repeats: Sequence[TraceOrPath], holdout: TraceOrPath | None,
                  signals: Sequence[str] | None) -> Runs:
    from fdi.discovery.runs import read_runs

    unseen = None if holdout is None else _pass_run(holdout)
    return read_runs(model, _pass_run(trace), [_pass_run(r) for r in repeats], unseen, signals)


def _pass_run(run: TraceOrPath) -> Trace | str:
    """A run as analyses of several take it: a file is not read yet, for its hash is to be known by the commands."""
    return run if isinstance(run, Trace) else str(run)
