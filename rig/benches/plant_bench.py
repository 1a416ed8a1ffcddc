"""A bench for any plant without a device: a frame of plain CAN for each signal, and the plant's own controller on it.

`rig run --model my_plant.py` takes it where no bench file is given and the shipped one has other signals.
`rig.nodes.firmware` plays the controller on the embedded bus.
"""

from pathlib import Path

from plant.plants import Plant
from plant.signals import Signal
from rig.benches.bench import Bench
from rig.benches.bench_file import load_bench_from_files

_FILE, _DBC = "plant_bench.toml", "plant_bench.dbc"
_FIRST_IDENTIFIER, _DRIVE_IDENTIFIER = 0x101, 0x201


def make_plant_bench(plant: Plant, model: str) -> Bench:
    """The bench for a plant: its command and readings go to the controller, its drive comes back, as 64-bit numbers.

    Args:
        plant: as declared.
        model: that has it; the folder of its file is left out.
    """
    return load_bench_from_files({_FILE: _write_file(plant, Path(model).name).encode(),
                                  _DBC: _write_dbc(plant).encode()}, plant.signals)


def is_plant_bench(bench: Bench) -> bool:
    """Whether the plant's own controller can be the controller of this bench."""
    return next(iter(bench.files), "") == _FILE


def _write_file(plant: Plant, model: str) -> str:
    sent = [f"{s.word} = {_write_place(s)}" for s in (plant.signals.command, *plant.signals.outputs)]
    return "\n".join([f'name = "{plant.title}, with its own controller"', f"plant = {model!r}", "", "[controller]",
                      'protocol = "can"', f'dbc = "{_DBC}"', "", "[controller.inputs]", *sent, "",
                      "[controller.outputs]", f"{plant.signals.drive.word} = {_write_place(plant.signals.drive)}", ""])


def _write_place(signal: Signal) -> str:
    count = "" if signal.unit == "1" else f', count = "1 {signal.unit}"'
    return f'{{ signal = "{signal.word}.{signal.word}"{count} }}'


def _write_dbc(plant: Plant) -> str:
    given = (plant.signals.command, *plant.signals.outputs)
    frames = [*enumerate(given, _FIRST_IDENTIFIER), (_DRIVE_IDENTIFIER, plant.signals.drive)]
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: Rig Controller", ""]
    for identifier, signal in frames:
        sender, receiver = ("Rig", "Controller") if signal in given else ("Controller", "Rig")
        lines += [f"BO_ {identifier} {signal.word}: 8 {sender}",
                  f' SG_ {signal.word} : 0|64@1- (1,0) [0|0] "{signal.unit}" {receiver}', ""]
    return "\n".join([*lines, *(f"SIG_VALTYPE_ {identifier} {signal.word} : 2;" for identifier, signal in frames), ""])
