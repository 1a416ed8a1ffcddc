"""Runs side by side, and the monitor: the bits of one run after the other, closed forms, and wide registers."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effect_files import MEMORY
from other_cpus import compiles_for
from refusals import catch_refusal

from plant import (
    FAULTS,
    Actuator,
    Lanes,
    Model,
    Monitor,
    Part,
    compile_function,
    interpret_function,
    kernel_use,
    lanes as lanes_module,
    list_kernel_variants,
    list_searched_effects,
    map_together,
    read_sensors,
    show_start,
    simulate,
    step_cycle,
    unpack_state,
)
from plant.effects import CATALOGUE, load_effects
from plant.kernel_use import KernelUse
from plant.lanes import NARROWEST, plan_layout
from plant.solve import pull_plant, rest_at_reading
from rig.sequences import load_sequence

QUIET = Model().replace({f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")})
COMMAND = np.r_[np.zeros(5), np.full(95, 1e-3), np.linspace(1e-3, -2e-3, 200)]
LOAD = np.linspace(0.0, 3e3, len(COMMAND))
CURRENT = np.r_[np.zeros(3), np.full(12, 4e-3), np.full(15, -6e-3), np.linspace(-3e-4, 3e-4, 10)]
FORCE = np.linspace(0.0, 3e3, len(CURRENT))
EFFECTS = [e.name for e in list_searched_effects("eha") if not e.base and not e.disturbance]  # as fits have them


def replay_drive(flat: Any, drive: Any, load: Any, position: Any, anchor: float, record: Any, steps: int,
                 out: Any) -> None:
    """The plant driven by a measured drive; fills out[k] with the readings at sample k, without noise.

    Args:
        flat: state at the start.
        drive: (n,); drive[k - 1] acts from k to k + 1, none before.
        load: (n,) external load.
        position: (n,) measured controlled signal; NaN where missing; or (0,): the run starts as `flat` is.
        anchor: 1/s, how fast the plant is pulled to it.
        record: (1,) parameters of the model.
        steps: steps a cycle.
        out: (n, outputs), written.
    """
    p = record[0]
    s, m = unpack_state(flat, 0)
    s, m = rest_at_reading(s, m, position[0], p, steps) if len(position) else (show_start(s, m, p), m)
    for k in range(len(drive)):
        t = k * p.controller.period
        out[k], m = read_sensors(s, m, np.zeros(out.shape[1] + 1), t, p)
        if len(position):
            s, m = pull_plant(s, m, anchor * p.controller.period, position[k], 0.0, p)
        s, m = step_cycle(s, m, drive[k - 1] if k else 0.0, load[k], 0.0, t, record, steps)


def one_run(model: Model, current: np.ndarray, load: np.ndarray, position: np.ndarray | None = None,
            anchor: float = 0.0, steps: int = 10) -> np.ndarray:
    """The same in plain Python, one run, (n, outputs)."""
    out = np.empty((len(current), len(model.kind.signals.outputs)))
    run = interpret_function(replay_drive, model.kind.bind_functions(model.effects))
    position = np.empty(0) if position is None else position
    run(model.build_flat_state(), current, load, position, anchor, model.build_record(), steps, out)
    return out


def test_closed_loop_is_that_of_simulate() -> None:
    names = ["spool.static_friction", "spool.dynamic_friction", "jack.damping", "controller.integral_gain"]
    values = np.random.default_rng(1).uniform([5, 5, 1e3, 0], [40, 5, 9e3, 2], (19, 4))  # not a whole block
    runs = Lanes(QUIET, names, steps=20).closed_loop(values, COMMAND, LOAD)
    for row in (0, 7, 16, 18):
        one = simulate(QUIET.replace(dict(zip(names, values[row], strict=True))), COMMAND, LOAD, steps=20)
        assert (runs[row] == np.column_stack([one.xj, one.cor, one.p12, one.xs])).all()


def test_replay_is_that_of_the_actuator() -> None:
    runs = Lanes(QUIET, ["jack.mass"], steps=20).replay(np.array([[400.0], [900.0]]), COMMAND, LOAD)
    for mass, rows in zip((400.0, 900.0), runs, strict=True):
        plant = Actuator(QUIET.replace({"jack.mass": mass}), steps=20)
        for k in range(100):
            assert tuple(rows[k]) == plant.sample()
            plant.advance(COMMAND[k - 1] if k else 0.0, LOAD[k])


@pytest.fixture(scope="module")
def catalogue() -> Lanes:
    """The whole catalogue, all parameters of all effects free."""
    return Lanes(QUIET.with_effects(EFFECTS), [name for e in EFFECTS for name in CATALOGUE[e].off], steps=10)


def with_effects(lanes: Lanes, changes: dict[str, float]) -> np.ndarray:
    return np.array([[changes.get(name, lanes.model[name]) for name in lanes.names]])


def start(effect: str, which: int) -> dict[str, float]:
    """Values at which the effect is at work."""
    return dict(CATALOGUE[effect].starts[which])


def test_each_effect_alone_among_all_that_are_off(catalogue: Lanes) -> None:
    """Against one run of a model that has that effect only: the others, at their off values, change no bit."""
    values = np.vstack([with_effects(catalogue, start(effect, -1)) for effect in EFFECTS])
    runs = catalogue.replay(values, CURRENT, FORCE)
    bare = one_run(QUIET, CURRENT, FORCE)
    for effect, rows in zip(EFFECTS, runs, strict=True):
        assert (rows == one_run(QUIET.replace(start(effect, -1)), CURRENT, FORCE)).all(), effect
    assert sum((rows != bare).any() for rows in runs) >= 20  # some cannot show here: no demand, no stop, too slow


def test_runs_go_to_the_kernel_with_the_fewest_effects(catalogue: Lanes, monkeypatch: pytest.MonkeyPatch) -> None:
    """And get the bits that the kernel with all effects would give them."""
    none, cheap, every = (len(variant.model.effects) for variant in list_kernel_variants(catalogue.model))
    assert none == 0 and 10 < cheap < 20 and every == len(EFFECTS)
    assert len(list_kernel_variants(QUIET.with_effects(EFFECTS[:3]))) == 1
    at_work = [{}, *(start(effect, 0) for effect in ("null_bias", "stribeck", "rod_backlash", "orifice_root")), {}]
    values = np.vstack([with_effects(catalogue, changes) for changes in at_work])
    outputs = catalogue.replay(values, CURRENT, FORCE)
    monkeypatch.setattr(lanes_module, "FEW", 99)
    assert (outputs == Lanes(catalogue.model, catalogue.names, catalogue.steps).replay(values, CURRENT, FORCE)).all()


def test_runs_with_few_costly_effects_get_a_kernel_of_their_own_once_it_is_worth_while(
        catalogue: Lanes, monkeypatch: pytest.MonkeyPatch) -> None:
    """And get the bits that the kernel with all effects would give them."""
    kinds = [("coil_lag",), ("coil_lag", "rod_backlash")]
    values = np.vstack([with_effects(catalogue, {n: v for name in kind for n, v in start(name, which).items()})
                        for kind in kinds for which in (0, -1)] * 4)
    monkeypatch.setattr(lanes_module, "KERNEL_USE", KernelUse())
    outputs = catalogue.replay(values, CURRENT, FORCE)
    assert {len(variant.model.effects) for variant, _ in catalogue._assign_runs(values, 1)} == {len(EFFECTS)}
    monkeypatch.setattr(kernel_use, "WORTH_LOADING", 0.0)
    monkeypatch.setattr(kernel_use, "WORTH_COMPILING", 0.0)
    monkeypatch.setattr(lanes_module, "KERNEL_USE", KernelUse())
    assignments = catalogue._assign_runs(values, 1)
    assert {frozenset(variant.model.effects) & {"coil_lag", "viscosity_drift", "stribeck"}
            for variant, _ in assignments} == {frozenset({"coil_lag"})}
    assert (catalogue.replay(values, CURRENT, FORCE) == outputs).all()


def test_an_effect_of_a_user_with_a_memory(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MEMORY)
    load_effects(tmp_path / "mine.py")
    model = QUIET.replace({"wear.rate": 1e4})
    runs = Lanes(model, ["wear.rate"], steps=10).replay(np.array([[1e4], [0.0]]), CURRENT, FORCE)
    for rows, one in zip(runs, (model, QUIET), strict=True):
        assert (rows == one_run(one, CURRENT, FORCE)).all()


def test_a_start_from_a_measured_position_and_the_pull_to_it() -> None:
    """A missing sample does not pull; an offset, a gain and a lag of the transducer are settled at the start."""
    model = QUIET.replace({"sensor_offset.offset": 1e-4, "sensor_gain.error": 0.02, "sensor_lag.time": 1e-3})
    position = np.full(len(CURRENT), 2e-3)
    position[5:9] = np.nan
    lanes, none = Lanes(model.with_effects(EFFECTS), ["sensor_offset.offset"], steps=10), np.zeros_like(CURRENT)
    values = np.array([[0.0], [1e-4], [-3e-4]])
    for anchor in (0.0, 5.0):
        runs = lanes.replay(values, CURRENT, FORCE, position, anchor)
        assert (runs[1] == one_run(model, CURRENT, FORCE, position, anchor)).all()
        assert runs[:, 0, 0] == pytest.approx(2e-3, abs=1e-6)
    assert lanes.replay(values, none, none, position)[:, :, 0] == pytest.approx(2e-3, abs=1e-6)


def test_threads_do_not_matter() -> None:
    values = np.linspace(5.0, 40.0, 70)[:, None]
    serial_runs, parallel_runs = (Lanes(QUIET, ["spool.static_friction"], 10, workers).replay(values, CURRENT, FORCE)
                                  for workers in (1, 3))
    assert (serial_runs == parallel_runs).all() and len(np.unique(serial_runs[:, -1, 0])) > 50


def test_runs_of_side_by_side_fits_share_blocks_and_keep_their_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of other models, parameters and inputs: only what has the same kernel and the same inputs shares a block."""
    heavy = QUIET.replace({"jack.mass": 900.0})
    biased = QUIET.with_effects(["null_bias"]).replace({"null_bias.current": 1e-4})
    tasks = [(QUIET, ["spool.static_friction"], 5.0, CURRENT), (heavy, ["jack.damping", "jack.area"], 2.0, CURRENT),
             (biased, ["jack.mass"], 400.0, CURRENT), (QUIET, ["jack.mass"], 400.0, 2.0 * CURRENT)]

    def replay(task: tuple[Model, list[str], float, Any]) -> Any:
        model, names, value, current = task
        values = np.outer(np.linspace(1.0, 1.1, 5), [value, 1e-3][:len(names)])
        return Lanes(model, names, 10).replay(values, current, FORCE)

    alone = [replay(task) for task in tasks]
    blocks = []
    build = lanes_module.build_blocks
    monkeypatch.setattr(lanes_module, "build_blocks", lambda *arguments: blocks.append(build(*arguments)) or blocks[-1])
    for one, other in zip(alone, map_together(replay, tasks, 2), strict=True):
        assert np.array_equal(one, other)
    assert sorted(len(each) for each in blocks) == [1, 2]


