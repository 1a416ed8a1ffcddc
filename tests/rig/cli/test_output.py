"""Results are whole or absent, nothing that was there is lost; code in a log or model file runs only with --trust."""

import hashlib
import importlib.util
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from changed_logs import change_log
from effect_files import SPRING
from refusals import catch_refusal
from rig_command import SHORT, answer, job, play, refuse, rig
from synthetic_run import record_run

import fdi
from fdi.output import replace_text, write_text, write_whole
from fdi.trace import Trace
from plant.effects import CATALOGUE
from rig.recorder.convert import RAW_SUFFIXES

pytestmark = pytest.mark.usefixtures("here")
HEADER = "t,com,xj,cor\n"
COMMANDS = {  # name -> words, of what suffix the result is
    "view": (["view", "{log}", "--out", "{out}"], ".rrd"),
    "view, a picture": (["view", "{log}", "--out", "{out}"], ".png"),
    "report": (["report", "{log}", "--out", "{out}"], ".html"),
    "export csv": (["export", "{log}", "--out", "{out}"], ".csv"),
    "export csv.gz": (["export", "{log}", "--out", "{out}"], ".csv.gz"),
    **{f"export {suffix}": (["export", "{log}", "--out", "{out}"], suffix) for suffix in RAW_SUFFIXES},
    "import csv": (["import", "{csv}", "--out", "{out}"], ".mcap"),
    "import frames": (["import", "{can}", "--out", "{out}"], ".mcap"),
    "recover": (["recover", "{log}", "--out", "{out}"], ".mcap"),
    "simulate mcap": (["simulate", "--command", "{command}", "--out", "{out}"], ".mcap"),
    "simulate csv": (["simulate", "--command", "{command}", "--out", "{out}"], ".csv"),
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("sources")
    files = {"log": record_run(folder / "trace.mcap", stop=400), "csv": folder / "x.csv", "can": folder / "x.log",
             "command": folder / "command.csv"}
    files["csv"].write_text(HEADER + "0,0,0,0\n0.001,0,0,0\n")
    files["can"].write_text("(0.000000) can0 080#\n(0.001000) can0 080#\n")
    files["command"].write_text("t,com\n0,0\n0.001,0\n0.002,0\n")
    return files


def _refused(words: list[str], sources: dict[str, Path], out: Path) -> str:
    if words[0] == "view" and importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun")
    before = {path: path.read_bytes() for path in sources.values()}
    line = refuse(*(word.format(out=out, **sources) for word in words))
    assert line.startswith(f"rig {words[0]}: ") and {path: path.read_bytes() for path in before} == before
    return line


@pytest.mark.parametrize("place", ["proc", "no folder", "a file as folder", "a folder", "a long name"])
@pytest.mark.parametrize("command", COMMANDS)
def test_impossible_places(sources: dict[str, Path], tmp_path: Path, command: str, place: str) -> None:
    words, suffix = COMMANDS[command]
    (tmp_path / "file").write_text("precious")
    (tmp_path / f"folder{suffix}").mkdir()
    out = {"proc": Path(f"/proc/x{suffix}"), "no folder": tmp_path / "none" / f"x{suffix}",
           "a file as folder": tmp_path / "file" / f"x{suffix}", "a folder": tmp_path / f"folder{suffix}",
           "a long name": tmp_path / f"{'x' * 300}{suffix}"}[place]
    error = _refused(words, sources, out)
    assert "expected a place that can be written" in error and str(out.with_suffix("")) in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", f"folder{suffix}"]
    assert (tmp_path / "file").read_text() == "precious"


@pytest.mark.parametrize(("words", "out"), [
    (["report", "{log}", "--out", "{out}"], "log"), (["report", "{csv}", "--out", "{out}"], "csv"),
    (["export", "{csv}", "--out", "{out}"], "csv"), (["recover", "{log}", "--out", "{out}"], "log"),
    (["simulate", "--command", "{command}", "--out", "{out}"], "command")])
def test_the_source_is_not_written_over(sources: dict[str, Path], words: list[str], out: str) -> None:
    assert "expected another file than the one that is read" in _refused(words, sources, sources[out])


def test_an_export_without_frames_leaves_what_was_there(sources: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "old.blf").write_text("precious")
    assert rig("import", sources["csv"], "--out", tmp_path / "signals.mcap").status == 0
    assert rig("export", tmp_path / "signals.mcap", "--out", tmp_path / "old.blf").status == 2
    assert (tmp_path / "old.blf").read_text() == "precious"


SMALLEST = 4096  # bytes that a file may have, as on a disk that is full then


@pytest.mark.parametrize("name", ["run.csv", "run.mcap", "frames.asc", "saved.mcap"])
def test_a_full_disk_leaves_what_was_there_and_no_part(tmp_path: Path, name: str) -> None:
    record_run(tmp_path / "trace.mcap", stop=3000)
    Trace.read(tmp_path / "trace.mcap").write_csv(tmp_path / "in.csv")
    out = tmp_path / "out"
    out.mkdir()
    words = ["import", f"{tmp_path}/in.csv"] if name == "run.mcap" else [
        "recover" if name == "saved.mcap" else "export", f"{tmp_path}/trace.mcap"]
    words += ["--force", "--out", str(out / name)]
    for before in ({}, {name: b"before"}):
        for file, content in before.items():
            (out / file).write_bytes(content)
        result = subprocess.run([sys.executable, "-B", "-m", "rig.cli.main", *words], capture_output=True, text=True,
                                preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (SMALLEST, SMALLEST)))
        assert (result.returncode, result.stderr.count("\n"), name in result.stderr) == (2, 1, True), result
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_commands_do_not_replace_a_file_unasked(sources: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "s.csv"
    simulate = ["simulate", "--command", sources["command"], "--steps", "10", "--out", out, "--quiet"]
    assert rig(*simulate).status == 0
    first = out.read_bytes()
    assert "--force" in refuse(*simulate, "--seed", "1") and out.read_bytes() == first
    assert rig(*simulate, "--seed", "1", "--force").status == 0 and out.read_bytes() != first
    assert [rig(command, source, "--out", tmp_path / name, *force).status
            for command, source, name in (("export", out, "e.csv"), ("recover", sources["log"], "r.mcap"),
                                          ("import", out, "i.mcap"))
            for force in ((), (), ("--force",))] == [0, 2, 0] * 3


def test_a_failure_in_the_middle_leaves_the_file_before(tmp_path: Path) -> None:
    place = tmp_path / f"{'a' * 251}.txt"  # the longest name that a file may have
    write_text(place, "before")
    place.chmod(0o640)
    with pytest.raises(ZeroDivisionError), write_whole(place) as part, write_whole(tmp_path / "folder") as folder:
        part.write_text("half")
        folder.mkdir()
        raise ZeroDivisionError
    assert place.read_text() == "before" and list(tmp_path.iterdir()) == [place]
    write_text(place, "after")
    assert place.read_text() == "after" and place.stat().st_mode & 0o777 == 0o640


def test_a_replaced_file_is_kept_in_whatever_encoding_it_is(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"# M\xfcller")
    assert replace_text(tmp_path / "a.toml", "new") == tmp_path / "a.toml.bak" and {
        path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a.toml": b"new", "a.toml.bak": b"# M\xfcller"}


def test_links_and_devices_are_written_through(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    write_text(tmp_path / "link.txt", "text")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "text"
    write_text("/dev/null", "text")
    assert "can be written" in catch_refusal(write_text, tmp_path / "no" / "a.txt", "text")


@pytest.mark.parametrize("period", [0.0005, 0.001, 0.002])
def test_a_ramp_and_a_step_keep_their_seconds(period: float, tmp_path: Path) -> None:
    """A ramp of 5 mm/s for 0.3 s, then a step of 1 mm, and a load that comes with it."""
    t = np.arange(501) / 1000
    com, load = np.where(t < 0.3, 5e-3 * t, 2.5e-3), np.where(t < 0.3, 0.0, 2e3)
    rows = "\n".join(f"{a:.4f},{b!r},{c!r}" for a, b, c in zip(t, com.tolist(), load.tolist(), strict=True))
    (tmp_path / "c.csv").write_text(f"t,com,load\n{rows}\n")
    answer("simulate", "--command", tmp_path / "c.csv", f"--set=controller.period={period}", "--out",
           tmp_path / "s.csv")
    run = np.genfromtxt(tmp_path / "s.csv", delimiter=",", names=True)
    assert run["t"][-1] == pytest.approx(0.5, abs=0.001) and np.diff(run["t"]) == pytest.approx(period)
    row = np.floor(run["t"] * 1000 + 1e-6).astype(int)
    assert (run["com"] == com[row]).all() and (run["load"] == load[row]).all()
    late = run["t"] > 0.1
    speed = np.polyfit(run["t"][late & (run["t"] < 0.3)], run["xj"][late & (run["t"] < 0.3)], 1)[0]
    assert (speed, run["xj"][-1]) == (pytest.approx(5e-3, rel=0.02), pytest.approx(2.5e-3, abs=50e-6))


CODE = (SPRING + '''
with open("ran", "a") as out:
    out.write("ran ")
''').encode()
DIGEST = hashlib.sha256(CODE).hexdigest()
RAN = Path("ran")  # what the effect writes when it runs


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a short run without effects; not to be written to."""
    folder = tmp_path_factory.mktemp("log")
    play(job(seed=3), folder)
    return folder / "trace.mcap"


@pytest.fixture
def model() -> Path:
    """A model file that names an effect file beside it, and a short sequence."""
    Path("spring.py").write_bytes(CODE)
    Path("m.toml").write_text('effects = ["spring"]\n[spring]\nstiffness = 1e5\n'
                              '[provenance]\neffect_files = ["spring.py"]\n')
    Path("short.toml").write_text(SHORT)
    return Path("m.toml")


@pytest.fixture
def trace() -> Path:
    assert rig("simulate", "--out", "t.csv", "--quiet").status == 0
    return Path("t.csv")


def test_code_in_a_log_runs_only_with_trust(log: Path) -> None:
    change_log(log, Path("sent.mcap"), {"effects/spring.py": CODE})
    line = refuse("run", "--from", "sent.mcap", "--json", "--out", "out")
    assert all(word in line for word in ("--trust", "effects/spring.py", "sent.mcap", DIGEST)) and not RAN.exists()
    result = rig("run", "--from", "sent.mcap", "--trust", "--json", "--out", "out")
    # one object, without the list
    assert (result.status, RAN.read_text(), result.json["verdict"]) == (0, "ran ", "PASS")
    assert result.err.count("\n") == 1 and DIGEST in result.err and "sent.mcap" in result.err


def test_the_list_comes_before_the_code_runs(log: Path) -> None:
    change_log(log, Path("sent.mcap"), {"effects/bad.py": b"raise SystemError('it ran')"})
    result = rig("run", "--from", "sent.mcap", "--trust", "--out", "out")
    first, second = result.err.splitlines()
    assert result.status == 2 and "trusted code: effects/bad.py, 27 bytes" in first and "it ran" in second


def test_code_of_a_model_file_runs_only_with_trust(model: Path, trace: Path) -> None:
    for words in (["simulate", "--out", "x.csv"], ["compare", trace], ["explain", trace], ["fdi", trace],
                  ["add", "null_bias", trace], ["remove", "spring"], ["trend", "."], ["run", "short.toml"],
                  ["fdi", "--learn-bands", "--out", "b.toml"], ["node", "plant", "--bus", "udp_multicast"]):
        line = refuse(*words, "--model", model)
        assert "--trust" in line and "spring.py" in line and DIGEST in line and not RAN.exists(), words
    result = rig("simulate", "--out", "x.csv", "--model", model, "--trust", "--json")
    assert result.status == 0 and result.json["cycles"] and RAN.read_text() == "ran " and DIGEST in result.err


@pytest.mark.parametrize("words", [["named.toml"], ["short.toml", "--model", "m.toml"]], ids=["sequence", "command"])
def test_a_run_on_a_model_with_code_can_be_repeated(words: list[str], model: Path) -> None:
    """Whether the command line names the model or the sequence does."""
    Path("named.toml").write_text(SHORT + '[model]\nname = "m.toml"\n')
    assert "--trust" in refuse("run", *words, "--out", "run")
    assert rig("run", *words, "--trust", "--quiet", "--out", "run").status == 0
    trace = Trace.read("run")
    del CATALOGUE["spring"]
    assert rig("run", "--from", "run", "--trust", "--quiet", "--out", "again").status == 0
    assert "effects/spring.py" in trace.attachments and (Trace.read("again").xj == trace.xj).all()


def test_a_file_that_the_user_names_is_trusted(model: Path) -> None:
    """--effects replaces the file of the same name that the model names."""
    result = rig("simulate", "--model", model, "--effects", "spring.py", "--out", "x.csv")
    assert (result.status, result.err, RAN.read_text()) == (0, "", "ran ")


def test_the_next_command_keeps_the_trust(model: Path, trace: Path) -> None:
    result = rig("compare", trace, "--model", model, "--trust")
    assert result.status == 1 and "rig explain" in result.out and "--trust" in result.out, result


def test_the_python_interface_asks_for_trust_too(model: Path, trace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--trust" in catch_refusal(fdi.compare, trace, model) and not RAN.exists()
    fdi.compare(trace, model, trust=True)
    assert RAN.exists() and DIGEST in capsys.readouterr().err
    fdi.compare(trace, model)  # loaded already: nothing runs again
    assert RAN.read_text() == "ran "


@pytest.mark.parametrize(("attachments", "settings", "says"), [
    *(({name: CODE}, {}, "") for name in (
        "effects/..", "effects/", "effects/a/b.py", "effects/../x.py", "effects/a\0.py", "effects/" + "a" * 400 + ".py",
        "effects/.hidden.py", "effects/a\x1b[2J.py", "sequence/a\0.toml", "sequence/" + "a" * 400 + ".toml",
        "sequence/...toml")),
    *(({name: b"name = '\xff'"}, {}, "UTF-8") for name in ("model.toml", "sequence/short.toml")),
    *(({}, {key: value}, key) for key, value in (
        ("seed", "zz"), ("seed", "-1"), ("seed", "9" * 5000), ("pace", "warp"), ("controller", "alien"),
        ("plant", "alien"), ("max_overruns", "nan"), ("max_overruns", "1e9"), ("max_overruns", "-1"), ("period", "nan"),
        ("period", "-1"), ("bus", "no such bus"), ("bus", ""), ("bus", "\x1b[2J")))])
def test_names_texts_and_settings_of_a_log_are_checked(log: Path, attachments: dict[str, bytes],
                                                       settings: dict[str, str], says: str) -> None:
    """Names of attachments are names of files, texts are UTF-8; the line about it does not command the terminal."""
    change_log(log, Path("sent.mcap"), attachments, settings)
    line = refuse("run", "--from", "sent.mcap", "--trust", "--out", "out")
    assert says in line and line[:-1].isprintable() and len(line) < 500
    assert [path.name for path in Path().iterdir()] == ["sent.mcap"]


@pytest.mark.parametrize("words", [["sent.mcap", "--bus", "embedded"], ["{log}"]])  # asked for, and as it was
def test_a_log_does_not_choose_the_bus(words: list[str], log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    change_log(log, Path("sent.mcap"), settings={"bus": "udp_multicast:239.77.7.7"})
    change_log(log, Path("device.mcap"), settings={"bus": "udp_multicast:239.77.7.7", "controller": "external"})
    monkeypatch.setenv("EHA_RIG_BUS", "udp_multicast:239.77.7.8")
    for name, offer in (("sent.mcap", ", or --bus embedded: "), ("device.mcap", ": ")):
        assert f"--bus udp_multicast:239.77.7.7 to use it again{offer}" in refuse("run", "--from", name)
    result = rig("run", "--from", *(word.format(log=log) for word in words), "--json", "--out", "out")
    assert result.status == 0 and result.json["run"]["bus"] == "embedded", result


def test_texts_of_a_log_do_not_command_the_terminal(log: Path) -> None:
    change_log(log, Path("sent.mcap"), settings={"bus": "\x1b[2J", "host": "\x1b]0;title\x07"})
    assert rig("report", "sent.mcap", "--out", "p.html").status == 0
    assert "\x1b" not in Path("p.html").read_text() and "\\x1b[2J" in Path("p.html").read_text()
