"""Data is not code: what a log or a model file brings along runs only with --trust, and after it was listed."""

import hashlib
from pathlib import Path

import pytest
from changed_logs import change_log
from effect_files import HEAD
from refusals import catch_refusal
from rig_command import SHORT, job, play, refuse, rig

import fdi
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE

CODE = (HEAD + '''
class Spring(NamedTuple):
    stiffness: Annotated[float, Quantity("N/m")] = 0.0

@effect("load", Spring, law="FR = FR + K XJ")
def spring(x, s, u, p):
    return x + p.spring.stiffness * s.jack_position

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


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test works in its own folder."""
    monkeypatch.chdir(tmp_path)


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
    said = rig("run", "--from", "sent.mcap", "--trust", "--json", "--out", "out")
    assert (said.status, RAN.read_text(), said.json["verdict"]) == (0, "ran ", "PASS")  # one object, without the list
    assert said.err.count("\n") == 1 and DIGEST in said.err and "sent.mcap" in said.err


def test_the_list_comes_before_the_code_runs(log: Path) -> None:
    change_log(log, Path("sent.mcap"), {"effects/bad.py": b"raise SystemError('it ran')"})
    said = rig("run", "--from", "sent.mcap", "--trust", "--out", "out")
    first, second = said.err.splitlines()
    assert said.status == 2 and "trusted code: effects/bad.py, 27 bytes" in first and "it ran" in second


def test_code_of_a_model_file_runs_only_with_trust(model: Path, trace: Path) -> None:
    for words in (["simulate", "--out", "x.csv"], ["compare", trace], ["explain", trace], ["fdi", trace],
                  ["add", "null_bias", trace], ["remove", "spring"], ["trend", "."], ["run", "short.toml"],
                  ["fdi", "--learn-bands", "--out", "b.toml"], ["node", "plant", "--bus", "udp_multicast"]):
        line = refuse(*words, "--model", model)
        assert "--trust" in line and "spring.py" in line and DIGEST in line and not RAN.exists(), words
    said = rig("simulate", "--out", "x.csv", "--model", model, "--trust", "--json")
    assert said.status == 0 and said.json["cycles"] and RAN.read_text() == "ran " and DIGEST in said.err


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
    said = rig("simulate", "--model", model, "--effects", "spring.py", "--out", "x.csv")
    assert (said.status, said.err, RAN.read_text()) == (0, "", "ran ")


def test_the_next_command_keeps_the_trust(model: Path, trace: Path) -> None:
    said = rig("compare", trace, "--model", model, "--trust")
    assert said.status == 1 and "rig explain" in said.out and "--trust" in said.out, said


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


def test_a_log_does_not_choose_the_bus(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    change_log(log, Path("sent.mcap"), settings={"bus": "udp_multicast:239.77.7.7"})
    monkeypatch.setenv("EHA_RIG_BUS", "udp_multicast:239.77.7.8")
    assert "--bus udp_multicast:239.77.7.7" in refuse("run", "--from", "sent.mcap", "--out", "out")
    for words in (["sent.mcap", "--bus", "embedded"], [log]):  # embedded before, embedded now
        said = rig("run", "--from", *words, "--json", "--out", "out")
        assert said.status == 0 and said.json["run"]["bus"] == "embedded", said


def test_texts_of_a_log_do_not_command_the_terminal(log: Path) -> None:
    change_log(log, Path("sent.mcap"), settings={"bus": "\x1b[2J", "host": "\x1b]0;title\x07"})
    assert rig("report", "sent.mcap", "--out", "p.html").status == 0
    assert "\x1b" not in Path("p.html").read_text() and "\\x1b[2J" in Path("p.html").read_text()
