"""Chapter 3: the SDO server, frame by frame: transfers, toggle bits, aborts, lengths, malformed requests."""
from __future__ import annotations

from rig.conformance.conformance_case import (
    CaseFailed,
    CaseNotApplicable,
    case,
    join_labels,
    require,
    require_applicable,
)
from rig.conformance.data_sheet import DOMAIN, Variable
from rig.conformance.target import (
    COMMAND,
    HEAD,
    TIMED_OUT,
    TOGGLE,
    TOO_LONG,
    TOO_SHORT,
    WRONG_LENGTH,
    Refusal,
    Target,
    format_abort,
)

LENGTH_CODES = (TOO_LONG, TOO_SHORT, WRONG_LENGTH)
READ_TYPE = HEAD.pack(0x40, 0x1000, 0) + bytes(4)


@case("3.1", "expedited upload", "7.2.4.3.6", "one frame: 0x43, object, four bytes of data with their number")
def check_expedited_upload(t: Target) -> str:
    """The device type, which every node has."""
    response = t.demand(READ_TYPE)
    require(response[0] >> 5 == 2 and response[0] & 2 != 0, f"not expedited: {response.hex(' ')}")
    require(response[1:4] == READ_TYPE[1:4], f"another object: {response.hex(' ')}")
    require(response[0] & 0x1F == 3, f"command 0x{response[0]:02X}, expected 0x43: four bytes, size indicated")
    return response.hex(" ")


@case("3.2", "expedited download", "7.2.4.3.3", "one frame: 0x60, object, four bytes 0; the value is in force")
def check_expedited_download(t: Target) -> str:
    """The producer heartbeat time is changed and changed back."""
    variable = find_harmless(t)
    with t.restore_afterwards(variable):
        old = t.read(variable.index, variable.sub)
        data = variable.encode(_other_value(variable, old))
        request = HEAD.pack(0x23 | (4 - len(data)) << 2, variable.index, variable.sub) + data.ljust(4, b"\0")
        response = t.demand(request)
        require(response == HEAD.pack(0x60, variable.index, variable.sub) + bytes(4), response.hex(" "))
        require(t.upload(variable.index, variable.sub) == data, f"{variable.label} does not hold what was written")
    require(t.read(variable.index, variable.sub) == old, f"{variable.label} cannot be set back")
    return response.hex(" ")


@case("3.3", "expedited download without a length", "7.2.4.3.3",
      "accepted, and the object takes the bytes it needs (s = 0)")
def check_download_without_length(t: Target) -> str:
    """The bit that announces the number of bytes is 0."""
    variable = find_harmless(t)
    with t.restore_afterwards(variable):
        data = variable.encode(_other_value(variable, t.read(variable.index, variable.sub)))
        response = t.demand(HEAD.pack(0x22, variable.index, variable.sub) + data.ljust(4, b"\0"))
        require(response[:4] == HEAD.pack(0x60, variable.index, variable.sub), response.hex(" "))
        require(t.upload(variable.index, variable.sub) == data, f"{variable.label} does not hold what was written")
    return response.hex(" ")


@case("3.4", "segmented upload", "7.2.4.3.6, 7.2.4.3.7",
      "the length is announced and kept; toggle bit from 0; the last segment is marked")
def check_segmented_upload(t: Target) -> str:
    """An object of more than four bytes."""
    variable, _ = find_long_readable(t)
    response = t.demand(HEAD.pack(0x40, variable.index, variable.sub) + bytes(4))
    require(response[0] == 0x41, f"{variable.label}: {response.hex(' ')}, expected 0x41: the length is announced")
    announced = int.from_bytes(response[4:], "little")
    length, toggle, count = 0, 0, 0
    while True:
        response = t.demand(bytes((0x60 | toggle,)) + bytes(7))
        count += 1
        require(response[0] & 0xF0 == toggle, f"segment {count}: {response.hex(' ')}, expected toggle {toggle >> 4}")
        length += 7 - (response[0] >> 1 & 7)
        toggle ^= 0x10
        if response[0] & 1:
            break
        require(length < announced, f"{length} bytes came, {announced} were announced, and no last segment")
    require(length == announced, f"{length} bytes came, {announced} were announced")
    return f"{variable.label}: {length} bytes in {count} segments"


