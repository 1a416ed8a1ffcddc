"""Compiles the physics, which is plain Python: the only file that imports numba (machine_code.py stores the result).

The physics is ordinary functions on floats and named tuples. `compile_function` links a function with everything that
it calls, replaces the port functions by the model's effects, and compiles all of it as one inlined function: a call
that passes the state through memory costs as much as the step. The machine code is stored under a hash of all sources
that went in, so a changed effect never meets stale code. numba's own cache looks at one file only.
"""

import atexit
import contextlib
import dis
import fcntl
import gc
import hashlib
import math
import os
import shutil
import stat
import tempfile
from abc import ABC, abstractmethod
from collections import namedtuple
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import cache, partial, reduce
from itertools import takewhile
from operator import getitem
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np

from plant import functions

Function = Any  # a plain function, or numba's dispatcher of one
AnyFunction = TypeVar("AnyFunction", bound=Callable[..., Any])


class CompiledCall(ABC):
    """A call that compiled code has instructions of its own for; its content is its fingerprint."""

    @abstractmethod
    def declare(self) -> Any:
        """What numba compiles into the call."""


@dataclass(frozen=True)
class ForeignCall(CompiledCall):
    """A call of machine code that is not ours, for compiled code: of a function of the C library, or by address.

    Code that calls the library by name can be stored on disk, which is not so for a function pointer of ctypes. A loop
    that calls the plant by its address, `call(address, arguments..)`, is compiled once for all plants.
    """

    signature: str  # type of the result, then of the arguments: i 32-bit integer; q 64-bit, size or address; d double
    name: str = ""  # of the function of the C library

    def __call__(self, *arguments: float) -> int:
        raise TypeError(f"{self}: only compiled code can call it")

    def declare(self) -> Any:
        """What numba compiles into the call."""
        import llvmlite.ir
        import numba.extending

        kinds: dict[str, Any] = {"i": numba.types.int32, "q": numba.types.int64, "d": numba.types.float64}
        result, *arguments = (kinds[letter] for letter in self.signature)
        if self.name:
            return numba.types.ExternalFunction(self.name, result(*arguments))

        def type_call(call_arguments: tuple[Any, ...]) -> Any:
            def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                types = [context.get_value_type(kind) for kind in (result, *arguments)]
                pointer = llvmlite.ir.FunctionType(types[0], types[1:]).as_pointer()
                return builder.call(builder.inttoptr(values[0], pointer), values[1:])

            return result(numba.types.int64, *arguments), code

        names = ", ".join(f"a{i}" for i in range(len(arguments)))
        namespace: dict[str, Any] = {"type_call": type_call}
        exec(f"def call_{self.signature}(context, address, {names}):\n    return type_call((address, {names}))",
             namespace)
        return numba.extending.intrinsic(namespace[f"call_{self.signature}"])


