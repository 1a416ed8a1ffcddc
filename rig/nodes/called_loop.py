"""Compiled loops that Python calls for a part of their work, on a bus of any kind: Python waits, sends and receives.

Such a loop is bound to `IN_PYTHON` in place of the calls of raw_bus.py. It makes no system call, so its machine code is
stored on disk and runs without numba (plant/machine_code.py).
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from plant import StoredCode, compile_function, find_code_folder, keep_apart
from rig.benches import to_integer
from rig.network import PAYLOAD_OUT, QUEUE_FULL, SENT, TIMEOUT, Port

# Words of the port behind the payloads: the time, how many frames are to be sent, and these: identifier, length and 8
# words of payload each
_TIME, _FRAMES, _FRAMES_AT, _FRAME_WORDS = 188, 189, 190, 10
_MOST = 1100  # frames a call: as many late ones may be due at once


def make_port() -> Port:
    """The memory of such a loop."""
    words = np.zeros(_FRAMES_AT + _FRAME_WORDS * _MOST, np.int64)
    return Port(words, words.view(np.int32), words.view(np.uint8))


def call_loop(port: Port, run: Callable[[], object], t_ns: int) -> list[tuple[int, bytes]]:
    """Run the code of a loop, for which it is `t_ns`; returns identifiers and payloads of the frames that it sends."""
    words = port.words
    words[_TIME], words[_FRAMES] = t_ns, 0
    run()
    frames = words[_FRAMES_AT:_FRAMES_AT + _FRAME_WORDS * words[_FRAMES]].reshape(-1, _FRAME_WORDS)
    return [(int(frame[0]), frame[2:].tobytes()[:frame[1]]) for frame in frames]


@cache
def load_loop(function: Callable[..., object], make_trial: Callable[[], Sequence[Any]]) -> StoredCode:
    """The machine code of a loop: some seconds on a new machine. `make_trial`: its arguments for a trial."""
    code = StoredCode(find_code_folder(function, IN_PYTHON), partial(compile_function, function, IN_PYTHON),
                      function.__name__)
    code.warm(make_trial)
    return code


def _read_time(port: Port) -> int:
    return to_integer(port.words[_TIME])


@keep_apart
def _give_to_python(port: Port, cob_id: int, length: int) -> int:
    words = port.words
    if words[_FRAMES] == _MOST:
        return QUEUE_FULL
    at = _FRAMES_AT + _FRAME_WORDS * words[_FRAMES]
    words[at], words[at + 1] = cob_id, length
    for i in range(8):
        words[at + 2 + i] = words[PAYLOAD_OUT // 8 + i]
    words[_FRAMES] += 1
    return SENT


def _receive_nothing(port: Port, deadline_ns: int) -> tuple[int, int, int, int, int]:
    return TIMEOUT, 0, 0, 0, 0


def _go_on(port: Port, t_ns: int) -> None:
    """Python has waited before it called."""


IN_PYTHON = {"read_clock": _read_time, "send_payload": _give_to_python, "receive_frame": _receive_nothing,
             "sleep_until": _go_on}