@case("3.5", "segmented download", "7.2.4.3.3, 7.2.4.3.4",
      "each segment is confirmed with its toggle bit; the value is kept")
def check_segmented_download(t: Target) -> str:
    """The value read is written back in segments: an object of more than four bytes, or else a short one."""
    variable = _find_long_writable(t)
    if variable is None:
        variable = find_harmless(t)
        code = t.find_abort(HEAD.pack(0x21, variable.index, variable.sub) + variable.size.to_bytes(4, "little"))
        if code == COMMAND:
            raise CaseNotApplicable("no object needs segments, and the server refuses them")
        t.send(t.request_id, HEAD.pack(0x80, variable.index, variable.sub) + bytes(4))
    data = t.upload(variable.index, variable.sub)
    t.download(variable.index, variable.sub, data, segmented=True)
    require(t.upload(variable.index, variable.sub) == data, f"{variable.label} holds another value then")
    return f"{variable.label}: {len(data)} bytes"


@case("3.6", "toggle bit wrong in an upload", "7.2.4.3.7, table 22", "abort 0x05030000, and the transfer is over")
def check_upload_toggle(t: Target) -> str:
    """The second segment is asked for with the toggle bit of the first."""
    variable, data = find_long_readable(t)
    t.demand(HEAD.pack(0x40, variable.index, variable.sub) + bytes(4))
    wrong = 0x60
    if len(data) > 7:
        t.demand(b"\x60".ljust(8, b"\0"))
    else:
        wrong = 0x70
    code = t.find_abort(bytes((wrong,)) + bytes(7))
    require(code == TOGGLE, format_abort(code))
    after = t.find_abort(b"\x70".ljust(8, b"\0"))
    require(after != 0, "the transfer goes on after the abort")
    return format_abort(code)


@case("3.7", "toggle bit wrong in a download", "7.2.4.3.4, table 22", "abort 0x05030000, and the object is unchanged")
def check_download_toggle(t: Target) -> str:
    """The first segment comes with toggle bit 1."""
    variable = find_harmless(t)
    before = t.upload(variable.index, variable.sub)
    offered = variable.encode(_other_value(variable, int.from_bytes(before, "little")))
    with t.restore_afterwards(variable):
        _begin_segmented_download(t, variable)
        code = t.find_abort(bytes((0x10 | (7 - len(offered)) << 1 | 1,)) + offered.ljust(7, b"\0"))
        require(code == TOGGLE, format_abort(code))
        require(t.upload(variable.index, variable.sub) == before, f"{variable.label} was changed")
    return format_abort(code)


@case("3.8", "segment without a transfer", "7.2.4.3.17, table 22", "abort 0x05040001")
def check_stray_segments(t: Target) -> str:
    """Segments of an upload and of a download that nobody began."""
    codes = [t.find_abort(bytes((command,)) + bytes(7)) for command in (0x60, 0x00)]
    require(codes == [COMMAND, COMMAND], " and ".join(map(format_abort, codes)))
    return "upload and download: " + format_abort(COMMAND)


@case("3.9", "unknown command specifier", "7.2.4.3.17, table 22", "abort 0x05040001")
def check_unknown_command(t: Target) -> str:
    """Command specifier 7 does not exist."""
    code = t.find_abort(HEAD.pack(0xE0, 0x1000, 0) + bytes(4))
    require(code == COMMAND, format_abort(code))
    return format_abort(code)


@case("3.10", "block transfer", "7.2.4.3.9, 7.2.4.3.13",
      "offered, or refused with 0x05040001 so that the client falls back")
def check_block_transfer(t: Target) -> str:
    """Block transfer is optional. Where it is offered it is not tested further."""
    requests = {"upload": HEAD.pack(0xA4, 0x1000, 0) + bytes((127, 0, 0, 0)),
                "download": HEAD.pack(0xC6, 0x1017, 0) + (2).to_bytes(4, "little")}
    found = []
    for what, request in requests.items():
        code = t.find_abort(request)
        if not code:
            t.send(t.request_id, HEAD.pack(0x80, *HEAD.unpack_from(request)[1:]) + bytes(4))
            t.wait(0.01)
        require(code in (0, COMMAND), f"block {what}: {format_abort(code)}")
        found.append(f"{what} {'offered' if not code else 'refused'}")
    require(t.find_abort(READ_TYPE) == 0, "the server does not answer normal requests any more")
    return ", ".join(found)