def test_what_does_not_fit_is_refused() -> None:
    lanes = Lanes(QUIET, ["jack.mass"])
    assert lanes.replay(np.empty((0, 1)), CURRENT, FORCE).shape == (0, len(CURRENT), 3)  # no runs, or no cycles, do
    assert lanes.closed_loop(np.array([[400.0]]), np.empty(0), np.empty(0)).shape == (1, 0, 4)
    for values, current, load, position in (
            (np.ones((2, 2)), CURRENT, FORCE, None), (np.ones(2), CURRENT, FORCE, None),
            (np.ones((2, 1)), CURRENT, FORCE[1:], None), (np.ones((2, 1)), CURRENT, FORCE, FORCE[1:])):
        catch_refusal(lanes.replay, values, current, load, position)
    for name in ("jack.moss", "controller.period", "null_bias.current"):
        assert name in catch_refusal(Lanes, QUIET, [name])


@pytest.mark.skipif(not compiles_for("avx2"), reason="no code for wide registers here (AVX2)")
def test_wide_registers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lanes of the step became vector code, as a loop or at once: nothing in the step stops it."""
    monkeypatch.setenv("EHA_RIG_CACHE", str(tmp_path))  # what comes from the cache cannot be read as assembly
    plan = plan_layout((), Model().kind, Model().build_record().dtype, NARROWEST)
    run = compile_function(plan.loop, plan.names)
    run(np.zeros(plan.numbers * NARROWEST), CURRENT, FORCE, np.empty(0), 0.0, 0.0, False, 1e-3, 10,
        0, len(CURRENT), 0, 0, True, np.arange(NARROWEST, dtype=np.uint64), np.empty((NARROWEST, 3, len(CURRENT))))
    (code,) = run.inspect_asm().values()
    pieces = re.split(r"^\.LBB\w+:\n", code, flags=re.MULTILINE)  # without a jump
    step = max(pieces, key=lambda piece: len(re.findall("%[yz]mm", piece)))
    assert len(re.findall("%[yz]mm", step)) > 100
    assert len(re.findall(r"v(?:add|sub|mul|div|min|max)sd", step)) < 5  # of what all lanes share


def test_replay_in_turns_has_the_bits_of_a_whole_replay() -> None:
    """The state goes on from piece to piece."""
    lanes = Lanes(QUIET.with_effects(EFFECTS), ["supply_ripple.amplitude"], 5)
    values = np.array([[0.0], [0.05]])
    position = np.where(np.arange(len(CURRENT)) % 7, 1e-4, np.nan)
    position[0] = 1e-4
    whole = lanes.replay(values, CURRENT, FORCE, position, 20.0)
    turns = list(lanes.replay_in_turns(values, CURRENT, FORCE, position, 20.0, rows=37))
    assert [first for first, _ in turns] == list(range(0, len(CURRENT), 37))
    assert (np.concatenate([out for _, out in turns], axis=1) == whole).all()


def test_parts_begin_anew_at_their_own_time() -> None:
    """A part is a replay of its rows alone, with the clock of the recording it was cut from."""
    lanes = Lanes(QUIET.with_effects(EFFECTS), ["supply_ripple.amplitude"], 5)
    values, half = np.array([[0.05]]), len(CURRENT) // 2
    cut = lanes.replay(values, CURRENT, FORCE, CURRENT, 20.0, [Part(0, half, 0), Part(half, len(CURRENT), 40)])
    first = lanes.replay(values, CURRENT[:half], FORCE[:half], CURRENT[:half], 20.0)
    rest = [x[half:] for x in (CURRENT, FORCE, CURRENT)]
    second = lanes.replay(values, *rest, 20.0, [Part(0, len(CURRENT) - half, half + 40)])
    assert (cut == np.concatenate([first, second], axis=1)).all()
    assert (second != lanes.replay(values, *rest, 20.0)).any()


def test_the_transducer_moves_along_where_the_ram_is_pulled() -> None:
    """With play, a lag and an elastic mount before the transducer: an anchored run shows the pull at once and whole."""
    model = Model().replace({"rod_backlash.width": 4e-5, "sensor_lag.time": 3e-3, "mount_compliance.compliance": 1e-9})
    pull, show = (interpret_function(f, model.kind.bind_functions(model.effects)) for f in (pull_plant, show_start))
    p = model.build_record()[0]
    before, m = model.build_start()
    after, m = pull(before, m, 0.5, before.sensed + 2e-5, 0.0, p)
    after = show(after, m, p)
    shifts = (after.jack_position - before.jack_position, after.sensed - before.sensed)
    assert shifts == pytest.approx((1e-5, 1e-5))


PREFLIGHT = load_sequence("preflight").build_main_profile().command
STEP = np.r_[np.zeros(20), np.full(300, 1e-3)]


def one(com: np.ndarray, clogging: float, friction: float, model: Model = QUIET) -> np.ndarray:
    """XJ, Cor, P12, XS of a closed-loop run, (4, n)."""
    return Monitor(model).closed_loop(np.array([[clogging, friction]]), com, whole=True)[0]


def test_one_step_a_cycle_is_enough() -> None:
    values = np.array([[0.0, 5.0], [0.25, 30.0], [0.5, 90.0], [0.17, 45.0]])
    once, often = (Monitor(QUIET, steps=n).closed_loop(values, PREFLIGHT, whole=True) for n in (1, 50))
    worst = np.abs(once - often).max((0, 2))
    assert (worst < [1e-10, 1e-9, 1.0, 1e-10]).all()  # m, A, Pa, m: to rounding


@pytest.mark.parametrize(("clogging", "friction"), [(0.0, 5.0), (0.25, 30.0), (0.17, 45.0)])
def test_is_the_reference_model_without_what_it_leaves_out(clogging: float, friction: float) -> None:
    """The reference with a light, undamped flapper and spool and a jack without friction and leakage is the monitor."""
    current = simulate(QUIET.replace({FAULTS[0]: clogging, FAULTS[1]: friction}), PREFLIGHT[:4000]).cor
    light = QUIET.replace({
        "flapper.inertia": 1e-8, "flapper.damping": 1e-3, "spool.mass": 1e-6, "spool.damping": 0.0,
        "jack.static_friction": 0.0, "jack.dynamic_friction": 0.0, "jack.leakage": 0.0, FAULTS[0]: clogging,
        FAULTS[1]: friction, "spool.dynamic_friction": 2.0 / 3.0 * friction})
    reference = Lanes(light, (), 400).replay(np.empty((1, 0)), current, np.zeros(4000))[0]
    ours = Monitor(QUIET, sliding=2.0 / 3.0).replay(np.array([[clogging, friction]]), current, whole=True)[0]
    ram, spool = np.abs(ours[[0, 3]] - reference.T[[0, 2]])
    # the spool moves 122 um in a cycle; the light flapper takes 5 us to its stop
    assert max(ram[:600].max(), spool[:600].max()) < 2e-6
    assert np.median(spool) < 0.1e-6  # after that a break-away may fall on a knife's edge


def test_side_by_side_is_alone() -> None:
    values = np.random.default_rng(0).uniform([0.0, 0.0], [0.5, 90.0], (71, 2))  # not a whole block
    runs = Monitor(QUIET).closed_loop(values, STEP, whole=True)
    for row in (0, 7, 64, 70):
        assert (runs[row] == one(STEP, *values[row])).all()
    assert (Monitor(QUIET).closed_loop(values, STEP)[:, 0] == runs[:, 0]).all()


@pytest.mark.parametrize(("names", "values", "word"), [
    (("filter.clogging", "no.such"), np.zeros((1, 2)), "no.such"), (("controller.period",), np.ones((1, 1)), "period"),
    (FAULTS, np.zeros((1, 3)), "values"), (FAULTS, np.zeros(2), "values")])
def test_refusals(names: tuple[str, ...], values: np.ndarray, word: str) -> None:
    assert word in catch_refusal(lambda: Monitor(QUIET, names).closed_loop(values, STEP))
    assert "position" in catch_refusal(Monitor(QUIET).replay, np.zeros((1, 2)), STEP, STEP[:7])
