"""A first bench file from an EDS, DCF or DBC: names, units and access say what is likely; the rest is marked."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

from plant import EHA, Signals, find_unit, fit_unit
from rig.benches.bench import list_inputs, list_outputs
from rig.benches.can_map import read_database
from rig.benches.canopen_map import (
    INVALID,
    find_variable,
    list_pdos,
    name_object,
    read_dictionary,
    read_node,
    read_number,
)

UNSURE = "# unsure: "
# What a name says of a signal: the quantity, and which of several it is.
_WORDS: dict[str, tuple[set[str], set[str]]] = {
    "position_demand": ({"position", "pos", "target", "stroke", "weg", "lage", "hub"},
                        {"demand", "target", "command", "cmd", "setpoint", "set", "reference", "ref", "desired",
                         "soll", "sollwert", "vorgabe"}),
    "ram_position": ({"position", "pos", "ram", "stroke", "weg", "lage", "hub", "kolben"},
                     {"actual", "act", "feedback", "fb", "measured", "sensor", "ram", "ist", "istwert", "kolben"}),
    "load_pressure": ({"pressure", "press", "dp", "druck", "differenzdruck"},
                      {"load", "differential", "diff", "delta", "dp", "last", "differenz", "differenzdruck"}),
    "spool_position": ({"spool", "schieber"}, {"position", "pos", "weg", "lage", "hub"}),
    "load_force": ({"force", "kraft"}, {"load", "external", "cell", "measured", "last", "extern"}),
    "current": ({"current", "coil", "cur", "torque", "strom", "moment"},
                {"demand", "actual", "coil", "motor", "drive", "output", "ventil", "antrieb", "spule"}),
}
for _signal in EHA[1:]:  # its name in a recording says both
    if _signal.role in ("output", "drive"):
        for _words in _WORDS[_signal.alias]:
            _words.add(_signal.name)
_WORDS_OF_PROFILES = ("control_word", "status_word", "mode", "mode_display")
_USUAL = {"m": "1 um", "Pa": "1 kPa", "N": "1 N", "A": "1 uA"}  # counts, where the file says nothing
_KNOWN_OBJECTS = {"0x607A": "command", "0x6078": "A", "0x6077": "N m"}  # CiA 402: role, or unit of the drive
_RATED_CURRENT = 0x6075  # mA; 0x6078 counts thousandths of it
_ENABLING = {"en", "enable", "enabled", "active", "activate", "engage", "engaged", "request", "run", "on",
             "operational", "ready", "freigabe", "frei", "ein", "aktiv", "bereit"}


@dataclass(frozen=True)
class Candidate:
    """A value of the device that a signal may be."""

    key: str  # as a bench file writes it
    name: str  # as people call it
    unit: str  # "" if the file gives none
    count: str | None = None  # what a count is worth, where the file gives it apart from the unit


class Wanted(NamedTuple):
    """What a bench file connects a device with: a plant, as the file names it, and its signals."""

    plant: str = "eha"
    signals: Signals = EHA

    @property
    def tables(self) -> dict[str, dict[str, str]]:
        """The words of [inputs] and [outputs], each with its unit."""
        return {"inputs": list_inputs(self.signals), "outputs": list_outputs(self.signals)}

    @property
    def needed(self) -> tuple[str, ...]:
        """Words without which there is no loop."""
        return tuple(s.word for s in (self.signals.command, self.signals.controlled, self.signals.drive))

    def list_words(self, word: str) -> tuple[set[str], set[str]]:
        """What names say of the signal of that word: the quantity, and which of several it is."""
        if word in _WORDS or word not in {s.word for s in self.signals}:
            return _WORDS.get(word, ({word}, {word}))
        signal = next(s for s in self.signals if s.word == word)
        names, controlled = {word.replace("_", "").lower(), signal.symbol.lower()}, self.signals.controlled
        whole = f"{controlled.word}_{word}".lower() if signal == self.signals.command else word.lower()
        parts = {part for part in whole.split("_") if len(part) > 1}
        like = {self.signals.command.word: "position_demand", controlled.word: "ram_position",
                self.signals.drive.word: "current" if signal.unit == "A" else ""}.get(word, "")
        quantity, which = _WORDS.get(like, (set(), set()))  # of the signal of the EHA with this role
        return parts | names | quantity, names | which | ({word.lower().split("_")[-1]} if len(parts) > 1 else set())

    def is_known_object(self, key: str, word: str) -> bool:
        """Whether an object of CiA 402 holds that signal."""
        meaning, s = _KNOWN_OBJECTS.get(key), self.signals
        return (meaning == "command" and word == s.command.word) or (meaning == s.drive.unit and word == s.drive.word)


def guess_canopen(title: str, file: str, text: str, node: int | None, wanted: Wanted) -> str:
    """A bench file for a CANopen device; `node` is its node-ID, None for that of the DCF, or 2.

    Raises:
        InputError: not an EDS.
    """
    number = node or read_node(text) or 2
    dictionary = read_dictionary(file, text, number)
    device_type = (read_number(dictionary, 0x1000, 0) or 0) & 0xFFFF
    has_words = all(find_variable(dictionary, index, 0) is not None for index in (0x6040, 0x6041))
    profile = {402: "cia402", 408: "cia408"}.get(device_type if has_words else 0, "none")
    doubt = "" if profile != "none" or not has_words else f"  {UNSURE}0x6040 and 0x6041 are there; cia402 or cia408?"
    lines = [f"name = {json.dumps(title)}", f"plant = {json.dumps(wanted.plant)}", 'cycle = "1 ms"',
             "bitrate = 1_000_000", "", "[controller]", 'protocol = "canopen"',
             f"node = {number}" + ("" if node or read_node(text) else f"  {UNSURE}the EDS does not say"),
             f"eds = {json.dumps(file)}", f'profile = "{profile}"{doubt}',
             *(['mode = 8                        # cyclic synchronous position'] if profile == "cia402" else [])]
    for table, units in wanted.tables.items():
        candidates = _list_objects(dictionary, number, is_received=table == "inputs")
        lines += ["", f"[controller.{table}]", *_write_signals(candidates, units, wanted, "object", "0x0000")]
    return "\n".join([_HEAD, *lines, ""])


_HEAD = "# Which device is under test, how it talks, and what its numbers mean. docs/bench.md has all keys."


def _list_objects(dictionary: Any, node: int, *, is_received: bool) -> list[Candidate]:
    """The objects that a PDO of this direction maps, without those of the profile."""
    candidates = []
    for pdo in list_pdos(dictionary, node):
        for index, sub, _ in pdo.entries:
            variable = find_variable(dictionary, index, sub)
            if pdo.is_received is not is_received or pdo.cob_id & INVALID or variable is None:
                continue
            key, count = name_object(index, sub), None
            rated_current = read_number(dictionary, _RATED_CURRENT, 0)
            if find_unit(variable.unit) is not None:
                count = f"{variable.factor:g} {variable.unit}"
            elif key == "0x6078" and rated_current:
                count = f"{float(Fraction(rated_current, 1000)):g} mA"
            candidates.append(Candidate(key, variable.qualname, variable.unit if count else "", count))
    return [each for each in candidates if each.key not in ("0x6040", "0x6041", "0x6060", "0x6061")]  # the profile's


def guess_can(title: str, file: str, text: str, wanted: Wanted) -> str:
    """A bench file for a device on plain CAN.

    Raises:
        InputError: not a DBC.
    """
    messages = read_database(file, text).messages
    candidates = {message.name: [Candidate(f"{message.name}.{signal.name}", f"{message.name} {signal.name}",
                                           signal.unit or "")
                                 for signal in message.signals if not signal.is_multiplexer] for message in messages}
    all_candidates = [each for group in candidates.values() for each in group]
    command, drive = wanted.signals.command.word, wanted.signals.drive.word
    senders = {message.name: set(message.senders) for message in messages}
    matches = _assign(
        all_candidates, {command: wanted.tables["inputs"][command], drive: wanted.tables["outputs"][drive]}, wanted)
    word_senders = {word: senders[each.key.partition(".")[0]] for word, (each, _) in matches.items()}
    nodes = set[str]().union(*senders.values())
    device = word_senders.get(drive) or nodes - word_senders.get(command, nodes)  # the rig sends the demand
    sent_messages = [message for message in messages if device and senders[message.name] & device]
    received_messages = [message for message in messages if message not in sent_messages]
    inputs = [each for message in received_messages for each in candidates[message.name]]
    outputs = [each for message in (sent_messages or messages) for each in candidates[message.name]]
    lines = [f"name = {json.dumps(title)}", f"plant = {json.dumps(wanted.plant)}", 'cycle = "1 ms"',
             f"bitrate = 1_000_000  {UNSURE}the DBC does not say", "", "[controller]", 'protocol = "can"',
             f"dbc = {json.dumps(file)}", f'timeout = "20 ms"  {UNSURE}without a frame for so long the device is gone']
    used_names = set()
    for (table, all_units), group in zip(wanted.tables.items(), (inputs, outputs), strict=True):
        units = {signal: unit for signal, unit in all_units.items() if signal not in _WORDS_OF_PROFILES}
        names = {each.key.partition(".")[0] for each, _ in _assign(group, units, wanted).values()}
        likely_candidates = [each for each in group if each.key.partition(".")[0] in names] or group
        lines += ["", f"[controller.{table}]",
                  *_write_signals(likely_candidates, units, wanted, "signal", "MESSAGE.SIGNAL")]
        used_names |= names
    lines += _write_states([message for message in messages if message.name in used_names], sent_messages)
    return "\n".join([_HEAD, *lines, ""])


def _write_states(messages: Sequence[Any], sent_messages: Sequence[Any]) -> list[str]:
    """The tables of the enabling signals, of protection, and of the state that the rig awaits."""
    tables: dict[str, list[str]] = {"phases": [], "protection": [], "ready": []}
    for message in messages:
        for signal in message.signals:
            words, key = split_words(signal.name), f'"{message.name}.{signal.name}"'
            values = [str(text) for text in (signal.choices or {}).values() if split_words(str(text)) & _ENABLING]
            if any(word.startswith(("crc", "checksum", "chk", "pruef")) or word == "cs" for word in words):
                tables["protection"].append(f'{key} = "crc8_sae_j1850"  {UNSURE}which checksum it is')
            elif words & {"counter", "cnt", "alive", "rolling", "sequence", "bz", "zaehler"}:
                tables["protection"].append(f'{key} = "counter"')
            elif message in sent_messages and words & {"state", "status", "st", "sts", "mode", "zustand", "betrieb"}:
                if values:
                    tables["ready"].append(f'{key} = "{values[0]}"  {UNSURE}the state in which main begins')
            elif (message not in sent_messages and words & (_ENABLING | {"mode"} if values else _ENABLING)
                  and signal.length <= 8):
                main = f'"{values[0]}"' if values else 1
                tables["phases"].append(f"{key} = {{ setup = 0, main = {main}, cleanup = 0 }}  {UNSURE}what enables")
    return [line for name, lines in tables.items() if lines for line in ("", f"[controller.{name}]", *lines)]


def split_words(name: str) -> set[str]:
    """The words of a name, and the name as one, in small letters.

    >>> sorted(split_words("RamPosition_act"))
    ['act', 'position', 'ram', 'ramposition_act']
    """
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+\d*(?![a-z])|[a-z]+\d+", name)} | {name.lower()}


def _assign(candidates: Iterable[Candidate], units: Mapping[str, str], wanted: Wanted
            ) -> dict[str, tuple[Candidate, bool]]:
    """The likeliest candidate of each word, with its unit, and whether it is sure; no candidate is two signals."""
    scores = []
    for each in candidates:
        words = split_words(each.name) | {word for part in each.name.split() for word in split_words(part)}
        for signal, unit in units.items():
            quantity, which = wanted.list_words(signal)
            fits = bool(unit) and fit_unit(each.unit, unit) is not None
            score = (3 * bool(words & quantity) + 2 * bool(words & which) + fits
                     + 9 * wanted.is_known_object(each.key, signal))
            if score >= 3 and (find_unit(each.unit) is None or fits):
                scores.append((score, signal, each))
    matches: dict[str, tuple[Candidate, bool]] = {}
    for score, signal, each in sorted(scores, key=lambda entry: -entry[0]):
        if signal not in matches and each not in [other for other, _ in matches.values()]:
            rivals = [other for points, name, other in scores if name == signal and points == score]
            matches[signal] = each, score >= 5 and len(rivals) == 1
    return matches


def _write_signals(candidates: Sequence[Candidate], units: Mapping[str, str], wanted: Wanted, word: str, example: str
                   ) -> list[str]:
    """The lines of [inputs] or [outputs]."""
    matches, lines = _assign(candidates, units, wanted), []
    for signal, unit in units.items():
        if signal in matches:
            each, is_sure = matches[signal]
            doubts = [] if is_sure else [f"is {each.name!r} the {signal}?"]
            entry = f'{signal} = {{ {word} = "{each.key}" }}' if word == "object" else f'{signal} = "{each.key}"'
            if unit and each.count is None and fit_unit(each.unit, unit) is None:
                doubts.append(f"what one count is worth; the file gives {each.name!r} no unit")
                entry = f'{signal} = {{ {word} = "{each.key}", count = "{_USUAL.get(unit, f"1 {unit}")}" }}'
            elif unit and each.count is not None:
                entry = f'{signal} = {{ {word} = "{each.key}", count = "{each.count}" }}'
            lines.append(entry + (f"  {UNSURE}{'; '.join(doubts)}" if doubts else ""))
        elif signal in wanted.needed:
            count = f', count = "{_USUAL.get(unit, f"1 {unit}")}"'
            lines.append(f'# {signal} = {{ {word} = "{example}"{count} }}  {UNSURE}nothing looks like it')
    used_keys = {each.key for each, _ in matches.values()}
    rest = [f"{each.key} ({each.name.rpartition(' ')[2] if word == 'signal' else each.name})" for each in candidates
            if each.key not in used_keys]
    return [*lines, *([f"# not used: {', '.join(rest[:12])}{', ..' if len(rest) > 12 else ''}"] if rest else [])]