@case("3.11", "abort by the client", "7.2.4.3.17", "no answer, and the transfer is over")
def check_client_abort(t: Target) -> str:
    """In the middle of an upload."""
    variable, _ = find_long_readable(t)
    t.demand(HEAD.pack(0x40, variable.index, variable.sub) + bytes(4))
    answer = t.ask(HEAD.pack(0x80, variable.index, variable.sub) + (0x08000000).to_bytes(4, "little"), 0.1)
    require(answer is None, f"an abort was answered with {answer.hex(' ') if answer else ''}")
    code = t.find_abort(b"\x60".ljust(8, b"\0"))
    require(code == COMMAND, f"the next segment: {format_abort(code)}")
    return "no answer; the next segment: " + format_abort(code)


@case("3.12", "a transfer that is not finished", "7.2.4.3", "a new request to another object is answered")
def check_unfinished_transfer(t: Target) -> str:
    """The client loses interest in a segmented transfer and asks for something else."""
    variable, _ = find_long_readable(t)
    t.demand(HEAD.pack(0x40, variable.index, variable.sub) + bytes(4))
    codes = [t.find_abort(READ_TYPE), t.find_abort(READ_TYPE)]  # a server may abort the old transfer first
    require(codes[1] == 0, f"{format_abort(codes[0])}, then {format_abort(codes[1])}")
    return "answered" if not codes[0] else f"answered after {format_abort(codes[0])}"


@case("3.13", "announced length differs from the object", "7.2.4.3.3, table 22",
      "refused with 0x06070012, 0x06070013 or 0x06070010")
def check_announced_length(t: Target) -> str:
    """A segmented download announces one byte more, and one less, than the object has."""
    variable = find_harmless(t)
    found = []
    with t.restore_afterwards(variable):
        data = t.upload(variable.index, variable.sub)
        for offered, what in ((data + b"\0", "one more"), (data[:-1], "one less")):
            try:
                t.download(variable.index, variable.sub, offered, segmented=True)
            except Refusal as refusal:
                require(refusal.code in LENGTH_CODES, f"{what}: {format_abort(refusal.code)}")
                found.append(f"{what}: 0x{refusal.code:08X}")
            else:
                raise CaseFailed(f"{what}: accepted")
    return ", ".join(found)


@case("3.14", "segments differ from the announced length", "7.2.4.3.4, table 22",
      "too many or too few bytes are refused with 0x0607001x, and the object is unchanged")
def check_segment_length(t: Target) -> str:
    """The length announced is right, the last segment has a byte more or less."""
    found = []
    variable = find_harmless(t)
    before = t.upload(variable.index, variable.sub)
    other = variable.encode(_other_value(variable, int.from_bytes(before, "little")))
    for offered, what in ((other + b"\0", "one more"), (other[:-1], "one less")):
        with t.restore_afterwards(variable):
            _begin_segmented_download(t, variable)
            code = t.find_abort(bytes(((7 - len(offered)) << 1 | 1,)) + offered.ljust(7, b"\0"))
            require(code in LENGTH_CODES, f"{what}: {format_abort(code)}")
            require(t.upload(variable.index, variable.sub) == before, f"{variable.label} was changed")
        found.append(f"{what}: 0x{code:08X}")
    return ", ".join(found)


@case("3.15", "the client stops in the middle", "7.2.4.3.17, table 22",
      "no frame but an abort 0x05040000, and the server answers the next request")
def check_timeout(t: Target) -> str:
    """Six seconds without a segment. CiA 301 does not say after what time a server gives up."""
    variable, _ = find_long_readable(t)
    t.demand(HEAD.pack(0x40, variable.index, variable.sub) + bytes(4))
    start = t.now()
    frames = t.listen(6.0, t.response_id)
    for frame in frames:
        code = int.from_bytes(frame.data[4:], "little") if frame.data[:1] == b"\x80" else 0
        require(code == TIMED_OUT, f"frame {frame.data.hex(' ')}")
    require(len(frames) <= 1, f"{len(frames)} aborts")
    require(t.find_abort(READ_TYPE) == 0, "the next request is refused")
    return f"abort after {(frames[0].t_ns - start) * 1e-9:.2f} s" if frames else "the server waits on"


