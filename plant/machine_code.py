"""Machine code stored on disk so that it runs without numba: one cycle of the plant, and cycles of a whole bench.

Importing numba and loading its cache takes 0.6 s, half of a test run of 13.5 s. numba still compiles the code; what
it has compiled is stored as an object file, and the next process links that with LLVM alone, in 0.05 s. Where this is
not possible (code that calls something besides `sqrt`, a file that is damaged or of other versions), numba runs as
before: the bits of the results are the same, because the code is.
"""

import contextlib
import ctypes
import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
# numba's calling convention: address of the result, of the failure, then the arguments, an array as 7 of them
ADVANCE_CALL = "i" + "qq" + "qqqqqqq" + "dddd" + "qqqqqqq" + "q"
READ_CALL = "i" + "qq" + "qqqqqqq" + "qqqqqqq" + "d" + "qqqqqqq"
Call = Callable[..., object]

_SYMBOL = "entry"  # of the code in a file
_DIGEST = 32  # bytes of the SHA-256 in front of the object code
_KNOWN = {"sqrt", "memset", "memcpy", "memmove"}  # what the code may call outside itself; LLVM finds these anywhere


class StoredCode:
    """Machine code of one function of numbers and arrays, such as `plant.solve.advance_flat_state` of a kind of plant.

    It comes from a file in `folder`; without one, numba compiles it and the result is stored there.
    """

    def __init__(self, folder: Path, compile_code: Callable[[], Any], name: str = "advance") -> None:
        """`compile_code` returns numba's dispatcher; `folder` is for this source code alone."""
        self._path = folder / f"{name}.{_name_environment()}.o"
        self._compile = compile_code
        self._engine: Any = None  # owns the code
        code = _read_object(self._path)
        if code is not None and not os.environ.get("NUMBA_DISABLE_JIT"):
            with contextlib.suppress(Exception):  # whatever LLVM has against the file, numba can compile it again
                self._engine = _link_object(code)

    def warm(self, make_arguments: Callable[[], Sequence[Any]]) -> None:
        """Compile with numba and store the machine code for the next process, unless it was stored already.

        `make_arguments` gives arguments for a trial: each time new arrays with the same content.
        """
        if self._engine is None:
            run = self._compile()
            run(*make_arguments())
            with contextlib.suppress(Exception):  # another release of numba may name its inner parts otherwise
                code = emit_object(run)
                if code is not None and _gives_same_bits(code, run, make_arguments):
                    self._engine = _link_object(code)
                    _write_object(self._path, code)

    def find_address(self) -> int:
        """Address of the machine code, for a `plant.compile.ForeignCall`; call `warm` before."""
        if self._engine is not None:
            return int(self._engine.get_function_address(_SYMBOL))
        return find_function_address(self._compile())

    def bind(self, head: Sequence[Any], count: int = 0, tail: Sequence[Any] = ()) -> Call:
        """The function of `count` floats, which stand between the arguments `head` and `tail`. Arrays are shared."""
        if self._engine is None:
            run = self._compile()
            return lambda *numbers: run(*head, *numbers, *tail)
        entry = _make_entry(self._engine, (*head, *[0.0] * count, *tail))
        first, last = _list_places(head), [value for _, value in _flatten(tail)]

        def call(*numbers: float) -> None:
            if entry(*first, *numbers, *last) != 0:  # an exception; numba knows how to raise it
                self._compile()(*head, *numbers, *tail)

        return call


def find_function_address(run: Any) -> int:
    """Address of what numba has compiled for a dispatcher with one signature."""
    (overload,) = run.overloads.values()
    return int(overload.library.get_pointer_to_function(overload.fndesc.llvm_func_name))


def _gives_same_bits(code: bytes, run: Any, make_arguments: Callable[[], Sequence[Any]]) -> bool:
    """Whether the object code changes arrays as numba's function does; else it is not to be stored."""
    engine, numba_arguments, code_arguments = _link_object(code), make_arguments(), make_arguments()
    run(*numba_arguments)
    status = _make_entry(engine, code_arguments)(*_list_places(code_arguments))
    arrays = zip(_list_arrays(numba_arguments), _list_arrays(code_arguments), strict=True)
    return status == 0 and all(one.tobytes() == other.tobytes() for one, other in arrays)


# The interpreter lock is kept: the call is short, and another thread that gets the lock may keep it for longer.
def _make_entry(engine: Any, arguments: Sequence[Any]) -> Call:
    """The code in the engine as a function of what `_list_places` gives; it returns 0, or not 0 for an exception."""
    make = ctypes.PYFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p,
                             *(kind for kind, _ in _flatten(arguments)))
    return make(engine.get_function_address(_SYMBOL))


