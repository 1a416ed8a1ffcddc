"""Data is not code: what a log or a model file brings along runs only with --trust, and after it was listed."""
from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from changed_logs import change_log
from effect_files import HEAD, restored_catalogue
from rig_command import rig
from short_sequences import SHORT, job, play

import fdi
from fdi.trace.trace import Trace
from plant import InputError
from plant.effects import CATALOGUE

EFFECT = HEAD + '''
class Spring(NamedTuple):
    stiffness: Annotated[float, Quantity("N/m")] = 0.0

@effect("load", Spring, law="FR = FR + K XJ")
def spring(x, s, u, p):
    return x + p.spring.stiffness * s.jack_position

from pathlib import Path
with Path(r"{ran}").open("a") as out:
    out.write("ran ")
'''


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    with restored_catalogue():
        yield


@pytest.fixture
def ran(tmp_path: Path) -> Path:
    """The file that the effect writes when it runs."""
    return tmp_path / "ran"


@pytest.fixture
def code(ran: Path) -> bytes:
    return EFFECT.replace("{ran}", str(ran)).encode()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """The log of a short run without effects."""
    play(job(seed=3), tmp_path / "run")
    return tmp_path / "run" / "trace.mcap"


@pytest.fixture
def model(tmp_path: Path, code: bytes) -> Path:
    """A model file that names an effect file beside it, in a folder with a short trace."""
    (tmp_path / "spring.py").write_bytes(code)
    path = tmp_path / "m.toml"
    path.write_text('effects = ["spring"]\n[spring]\nstiffness = 1e5\n[provenance]\neffect_files = ["spring.py"]\n')
    return path


def test_code_in_a_log_runs_only_with_trust(log: Path, code: bytes, ran: Path, tmp_path: Path) -> None:
    sent = change_log(log, tmp_path / "sent.mcap", {"effects/spring.py": code})
    said = rig("run", "--from", sent, "--json", "--out", tmp_path / "out")
    assert said.status == 2 and said.err.count("\n") == 1 and not said.out and not ran.exists(), said
    for word in ("--trust", "effects/spring.py", str(sent), hashlib.sha256(code).hexdigest()):
        assert word in said.err
    said = rig("run", "--from", sent, "--trust", "--json", "--out", tmp_path / "out")
    assert said.status == 0 and ran.read_text() == "ran ", said
    assert said.json["verdict"] == "PASS"  # one object, and the list is not in it
    assert said.err.count("\n") == 1 and hashlib.sha256(code).hexdigest() in said.err and str(sent) in said.err


def test_the_list_comes_before_the_code_runs(log: Path, tmp_path: Path) -> None:
    sent = change_log(log, tmp_path / "sent.mcap", {"effects/bad.py": b"raise SystemError('it ran')"})
    said = rig("run", "--from", sent, "--trust", "--out", tmp_path / "out")
    first, second = said.err.splitlines()
    assert said.status == 2 and "trusted code: effects/bad.py, 27 bytes" in first and "it ran" in second


def test_code_of_a_model_file_runs_only_with_trust(model: Path, code: bytes, ran: Path, tmp_path: Path) -> None:
    trace = tmp_path / "t.csv"
    assert rig("simulate", "--out", trace, "--quiet").status == 0
    short = tmp_path / "short.toml"
    short.write_text(SHORT)
    for words in (["simulate", "--out", tmp_path / "x.csv"], ["compare", trace], ["explain", trace], ["fdi", trace],
                  ["add", "null_bias", trace], ["remove", "spring"], ["trend", tmp_path], ["run", short],
                  ["fdi", "--learn-bands", "--out", tmp_path / "b.toml"], ["node", "plant", "--bus", "udp_multicast"]):
        said = rig(*words, "--model", model)
        assert said.status == 2 and said.err.count("\n") == 1 and not ran.exists(), (words, said)
        assert "--trust" in said.err and "spring.py" in said.err and hashlib.sha256(code).hexdigest() in said.err
    said = rig("simulate", "--out", tmp_path / "x.csv", "--model", model, "--trust", "--json")
    assert said.status == 0 and said.json["cycles"] and ran.read_text() == "ran "
    assert hashlib.sha256(code).hexdigest() in said.err


def test_a_run_on_a_model_with_code_can_be_repeated(model: Path, ran: Path, tmp_path: Path) -> None:
    """Whether the command line names the model or the sequence does."""
    (tmp_path / "named.toml").write_text(SHORT + f'[model]\nname = "{model}"\n')
    (tmp_path / "short.toml").write_text(SHORT)
    for name, words in (("named", []), ("short", ["--model", model])):
        said = rig("run", tmp_path / f"{name}.toml", *words, "--out", tmp_path / name)
        assert said.status == 2 and "--trust" in said.err, said
        said = rig("run", tmp_path / f"{name}.toml", *words, "--trust", "--quiet", "--out", tmp_path / name)
        assert said.status == 0, said
        trace = Trace.read(tmp_path / name)
        assert "effects/spring.py" in trace.attachments
        ran.unlink()
        del CATALOGUE["spring"]
        said = rig("run", "--from", tmp_path / name, "--trust", "--quiet", "--out", tmp_path / "again")
        del CATALOGUE["spring"]
        assert said.status == 0 and (Trace.read(tmp_path / "again").xj == trace.xj).all()