@case("3.16", "requests of the wrong length", "7.2.4.3",
      "a frame with fewer than 8 bytes is no request: no data in answer")
def check_short_requests(t: Target) -> str:
    """None of them may be taken for a complete one, or stop the server."""
    answered = 0
    for length in range(8):
        answer = t.ask(READ_TYPE[:length], 0.05)
        if answer is not None:
            answered += 1
            require(answer[:1] == b"\x80", f"{length} bytes were answered with {answer.hex(' ')}")
    require(t.find_abort(READ_TYPE) == 0, "the next request is refused")
    return f"8 frames, {answered or 'none'} answered"


@case("3.17", "requests to other nodes", "7.3.3", "the server answers only its own COB-ID")
def check_foreign_requests(t: Target) -> str:
    """Two node-IDs that nobody on the bus has."""
    free = t.find_free_node()
    t.send(0x600 + free, READ_TYPE)
    t.send(t.response_id, bytes(8))  # a response of somebody else is no request
    frames = t.listen(0.1, t.response_id, 0x580 + free)
    require(not frames, f"0x{frames[0].cob_id:03X} {frames[0].data.hex(' ')}" if frames else "")
    require(t.find_abort(READ_TYPE) == 0, "the next request is refused")
    return f"node {free}: no answer"


@case("3.18", "aborts name the object", "7.2.4.3.17", "index and sub-index of the request are in the abort")
def check_abort_object(t: Target) -> str:
    """So that a client can tell which of its requests failed."""
    found = []
    for index, sub in ((0x1000, 0xFE), (0x1018, 0xFD)):
        try:
            t.upload(index, sub)
        except Refusal:
            frame = [frame for frame in t.frames if frame.cob_id == t.response_id][-1]
            is_named = frame.data[1:4] == HEAD.pack(0, index, sub)[1:]
            require(is_named, f"asked 0x{index:04X}:{sub:X}: {frame.data.hex(' ')}")
            found.append(f"0x{index:04X}:{sub:X}")
        else:
            raise CaseFailed(f"0x{index:04X}:{sub:X} was not refused")
    return join_labels(found)


def find_harmless(t: Target) -> Variable:
    """A number of more than one byte that may be changed without harm. Raises CaseNotApplicable."""
    for index, sub in ((0x1017, 0), (0x1016, 1), (0x1006, 0)):
        if t.sheet.is_writable(index, sub):
            return t.variable(index, sub)
    raise CaseNotApplicable("the EDS has no writable 0x1017, 0x1016 or 0x1006")


def find_long_readable(t: Target) -> tuple[Variable, bytes]:
    """A readable object of more than four bytes, and what it holds. Raises CaseNotApplicable."""
    candidates = [variable for variable in t.sheet.variables if variable.is_readable
                  and (variable.size > 4 or not variable.size) and variable.data_type != DOMAIN]
    candidates.sort(key=lambda variable: not variable.is_communication)
    best: tuple[Variable, bytes] | None = None
    for variable in candidates:
        try:
            data = t.upload(variable.index, variable.sub)
        except Refusal:
            continue
        if len(data) > 7:
            return variable, data
        if len(data) > 4 and best is None:
            best = variable, data
    require_applicable(best, "no object has more than four bytes")
    assert best is not None
    return best


def _find_long_writable(t: Target) -> Variable | None:
    return next((variable for variable in t.sheet.variables if variable.is_writable and variable.is_readable
                 and variable.size > 4 and not variable.is_active), None)


def _other_value(variable: Variable, value: int) -> int:
    """A value that differs, within the limits of the object."""
    for offered in (value + 1, value - 1):
        is_inside = (variable.low is None or offered >= variable.low) and (
            variable.high is None or offered <= variable.high)
        if is_inside and 0 <= offered < 1 << 8 * variable.size:
            return offered
    return value


def _begin_segmented_download(t: Target, variable: Variable) -> None:
    """Begin one with the right length. Raises CaseNotApplicable for a server without segments."""
    code = t.find_abort(HEAD.pack(0x21, variable.index, variable.sub) + variable.size.to_bytes(4, "little"))
    if code == COMMAND and _find_long_writable(t) is None:
        raise CaseNotApplicable("no object needs segments, and the server refuses them")
    require(code == 0, f"the transfer was refused: {format_abort(code)}")