@dataclass(frozen=True, eq=False)
class ReadRecord(CompiledCall):
    """`(array, place) -> record` of type `kind`: float i is number (first + i) * apart + place of the array.

    The record is a copy, which the compiler keeps in registers; laws get its address. Rejected alternatives: a tuple of
    two hundred numbers passed to each law doubles the time to compile; with the address in the array itself the
    compiler turns a choice of two numbers into a choice of two addresses, and then makes no vector code.
    """

    kind: np.dtype[Any]
    first: int
    apart: int

    def declare(self) -> Any:
        """What numba compiles into the call."""
        import numba.core.cgutils
        import numba.extending

        record, count = numba.from_dtype(self.kind), self.kind.itemsize // np.dtype(float).itemsize

        def read(typing: Any, array: Any, place: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                point_at = _make_pointer(context, builder, signature.args, values, self.apart)
                number = context.get_value_type(numba.float64)
                copy = numba.core.cgutils.alloca_once(builder, number, count)  # type: ignore[no-untyped-call]
                for i in range(count):
                    there = builder.gep(copy, [context.get_constant(numba.intp, i)])
                    builder.store(builder.load(point_at(self.first + i)), there)
                return builder.bitcast(copy, context.get_value_type(record))

            return record(array, place), code

        return numba.extending.intrinsic(read)


@dataclass(frozen=True, eq=False)
class KeepTuple(CompiledCall):
    """`(x, array, place)`: puts the numbers of a tuple into an array.

    `places` is a tuple like `x` that says which number of the array each one is, and -1 for one that is not kept;
    number i is at i * apart + place. Written out as Python, such calls took a quarter of the time to compile a kernel.
    """

    places: Any
    apart: int = 1

    def __call__(self, x: Any, array: Any, place: int) -> None:
        """The same in plain Python."""
        for path, number in list_kept_numbers(self.places):
            array[number * self.apart + place] = reduce(getitem, path, x)

    def declare(self) -> Any:
        """What numba compiles into the call."""
        import numba.extending

        def keep(typing: Any, x: Any, array: Any, place: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                point_at = _make_pointer(context, builder, signature.args[1:], values[1:], self.apart)
                for path, number in list_kept_numbers(self.places):
                    value = builder.extract_value(values[0], path) if path else values[0]
                    kind = reduce(getitem, path, x)
                    builder.store(context.cast(builder, value, kind, numba.float64), point_at(number))
                return context.get_dummy_value()

            return numba.void(x, array, place), code

        return numba.extending.intrinsic(keep)


@dataclass(frozen=True, eq=False)
class LoadTuple(CompiledCall):
    """`(array, place) -> x`: the tuple that `KeepTuple` has put there; what is not kept is 0.0."""

    places: Any
    apart: int = 1

    def __call__(self, array: Any, place: int) -> Any:
        """The same in plain Python."""
        return map_numbers(lambda number: 0.0 if number < 0 else array[number * self.apart + place], self.places)

    def declare(self) -> Any:
        """What numba compiles into the call."""
        import numba.extending

        kind = numba.typeof(map_numbers(float, self.places))  # type: ignore[no-untyped-call]

        def load(typing: Any, array: Any, place: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                point_at = _make_pointer(context, builder, signature.args, values, self.apart)
                x = context.get_constant_null(kind)
                for path, number in list_kept_numbers(self.places):
                    value = builder.load(point_at(number))
                    x = builder.insert_value(x, value, path) if path else value
                return x

            return kind(array, place), code

        return numba.extending.intrinsic(load)


def map_numbers(change: Callable[[Any], Any], x: Any) -> Any:
    """A tuple like `x`, which may be nested, of its numbers as `change` makes them. A number is one itself."""
    if not isinstance(x, tuple):
        return change(x)
    parts = [map_numbers(change, part) for part in x]
    return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)


def list_kept_numbers(places: Any, path: tuple[int, ...] = ()) -> list[tuple[tuple[int, ...], int]]:
    """The indices that lead to each number of nested tuples, and the number, without those below 0."""
    if not isinstance(places, tuple):
        return [(path, places)] if places >= 0 else []
    return [kept for i, part in enumerate(places) for kept in list_kept_numbers(part, (*path, i))]


def _make_pointer(context: Any, builder: Any, kinds: Any, values: Any, apart: int) -> Callable[[int], Any]:
    """`point_at(number)`: address of number * apart + place in an array of floats; `values` are the array and place."""
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    return lambda number: builder.gep(data, [builder.add(values[1], context.get_constant(kinds[1], number * apart))])


# numpy's tables of the ziggurat of the normal distribution: 256 layers, and where the tail begins
NormalTables = namedtuple("NormalTables", "k w f r inverse_r")


def read_normal_tables() -> NormalTables:
    """The tables with which NumPy's generator draws normal numbers, which numba has a copy of."""
    import numba.np.random._constants as numbers

    return NormalTables(numbers.ki_double.tolist(), numbers.wi_double.tolist(), numbers.fi_double.tolist(),
                        float(numbers.ziggurat_nor_r), float(numbers.ziggurat_nor_inv_r))


def find_cache_folder() -> Path:
    """The folder of compiled code: $EHA_RIG_CACHE, else the user's cache folder, else a temporary one."""
    home = Path(os.environ.get("EHA_RIG_CACHE")
                or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eha-rig")
    try:
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=home):
            return home
    except OSError:
        return make_private_folder(Path(tempfile.gettempdir()) / f"eha-rig-{os.getuid()}")


def make_private_folder(path: Path) -> Path:
    """A folder that only this user can write: code is loaded from it. Another one if somebody else has taken `path`."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    status = path.lstat()
    is_private = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022
    return path if is_private else _make_folder_of_process()


@cache
def _make_folder_of_process() -> Path:
    """A folder that is deleted when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix="eha-rig-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def rebind_names(function: Function, **names: Any) -> Function:
    """A copy of `function` that sees `names` in place of its module's globals."""
    # said to be at home here: numba imports that home again when it reads its cache, and a user's file is no module
    copy = FunctionType(function.__code__, function.__globals__ | names | {"__name__": __name__}, function.__name__,
                        function.__defaults__, function.__closure__)
    vars(copy).update(vars(function))
    return copy


def interpret_function(function: Function, ports: Mapping[str, Function] | None = None) -> Function:
    """`function` with `ports` bound, in plain Python: for debuggers and comparisons with compiled code."""
    return _link_calls(function, ports or {}, lambda f: f)


def compile_function(function: Function, ports: Mapping[str, Function] | None = None, family: Hashable = None
                     ) -> Function:
    """`function` and all functions that it calls, with `ports` bound, as machine code that is cached on disk.

    In a process numba types and translates a function only once for all kernels of a `family`. Those that take other
    records of parameters are no family: numba takes a record for another one that begins with its fields, and warns.
    """
    import numba.core.compiler_lock  # here and below: who only reads a trace need not load it, which takes 0.3 s

    _set_up_llvm()
    linked_root = _link_calls(function, ports or {}, partial(_declare_part_once, family), _declare_call_once)
    settings: Any = numba.config
    folder = find_code_folder(function, ports)
    with numba.core.compiler_lock.global_compiler_lock:  # the folder is a setting of the whole process
        before, settings.CACHE_DIR = settings.CACHE_DIR, str(folder)
        try:
            kernel = numba.njit(rebind_names(linked_root.py_func), cache=True, nogil=True, error_model="numpy")
        finally:
            settings.CACHE_DIR = before
    _compile_in_one_process(kernel, folder)
    return kernel


@cache
def _set_up_llvm() -> None:
    """Have LLVM make vector code of loops of eight turns, in registers of 512 bits where the CPU has them.

    It leaves loops of fewer than 16 turns alone, as one of unknown size might not earn what goes before it. And it
    prefers 256 bits on most of these CPUs, as few wide operations slow down all that is around them; here all are wide.
    What its third level of optimisation does beyond the second took a fifth of the time and made no kernel faster.
    """
    import llvmlite.binding
    import numba

    settings: Any = numba.config
    llvmlite.binding.set_option("", "-vectorizer-min-trip-count=8")
    settings.OPT = type(settings.OPT)(2)
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f") and settings.CPU_FEATURES is None:
        settings.CPU_FEATURES = f"{features.flatten()},-prefer-256-bit"


def _compile_in_one_process(dispatcher: Any, folder: Path) -> None:
    """Let one process at a time compile or load the code of a folder: the next one finds it stored."""
    compile_here = dispatcher.compile

    def compile_alone(signature: Any) -> Any:
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((folder / "lock").open("w"))  # closing it, also by a kill, frees it
                fcntl.flock(lock, fcntl.LOCK_EX)
            if gc.isenabled():  # a compiler makes objects that stay: to look for others takes a tenth of its time
                gc.disable()
                stack.callback(gc.enable)
            return compile_here(signature)

    dispatcher.compile = compile_alone


def find_code_folder(function: Function, ports: Mapping[str, Function] | None = None) -> Path:
    """The folder for the machine code of what `compile_function` compiles; its name is a hash of all that goes in."""
    return find_cache_folder() / compute_fingerprint(interpret_function(function, ports))


def keep_apart(function: AnyFunction) -> AnyFunction:
    """Mark a function that compiled code calls instead of including it wherever it is called.

    For what does not compute: to include the whole of a bus at each of its calls takes a minute to compile.
    """
    vars(function)["is_apart"] = True
    return function


def bind_later(function: AnyFunction) -> AnyFunction:
    """Mark a function that stands for another one, which is bound to its name when its caller is compiled."""
    vars(function)["is_bound_later"] = True
    return function


@bind_later
def raise_unbound(*arguments: Any) -> Any:
    """Stands for any function that is bound later; each place gives it a name of its own."""
    raise TypeError("no function is bound")


_PARTS: dict[Hashable, Function] = {}  # of this process, by what they consist of


def _declare_part_once(family: Hashable, f: Function) -> Function:
    """The part that was declared for an equal function of the family before, else a new one.

    Equal are functions of the same code that name the same objects; a part keeps these, so their addresses stay theirs.
    """
    named = _find_globals(f)
    parts = *(f.__defaults__ or ()), *(cell.cell_contents for cell in f.__closure__ or ()), *named.values()
    key = family, f.__code__, vars(f).get("is_apart", False), *named, *map(id, parts)
    if key not in _PARTS:
        _PARTS[key] = _declare_part(f)
    return _PARTS[key]


@cache
def _declare_call_once(call: CompiledCall) -> Any:
    return call.declare()


def _declare_part(f: Function) -> Function:
    """A function below the one to be compiled, as numba gets it.

    No fastmath: one run and many at once, and plain Python, agree to the last bit. No way in from Python for what is
    only called by compiled code: unpacking nested tuples of a hundred numbers takes longer to compile than the physics.
    The physics does not count who uses an array; a user's law may have one of its own, as np.interp has. No code for
    each number that a call names: it becomes part of its caller, which knows the number.
    """
    import numba

    part: Any = numba.njit(  # type: ignore[call-overload]  # its stubs do not know two of the options
        f, error_model="numpy", forceinline=not vars(f).get("is_apart", False), no_cpython_wrapper=True,
        no_cfunc_wrapper=True, _nrt=not Path(f.__code__.co_filename).is_relative_to(Path(__file__).parent),
        pipeline_class=_make_part_compiler())

    def find_common_code(arguments: Any, named: Any, find_code: Any = part.get_call_template) -> Any:
        with contextlib.suppress(numba.errors.TypingError):  # of code that needs the number, as the index of a tuple
            return find_code([*map(numba.types.unliteral, arguments)], named)
        return find_code(arguments, named)

    part.get_call_template = find_common_code
    return part


@cache
def _make_part_compiler() -> Any:
    """numba's compiler without the steps that a function needs to run by itself: it is optimised as part of its caller.

    With them each function would be optimised and made machine code once more: a third of the time that the loops of a
    run take to compile.
    """
    import numba.core.codegen
    import numba.core.compiler

    core: Any = numba.core

    class Part(core.codegen.JITCodeLibrary):  # type: ignore[misc]
        """The code of such a function; nobody asks for its address."""

        codegen = SimpleNamespace(set_env=lambda name, environment: None)

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalized = True

        def get_pointer_to_function(self, name: str) -> int:
            return 0

    class Arguments(tuple[Any, ...]):
        """Types of arguments in few words: numba writes them out before each step, which for a record takes long."""

        def __repr__(self) -> str:
            return f"{len(self)} arguments"

    class PartCompiler(core.compiler.Compiler):  # type: ignore[misc]
        def define_pipelines(self) -> Any:
            self.state.args = Arguments(self.state.args)
            self.state.library = Part(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
            return super().define_pipelines()

    return PartCompiler


def _link_calls(function: Function, ports: Mapping[str, Function], make: Callable[[Function], Function],
                declare: Callable[[CompiledCall], Any] = lambda call: call) -> Function:
    """Copy the call graph below `function`; functions marked by `bind_later` are replaced by those of `ports`.

    Each copy goes through `make`, each call with instructions of its own through `declare`.
    """
    copies: dict[Function, Function] = {}

    def link(f: Function) -> Function:
        f = getattr(f, "py_func", f)  # an @njit function is welcome too
        if not isinstance(f, FunctionType):
            return declare(f) if isinstance(f, CompiledCall) else f
        if f not in copies:
            calls = {name: link(ports.get(name, g) if "is_bound_later" in vars(g) else g)
                     for name, g in _find_calls(f).items()}
            external = {name: declare(g) for name, g in _find_globals(f).items() if isinstance(g, CompiledCall)}
            copies[f] = make(rebind_names(f, **calls, **external, **_copy_libraries(f, link)))
        return copies[f]

    return link(function)


def _find_globals(function: Function) -> dict[str, Any]:
    """The module-level names `function` reads, with their values."""
    function = getattr(function, "py_func", function)
    return {name: function.__globals__[name] for name in _list_global_names(function.__code__)
            if name in function.__globals__}


@cache
def _list_global_names(code: CodeType) -> tuple[str, ...]:
    return tuple(sorted({i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}))


def _find_calls(function: Function) -> dict[str, Function]:
    values = {name: _find_own_version(value) for name, value in _find_globals(function).items()}
    return {name: g for name, g in values.items() if isinstance(g, FunctionType) or hasattr(g, "py_func")}


def find_called_functions(function: Function) -> dict[str, Function]:
    """All functions that `function` calls, directly or through others, by the names that the code has for them."""
    below = _find_calls(function)
    return {name: g for call in below.values() for name, g in find_called_functions(call).items()} | below


@cache
def is_costly(function: Function) -> bool:
    """Whether `function`, or one that it calls, divides or calls an elementary function."""
    plain: Any = getattr(function, "py_func", function)
    elementary = {f.__name__ for f in functions.IN_PLACE_OF} | {"sqrt"}
    divides = any(i.opname == "BINARY_OP" and i.argrepr == "/" for i in dis.get_instructions(plain.__code__))
    return (divides or not elementary.isdisjoint(plain.__code__.co_names)
            or any(map(is_costly, _find_calls(plain).values())))


def _find_own_version(value: Any) -> Any:
    """Our own version of a function of `math` or `numpy` if there is one, else the value itself."""
    is_from_library = isinstance(value, BuiltinFunctionType | np.ufunc)
    return functions.IN_PLACE_OF.get(value, value) if is_from_library else value


def _copy_libraries(function: Function, link: Callable[[Function], Function]) -> dict[str, ModuleType]:
    """`math` and `np` as `function` calls them, with our own versions, through `link`, of what it uses of theirs."""
    copies = {}
    for name, library in _find_globals(function).items():
        if library is math or library is np:
            members = {f: vars(library).get(f) for f in function.__code__.co_names}
            replacements = {f: link(_find_own_version(g)) for f, g in members.items() if _find_own_version(g) is not g}
            if replacements:
                copies[name] = _copy_library(library, tuple(replacements.items()))
    return copies


@cache
def _copy_library(library: ModuleType, replacements: tuple[tuple[str, Function], ...]) -> ModuleType:
    copy = ModuleType(library.__name__)
    copy.__dict__.update(vars(library) | dict(replacements))
    return copy


def compute_fingerprint(function: Function) -> str:
    """A hash of the code of `function` and of all it calls, with the constants, tables and fields that they name.

    It hashes the code that runs, not its file, which may have been edited since it was loaded; and this file, which
    says how the code is compiled.
    """
    hashes: dict[Function, str] = {}

    def describe_calls(f: Function) -> str:
        if f not in hashes:
            hashes[f] = ""
            calls = _find_calls(f)
            below = [f"{name}={describe_calls(g)}" for name, g in calls.items()]
            constants = [f"{name}={_describe_constant(value)}"
                         for name, value in _find_globals(f).items() if name not in calls]
            whole = "\n".join([_describe_code(f), *below, *constants])
            hashes[f] = hashlib.sha256(whole.encode()).hexdigest()
        return hashes[f]

    return hashlib.sha256((_THIS_FILE + describe_calls(function)).encode()).hexdigest()[:20]


_THIS_FILE = "".join(Path(str(file)).read_text(encoding="utf-8") for file in (__file__, functions.__file__))


def _describe_code(f: Function) -> str:
    f = getattr(f, "py_func", f)
    cells = [cell.cell_contents for cell in f.__closure__ or ()]
    parts = f.__code__, *(f.__defaults__ or ()), *cells, *vars(f).items()
    return " ".join(map(_describe_constant, parts))


def _describe_constant(value: Any) -> str:
    match value:
        case ModuleType():
            return value.__name__
        case CodeType():
            inner = " ".join(_describe_constant(constant) for constant in value.co_consts)
            return f"{value.co_code.hex()} {inner} {value.co_names} {value.co_varnames}"
        case np.ndarray():  # its repr would leave out the middle
            return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
        case type() if hasattr(value, "_fields"):  # numba's cache finds it by its name: a user's file is renamed
            return f"{value.__module__}.{value.__qualname__}{value._fields}"
    return repr(value)


@cache
def find_fields_of(function: Any, argument: str, depth: int = 1) -> frozenset[str]:
    """The fields of an argument that a function names, as x in s.x; with `depth` 2 also "group.field" in p.group.field.
    """
    code = list(dis.get_instructions(getattr(function, "py_func", function)))
    chains = ([step.argval for step in takewhile(lambda step: step.opname == "LOAD_ATTR", code[k + 1:k + 1 + depth])]
              for k, load in enumerate(code) if _name_loaded_variable(load) == argument)
    return frozenset(".".join(chain) for chain in chains if chain)


def _name_loaded_variable(instruction: Any) -> Any:
    """The local variable that an instruction puts on top of the stack, None if it loads none.

    From Python 3.13 on one instruction may handle two variables: it loads the second one last.

    >>> _name_loaded_variable(SimpleNamespace(opname="LOAD_FAST_BORROW", argval="s"))
    's'
    >>> _name_loaded_variable(SimpleNamespace(opname="STORE_FAST_LOAD_FAST", argval=("x", "s")))
    's'
    """
    if "LOAD_FAST" not in instruction.opname:
        return None
    return instruction.argval[-1] if isinstance(instruction.argval, tuple) else instruction.argval
