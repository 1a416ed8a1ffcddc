"""Chapter 3: the SDO server, frame by frame: transfers, toggle bits, aborts, lengths, malformed requests."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from canopen.objectdictionary.datatypes import DOMAIN

from rig.conformance.object_cases import read_values
from rig.conformance.target import (
    COMMAND,
    TIMED_OUT,
    TOGGLE,
    TOO_LONG,
    TOO_SHORT,
    WRONG_LENGTH,
    Case,
    CaseNotApplicable,
    Target,
    Variable,
    find_abort,
    for_each,
    format_abort,
    join_labels,
    require,
    require_abort,
    require_applicable,
)
from rig.network import ABORT, HEAD, pack_segment

Change = tuple[str, Callable[[bytes], bytes]]  # what is done to the data of a download
READ_TYPE = HEAD.pack(0x40, 0x1000, 0) + bytes(4)
LENGTHS: tuple[Change, ...] = (("one more", lambda data: data + b"\0"), ("one less", lambda data: data[:-1]))
LENGTH_CODES = (TOO_LONG, TOO_SHORT, WRONG_LENGTH)


def check_expedited_upload(t: Target) -> str:
    """The device type, which every node has."""
    response = t.demand(READ_TYPE)
    require(response[:4] == HEAD.pack(0x43, 0x1000, 0), f"{response.hex(' ')}, expected 43 00 10 00: four bytes")
    return response.hex(" ")


def check_expedited_download(t: Target, is_size_given: bool) -> str:
    """A value is changed, with or without its number of bytes, and changed back."""
    with changed_number(t) as (variable, before, new_data):
        command = 0x23 | (4 - len(new_data)) << 2 if is_size_given else 0x22
        response = t.demand(HEAD.pack(command, *variable.key) + new_data)
        require(response == HEAD.pack(0x60, *variable.key) + bytes(4), response.hex(" "))
        t.require_value(variable, new_data, "does not hold what was written")
    t.require_value(variable, before, "cannot be set back")
    return response.hex(" ")


def check_segmented_upload(t: Target) -> str:
    """An object of more than four bytes."""
    variable, _ = find_long_readable(t)
    mark = len(t.frames)
    data = t.upload(*variable.key)
    first, *segments = t.heard(mark, t.response_id)
    require(first.data[0] == 0x41, f"{variable.label}: {first.data.hex(' ')}, expected 0x41: the length is announced")
    return f"{variable.label}: {len(data)} bytes in {len(segments)} segments"


def check_segmented_download(t: Target) -> str:
    """The value read is written back in segments: an object of more than four bytes, or else a short one."""
    variable = find_long_writable(t)
    if variable is None:
        variable = find_harmless(t)
        require_abort(begin_download(t, variable, variable.size), (0,), "the transfer was refused")
        t.send(t.request_id, HEAD.pack(ABORT, *variable.key) + bytes(4))
    data = t.upload(*variable.key)
    t.download(*variable.key, data, segmented=True)
    t.require_value(variable, data, "holds another value then")
    return f"{variable.label}: length {len(data)}"


def check_upload_toggle(t: Target) -> str:
    """The second segment is asked for with the toggle bit of the first; of a short object, the first with toggle 1."""
    _, data = begin_upload(t)
    if len(data) > 7:
        t.demand(b"\x60")
    abort = require_abort(find_abort(t.demand, b"\x60" if len(data) > 7 else b"\x70"), (TOGGLE,))
    require(find_abort(t.demand, b"\x70"), "the transfer goes on after the abort")
    return abort


def check_segment(t: Target, change: Change, codes: Sequence[int], toggle: int = 0, is_announced: bool = False) -> str:
    """A download announces its own length, or that of the object; it is refused, and the object is unchanged."""
    what, alter = change
    with changed_number(t) as (variable, before, new_data):
        wrong_data = alter(new_data)
        code = begin_download(t, variable, len(wrong_data) if is_announced else variable.size)
        if not (is_announced and code):
            require_abort(code, (0,), "the transfer was refused")
            code = find_abort(t.demand, pack_segment(wrong_data, True, toggle))
        abort = require_abort(code, codes, what)
        t.require_value(variable, before, "was changed")
    return f"{what}: {abort}"


def check_refused_frame(t: Target, frame: bytes) -> str:
    """A frame that the server does not know, or does not expect."""
    return require_abort(find_abort(t.demand, frame), (COMMAND,))


def check_block_transfer(t: Target, request: tuple[str, bytes]) -> str:
    """Block transfer is optional. Where it is offered it is not tested further."""
    what, frame = request
    code = find_abort(t.demand, frame)
    if not code:
        t.send(t.request_id, HEAD.pack(ABORT, *HEAD.unpack_from(frame)[1:]) + bytes(4))
        t.wait(0.01)
    require_abort(code, (0, COMMAND), f"block {what}")
    t.upload(0x1000)  # normal requests are still answered
    return f"{what} {'refused' if code else 'offered'}"


def check_client_abort(t: Target) -> str:
    """In the middle of an upload."""
    variable, _ = begin_upload(t)
    answer = t.ask(HEAD.pack(ABORT, *variable.key) + (0x08000000).to_bytes(4, "little"), 0.1)
    require(answer is None, f"an abort was answered with {(answer or b'').hex(' ')}")
    abort = require_abort(find_abort(t.demand, b"\x60"), (COMMAND,), "the next segment")
    return f"no answer; the next segment: {abort}"


def check_unfinished_transfer(t: Target) -> str:
    """The client loses interest in a segmented transfer and asks for something else."""
    begin_upload(t)
    code = find_abort(t.demand, READ_TYPE)
    t.demand(READ_TYPE)  # a server may abort the old transfer first
    return f"answered after {format_abort(code)}" if code else "answered"


def check_timeout(t: Target) -> str:
    """Six seconds without a segment. CiA 301 does not say after what time a server gives up."""
    begin_upload(t)
    start = t.now()
    frames = t.listen(6.0, t.response_id)
    for frame in frames:
        is_timeout = frame.data[:1] == b"\x80" and frame.data[4:] == TIMED_OUT.to_bytes(4, "little")
        require(is_timeout, f"frame {frame.data.hex(' ')}")
    require(len(frames) <= 1, f"{len(frames)} aborts")
    t.demand(READ_TYPE)
    return f"abort after {(frames[0].t_ns - start) * 1e-9:.2f} s" if frames else "the server waits on"


def check_short_requests(t: Target) -> str:
    """None of them may be taken for a complete one, or stop the server."""
    answers = [t.ask(READ_TYPE[:length], 0.05) for length in range(8)]
    for length, answer in enumerate(answers):
        is_right = answer is None or answer[:1] == b"\x80"
        require(is_right, f"{length} bytes were answered with {(answer or b'').hex(' ')}")
    t.demand(READ_TYPE)
    return f"8 frames, {8 - answers.count(None) or 'none'} answered"


def check_foreign_requests(t: Target) -> str:
    """A node-ID that nobody on the bus has, and a response of somebody else, which is no request."""
    free = t.find_free_node()
    t.send(0x600 + free, READ_TYPE)
    t.send(t.response_id, bytes(8))
    answers = [f"0x{cob_id:03X} {data.hex(' ')}" for _, cob_id, data in t.listen(0.1, t.response_id, 0x580 + free)]
    require(not answers, join_labels(answers))
    t.demand(READ_TYPE)
    return f"node {free}: no answer"


def check_abort_object(t: Target, key: tuple[int, int]) -> str:
    """So that a client can tell which of its requests failed."""
    label = f"0x{key[0]:04X}:{key[1]:X}"
    require(find_abort(t.upload, *key), f"{label} was not refused")
    answer = t.heard(0, t.response_id)[-1].data
    require(answer[:4] == HEAD.pack(ABORT, *key), f"asked {label}: {answer.hex(' ')}")
    return label


def find_harmless(t: Target) -> Variable:
    """A number of more than one byte that may be changed without harm. Raises CaseNotApplicable."""
    for key in ((0x1017, 0), (0x1016, 1), (0x1006, 0)):
        if t.sheet.is_writable(*key):
            return t.variable(*key)
    raise CaseNotApplicable("the EDS has no writable 0x1017, 0x1016 or 0x1006")


@contextmanager
def changed_number(t: Target) -> Iterator[tuple[Variable, bytes, bytes]]:
    """A harmless number, what it holds, and another value for it; it is set back afterwards."""
    variable = find_harmless(t)
    with t.restore_afterwards(variable.key):
        before = t.upload(*variable.key)
        yield variable, before, variable.change(before)


def find_long_readable(t: Target) -> tuple[Variable, bytes]:
    """A readable object of more than four bytes, if possible of more than seven, and what it holds.

    Raises CaseNotApplicable.
    """
    values = [value for value in read_values(t, lambda each: each.data_type != DOMAIN and not 0 < each.size <= 4)
              if len(value[1]) > 4]
    require_applicable(values, "no object has more than four bytes")
    return max(values, key=lambda value: (len(value[1]) > 7, value[0].is_communication))


def find_long_writable(t: Target) -> Variable | None:
    """An object of more than four bytes that may be read and written, None if there is none."""
    return next((variable for variable in t.sheet.variables if variable.is_writable and variable.is_readable
                 and variable.size > 4 and not variable.is_active), None)


def begin_upload(t: Target) -> tuple[Variable, bytes]:
    """Begin a segmented upload; the object and what it holds. Raises CaseNotApplicable."""
    variable, data = find_long_readable(t)
    t.demand(HEAD.pack(0x40, *variable.key))
    return variable, data


def begin_download(t: Target, variable: Variable, size: int) -> int:
    """Begin a segmented one; its abort code. Raises CaseNotApplicable for a server without segments."""
    code = find_abort(t.demand, HEAD.pack(0x21, *variable.key) + size.to_bytes(4, "little"))
    require_applicable(code != COMMAND or find_long_writable(t) is not None,
                       "no object needs segments, and the server refuses them")
    return code


CASES = (
    Case("3.1", "expedited upload", "7.2.4.3.6", "one frame: 0x43, object, four bytes of data with their number",
         check_expedited_upload),
    Case("3.2", "expedited download", "7.2.4.3.3", "one frame: 0x60, object, four bytes 0; the value is in force",
         partial(check_expedited_download, is_size_given=True)),
    Case("3.3", "expedited download without a length", "7.2.4.3.3",
         "accepted, and the object takes the bytes it needs (s = 0)",
         partial(check_expedited_download, is_size_given=False)),
    Case("3.4", "segmented upload", "7.2.4.3.6, 7.2.4.3.7",
         "the length is announced and kept; toggle bit from 0; the last segment is marked", check_segmented_upload),
    Case("3.5", "segmented download", "7.2.4.3.3, 7.2.4.3.4",
         "each segment is confirmed with its toggle bit; the value is kept", check_segmented_download),
    Case("3.6", "toggle bit wrong in an upload", "7.2.4.3.7, table 22", "abort 0x05030000, and the transfer is over",
         check_upload_toggle),
    Case("3.7", "toggle bit wrong in a download", "7.2.4.3.4, table 22",
         "abort 0x05030000, and the object is unchanged",
         partial(check_segment, change=("toggle 1 first", lambda data: data), codes=(TOGGLE,), toggle=0x10)),
    Case("3.8", "segment without a transfer", "7.2.4.3.17, table 22", "abort 0x05040001",
         for_each(lambda t: (b"\x60", b"\x00"), check_refused_frame, "request", "{} refused")),
    Case("3.9", "unknown command specifier", "7.2.4.3.17, table 22", "abort 0x05040001",
         partial(check_refused_frame, frame=HEAD.pack(0xE0, 0x1000, 0))),
    Case("3.10", "block transfer", "7.2.4.3.9, 7.2.4.3.13",
         "offered, or refused with 0x05040001 so that the client falls back",
         for_each(lambda t: (("upload", HEAD.pack(0xA4, 0x1000, 0) + bytes((127, 0, 0, 0))),
                             ("download", HEAD.pack(0xC6, 0x1017, 0) + (2).to_bytes(4, "little"))),
                  check_block_transfer)),
    Case("3.11", "abort by the client", "7.2.4.3.17", "no answer, and the transfer is over", check_client_abort),
    Case("3.12", "a transfer that is not finished", "7.2.4.3", "a new request to another object is answered",
         check_unfinished_transfer),
    Case("3.13", "announced length differs from the object", "7.2.4.3.3, table 22",
         "refused with 0x06070012, 0x06070013 or 0x06070010",
         for_each(lambda t: LENGTHS, partial(check_segment, codes=LENGTH_CODES, is_announced=True))),
    Case("3.14", "segments differ from the announced length", "7.2.4.3.4, table 22",
         "too many or too few bytes are refused with 0x0607001x, and the object is unchanged",
         for_each(lambda t: LENGTHS, partial(check_segment, codes=LENGTH_CODES))),
    Case("3.15", "the client stops in the middle", "7.2.4.3.17, table 22",
         "no frame but an abort 0x05040000, and the server answers the next request", check_timeout),
    Case("3.16", "requests of the wrong length", "7.2.4.3",
         "a frame with fewer than 8 bytes is no request: no data in answer", check_short_requests),
    Case("3.17", "requests to other nodes", "7.3.3", "the server answers only its own COB-ID", check_foreign_requests),
    Case("3.18", "aborts name the object", "7.2.4.3.17", "index and sub-index of the request are in the abort",
         for_each(lambda t: ((0x1000, 0xFE), (0x1018, 0xFD)), check_abort_object)),
)