def test_a_file_that_the_user_names_is_trusted(model: Path, ran: Path, tmp_path: Path) -> None:
    """--effects replaces the file of the same name that the model names."""
    said = rig("simulate", "--model", model, "--effects", tmp_path / "spring.py", "--out", tmp_path / "x.csv")
    assert said.status == 0 and not said.err and ran.read_text() == "ran "


def test_the_next_command_keeps_the_trust(model: Path, tmp_path: Path) -> None:
    assert rig("simulate", "--out", tmp_path / "t.csv", "--quiet").status == 0
    said = rig("compare", tmp_path / "t.csv", "--model", model, "--trust")
    assert said.status == 1 and "rig explain" in said.out and "--trust" in said.out, said


def test_the_python_interface_asks_for_trust_too(model: Path, code: bytes, ran: Path, tmp_path: Path,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    assert rig("simulate", "--out", tmp_path / "t.csv", "--quiet").status == 0
    with pytest.raises(InputError, match="--trust"):
        fdi.compare(tmp_path / "t.csv", model)
    assert not ran.exists()
    fdi.compare(tmp_path / "t.csv", model, trust=True)
    assert ran.exists() and hashlib.sha256(code).hexdigest() in capsys.readouterr().err
    fdi.compare(tmp_path / "t.csv", model)  # loaded already: nothing runs again
    assert ran.read_text() == "ran "


@pytest.mark.parametrize("name", ["effects/..", "effects/", "effects/a/b.py", "effects/../x.py", "effects/a\0.py",
                                  "effects/" + "a" * 400 + ".py", "effects/.hidden.py", "effects/a\x1b[2J.py",
                                  "sequence/a\0.toml", "sequence/" + "a" * 400 + ".toml", "sequence/...toml"])
def test_names_of_attachments_are_names_of_files(log: Path, name: str, code: bytes, ran: Path, tmp_path: Path) -> None:
    sent = change_log(log, tmp_path / "sent.mcap", {name: code})
    said = rig("run", "--from", sent, "--trust", "--out", tmp_path / "out")
    assert said.status == 2 and said.err.count("\n") == 1 and not ran.exists(), said
    assert said.err[:-1].isprintable() and len(said.err) < 500
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "sent.mcap"]


@pytest.mark.parametrize(("key", "value"), [("seed", "zz"), ("seed", "-1"), ("seed", "9" * 5000), ("pace", "warp"),
                                            ("controller", "alien"), ("plant", "alien"), ("max_overruns", "nan"),
                                            ("max_overruns", "1e9"), ("max_overruns", "-1"), ("period", "nan"),
                                            ("period", "-1"), ("bus", "no such bus"), ("bus", "")])
def test_settings_of_a_log_are_checked(log: Path, key: str, value: str, tmp_path: Path) -> None:
    sent = change_log(log, tmp_path / "sent.mcap", settings={key: value})
    said = rig("run", "--from", sent, "--out", tmp_path / "out")
    assert said.status == 2 and said.err.count("\n") == 1 and key in said.err and len(said.err) < 500, said


def test_texts_in_a_log_are_utf_8(log: Path, tmp_path: Path) -> None:
    for name in ("model.toml", "sequence/short.toml"):
        sent = change_log(log, tmp_path / "sent.mcap", {name: b"name = '\xff'"})
        said = rig("run", "--from", sent, "--out", tmp_path / "out")
        assert said.status == 2 and said.err.count("\n") == 1 and "UTF-8" in said.err, said


def test_a_log_does_not_choose_the_bus(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = change_log(log, tmp_path / "sent.mcap", settings={"bus": "udp_multicast:239.77.7.7"})
    monkeypatch.setenv("EHA_RIG_BUS", "udp_multicast:239.77.7.8")
    said = rig("run", "--from", sent, "--out", tmp_path / "out")
    assert said.status == 2 and said.err.count("\n") == 1 and "--bus udp_multicast:239.77.7.7" in said.err, said
    said = rig("run", "--from", sent, "--bus", "embedded", "--json", "--out", tmp_path / "out")
    assert said.status == 0 and said.json["run"]["bus"] == "embedded", said
    said = rig("run", "--from", log, "--json", "--out", tmp_path / "again")  # embedded before, embedded now
    assert said.status == 0 and said.json["run"]["bus"] == "embedded", said


def test_a_limit_of_overruns_is_a_fraction_beside_from_too(log: Path, tmp_path: Path) -> None:
    said = rig("run", "--from", log, "--max-overruns", "nan", "--out", tmp_path / "out")
    assert said.status == 2 and "--max-overruns" in said.err


def test_texts_of_a_log_do_not_command_the_terminal(log: Path, tmp_path: Path) -> None:
    sent = change_log(log, tmp_path / "sent.mcap", settings={"bus": "\x1b[2J", "host": "\x1b]0;title\x07"})
    page = tmp_path / "p.html"
    said = rig("report", sent, "--out", page)
    assert said.status == 0 and "\x1b" not in page.read_text() and "\\x1b[2J" in page.read_text()
    said = rig("run", "--from", sent, "--out", tmp_path / "out")
    assert said.status == 2 and "\x1b" not in said.err