def _list_places(arguments: Sequence[Any]) -> list[Any]:
    """Room for a result and for a failure, then the arguments as the machine code takes them."""
    room = (ctypes.c_int64(), ctypes.c_int64())
    return [*map(ctypes.byref, room), *(value for _, value in _flatten(arguments))]


def _flatten(arguments: Sequence[Any]) -> list[tuple[Any, Any]]:
    """Type and value of each word: of an array owner, parent, items, bytes an item, data, lengths, strides."""
    words: list[tuple[Any, Any]] = []
    for one in arguments:
        if isinstance(one, np.ndarray):
            words += [(ctypes.c_void_p, None), (ctypes.c_void_p, None), (ctypes.c_int64, one.size),
                      (ctypes.c_int64, one.dtype.itemsize), (ctypes.c_void_p, one.ctypes.data),
                      *((ctypes.c_int64, n) for n in (*one.shape, *one.strides))]
        elif isinstance(one, tuple):
            words += _flatten(one)
        else:
            words.append((ctypes.c_double if isinstance(one, float) else ctypes.c_int64, one))
    return words


def _list_arrays(arguments: Sequence[Any]) -> list[Array]:
    return [each for one in arguments for each in (_list_arrays(one) if isinstance(one, tuple) else [one])
            if isinstance(each, np.ndarray)]


def _name_environment() -> str:
    """A hash of what machine code depends on besides its source: CPU, LLVM, numba and its settings, this file."""
    import llvmlite
    from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

    numba = find_spec("numba")
    version = Path(numba.origin).with_name("_version.py").read_bytes() if numba and numba.origin else b""
    settings = sorted((key, value) for key, value in os.environ.items() if key.startswith("NUMBA_"))
    parts = (llvmlite.__version__, get_host_cpu_name(), get_host_cpu_features().flatten(), settings, np.__version__)
    return hashlib.sha256(repr(parts).encode() + version + Path(__file__).read_bytes()).hexdigest()[:20]


def _read_object(path: Path) -> bytes | None:
    """The object code in the file; None if there is none or it is damaged (LLVM would end the process)."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    return data[_DIGEST:] if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST] else None


def _write_object(path: Path, code: bytes) -> None:
    """Store object code at once: another process sees the whole file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(code).digest() + code)
        Path(name).replace(path)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise


def emit_object(run: Any, symbol: str = _SYMBOL, triple: str = "") -> bytes | None:
    """The compiled function of a dispatcher alone, without its way in from Python; None if it needs numba to run.

    Args:
        run: numba's dispatcher of a function that was compiled for one signature.
        symbol: its name in the object code.
        triple: the machines to emit code for, as LLVM calls them, every CPU of the kind; "" for this CPU alone.
    """
    import llvmlite.binding as llvm

    overloads = list(getattr(run, "overloads", {}).values())
    if len(overloads) != 1:
        return None
    library = overloads[0].library
    module = llvm.parse_bitcode(library._get_module_for_linking().as_bitcode())
    machine = library.codegen._tm
    if triple:
        # nobody owns the arrays that the code gets: counting who uses them, which needs numba, does nothing
        module = llvm.parse_assembly(re.sub(r"(?m)^ *(tail )?call void @NRT_(inc|dec)ref\(.*$", "", str(module)))
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        machine = llvm.Target.from_triple(triple).create_target_machine(opt=3, reloc="pic", codemodel="default")
        module.triple, module.data_layout = triple, str(machine.target_data)
    # numba counts who uses an array and calls this for the last one; the arrays that this code gets have no owner
    module.link_in(llvm.parse_assembly("define void @NRT_MemInfo_call_dtor(ptr %owner) { ret void }"))
    target = module.get_function(overloads[0].fndesc.llvm_func_name)
    for value in (*module.functions, *module.global_variables):
        if not value.is_declaration:
            value.linkage = "internal"
    target.linkage = "external"
    target.name = symbol
    if triple:
        target.visibility = "hidden"  # a library of the process may have a function of the same name
    manager = llvm.create_new_module_pass_manager()
    manager.add_global_dead_code_eliminate_pass()
    manager.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    foreign = {value.name for value in (*module.functions, *module.global_variables) if value.is_declaration}
    if any(name not in _KNOWN and not name.startswith("llvm.") for name in foreign):
        return None
    return bytes(machine.emit_object(module))


def _link_object(code: bytes) -> Any:
    """LLVM's engine with the object code in it."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine
