"""Damaged bench files, data sheets and DBCs: each is refused in one line or makes a bench that can be used.

    python -m studies.bench_mutations [COUNT] [SEED]                # default 100000, 1

Damages the shipped bench and those of examples/ with their EDS and DBC: bytes, lines, numbers, words of other places.
Each is loaded, its frames are packed and unpacked, become the tables of the compiled loop and a share of the bus, and a
first bench file is guessed from the damaged sheet.
"""

import random
import re
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from plant import InputError
from rig.benches import (
    Role,
    Wanted,
    decode_device_text,
    guess_can,
    guess_canopen,
    list_loads,
    load_bench,
    load_bench_from_files,
    make_layout,
    pack,
    unpack,
)
from studies.command import start_parser

EXAMPLES = Path(__file__).parent.parent / "examples"
NUMBERS = ("0", "1", "-1", "7", "8", "64", "65", "127", "128", "255", "256", "0xFFFFFFFF", "0x80000000", "0x20000000",
           "1e999", "-0.0", "nan", "1e-400", "99999999999999999999", "0x", "$NODEID+0x200", "1_0", "0b1", "''", "")
MUTATIONS_EACH = (1, 1, 1, 2, 3, 8)  # how many damages a file gets


class Outcome(NamedTuple):
    """What became of one damaged set of files."""

    kind: str  # "loaded", "refused" or "failed"
    seconds: float
    text: str = ""  # the line of a refusal, or the traceback of a failure


def load_originals() -> list[Mapping[str, bytes]]:
    """The files of the shipped bench and of those in examples/, the bench file first."""
    return [load_bench(name, is_trusted=True).files
            for name in ("eha", *map(str, sorted(EXAMPLES.glob("*/bench.toml"))))]


def damage_files(files: Mapping[str, bytes], chance: random.Random) -> dict[str, bytes]:
    """The same files, of which one is damaged, rarely two."""
    damaged = dict(files)
    for name in chance.sample(sorted(files), 2 if len(files) > 1 and chance.random() < 0.1 else 1):
        for _ in range(chance.choice(MUTATIONS_EACH)):
            damaged[name] = chance.choice(DAMAGES)(damaged[name], chance)
    return damaged


def _flip_bytes(data: bytes, chance: random.Random) -> bytes:
    mutant = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        if mutant:
            mutant[chance.randrange(len(mutant))] = chance.randrange(256)
    return bytes(mutant)


def _cut(data: bytes, chance: random.Random) -> bytes:
    first, last = sorted(chance.randint(0, len(data)) for _ in range(2))
    return data[:first] if chance.random() < 0.3 else data[:first] + data[min(last, first + 200):]


def _change_lines(data: bytes, chance: random.Random) -> bytes:
    lines = data.split(b"\n")
    here, there = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(3):
        case 0:
            del lines[here]
        case 1:
            lines.insert(here, lines[there])
        case _:
            lines[here], lines[there] = lines[there], lines[here]
    return b"\n".join(lines)


def _change_number(data: bytes, chance: random.Random) -> bytes:
    matches = list(re.finditer(rb"(?:0x)?[0-9A-Fa-f]*[0-9][0-9A-Fa-f.]*", data))
    if not matches:
        return data
    place = chance.choice(matches)
    other = chance.choice(NUMBERS).encode() if chance.random() < 0.5 else chance.choice(matches)[0]
    return data[:place.start()] + other + data[place.end():]


def _change_word(data: bytes, chance: random.Random) -> bytes:
    matches = list(re.finditer(rb"[A-Za-z_]{2,}|[=\[\]{}:|@+,()\"-]", data))
    if not matches:
        return data
    place, other = chance.choice(matches), chance.choice(matches)[0]
    return data[:place.start()] + (b"" if chance.random() < 0.3 else other) + data[place.end():]


DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip_bytes, _cut, _change_lines, _change_number, _change_number, _change_word)


def try_files(files: Mapping[str, bytes]) -> Outcome:
    """Load and use a set of files."""
    start = time.perf_counter()
    kind, text = "loaded", ""
    try:
        _use_bench(files)
        for name, data in files.items():
            _guess_bench(name, data)
    except InputError as error:
        kind, text = "refused", str(error)
        if "\n" in text or len(text) > 1000:
            kind = "failed"
    except Exception:
        kind, text = "failed", traceback.format_exc()
    return Outcome(kind, time.perf_counter() - start, text)


def _use_bench(files: Mapping[str, bytes]) -> None:
    bench = load_bench_from_files(files)
    for spec in bench.frames.frames:
        values = {each.name: 1.0 for each in spec.fields}
        unpack(spec, pack(spec, values, 3))
    list_loads(bench)
    make_layout(bench.frames.list_of(Role.RIG), ("position_demand", "ram_position", "current"), Role.RIG)


def _guess_bench(name: str, data: bytes) -> None:
    if name.endswith(".dbc"):
        guess_can("x", name, decode_device_text(data), Wanted())
    elif not name.endswith(".toml"):
        guess_canopen("x", name, decode_device_text(data), None, Wanted())


def run_trials(count: int, seed: int) -> Iterator[tuple[int, Mapping[str, bytes], Outcome]]:
    """Number, files and outcome of each trial; a trial repeats with its seed and number."""
    originals = load_originals()
    for number in range(count):
        chance = random.Random(f"{seed}:{number}")
        files = damage_files(originals[number % len(originals)], chance)
        yield number, files, try_files(files)


def main(count: int, seed: int) -> int:
    """Print how many were loaded, refused and failed, the failures, and the times."""
    kinds: Counter[str] = Counter()
    seconds = []
    for number, files, outcome in run_trials(count, seed):
        kinds[outcome.kind] += 1
        seconds.append(outcome.seconds)
        if outcome.kind == "failed":
            print(f"trial {number}: {outcome.text}", flush=True)
            folder = Path(f"failed_{seed}_{number}")
            folder.mkdir(exist_ok=True)
            for name, data in files.items():
                (folder / Path(name).name).write_bytes(data)
    seconds.sort()
    print(f"{count} trials, seed {seed}: {kinds['loaded']} loaded, {kinds['refused']} refused in one line, "
          f"{kinds['failed']} failed")
    print(f"time of a trial: median {1000 * seconds[count // 2]:.1f} ms, 99 % {1000 * seconds[count * 99 // 100]:.1f} "
          f"ms, longest {1000 * seconds[-1]:.1f} ms")
    return int(kinds["failed"] > 0)


if __name__ == "__main__":
    parser = start_parser("studies.bench_mutations", __doc__)
    parser.add_argument("count", type=int, nargs="?", default=100_000, help="trials (default 100,000)")
    parser.add_argument("seed", type=int, nargs="?", default=1, help="default 1")
    sys.exit(main(**vars(parser.parse_args())))
