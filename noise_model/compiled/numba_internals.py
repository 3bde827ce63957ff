"""All of numba's private parts that kernels need, in one file; each with its reason.

numba's public `cache=True` keys a kernel by time and size of its file. It misses a kernel of another file
that is written into it, or linked, and it throws all of a file away for a comment. No public way sets the
key, the name of a function's symbol, whether callers get its bitcode, or when its entry point for Python is
compiled.

- **The cache** (`dispatcher._cache`, `CompileResult._reduce` and `_rebuild`): a kernel is kept under the
  digest of its content, with what its machine code relies on of the kernels that it calls.
- **Symbols** (`func_id.unique_id`, `_unique_ids`): numba's hold a count of what a process has compiled. Here
  they hold what stays, so that a kernel finds what it calls in every process. numba's own functions within
  kernels are still counted, from another number in each process: else two of one name could be taken for one.
- **Links** (`library._linking_libraries`, `_shared_module`, `_get_module_for_linking`): numba hands a caller
  the bitcode of all that it calls, and optimises it anew in each caller and each of theirs. LLVM writes out
  what is short, and the caller gains by it. What is long stays a call all the same, so callers get its symbol
  alone: a quarter of the CPU time of compiling, and half the bytes.
- **Entry points** (`_compile_for_args`, `add_overload`, `create_cpython_wrapper`): numba compiles with each
  kernel what unpacks its arguments and makes objects of its result. For records of hundreds of numbers that
  is more machine code than the kernel's own, and Python calls one kernel in ten: compiled at its first call.
- **Types of arguments** (`get_call_template`): numba compiles a kernel anew for each constant that another
  calls it with.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping
from copy import copy
from importlib import import_module
from itertools import chain, count, islice
from secrets import randbits
from typing import Any, NamedTuple

import numba
from llvmlite import binding as llvm
from numba.core import event
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import Environment
from numba.core.errors import NumbaError
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from noise_model.compiled.content import (
    describe_function,
    describe_type,
    digest,
    entry_key,
    find_kernel,
    is_named,
    kernel_key,
)
from noise_model.compiled.deep_calls import call_with_room
from noise_model.compiled.stopwatch import last_compile_s
from noise_model.compiled.store import Record, kernel_folder, read_records, write_record

MIN_INSTRUCTIONS = 250
"""From so many of LLVM's instructions on a kernel is long. LLVM writes out what has some fifty."""


class Callee(NamedTuple):
    """A kernel that others call, and what of it their machine code relies on.

    Attributes
    ----------
    module, name : str
        What leads to it.
    arguments : tuple
        Types that it is compiled for.
    symbol : str
        Its name in machine code.
    returns : str
        The digest of the type of its result.
    content : str
        The digest of its bitcode's sources, which is optimised into its callers; of a long kernel none.
    """

    module: str
    name: str
    arguments: tuple[Any, ...]
    symbol: str
    returns: str
    content: str


class KernelCompiler(Compiler):  # type: ignore[misc]
    """numba's compiler, but for the name of a kernel's symbol."""

    def define_pipelines(self) -> Any:
        """Return numba's own passes."""
        self.state.func_id.unique_id = _symbol_id(self.state.func_id.func, self.state.args)
        return super().define_pipelines()


class KernelCache:
    """What a dispatcher of numba's asks for machine code on disk."""

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        self.name = f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"

    @property
    def cache_path(self) -> str:
        """The folder of all kernels; numba's statistics show it."""
        return str(kernel_folder())

    def load_overload(self, arguments: Any, context: Any) -> Any:
        """Return the kernel for types of arguments, None if it must be compiled."""
        context.refresh()
        for record in read_records(self.name, self._key(arguments, context)):
            if all(map(_is_as_before, record.relies_on)):
                own, kept = pickle.loads(record.body)
                result = CompileResult._rebuild(context, *kept)
                _note(result.library, own, record.relies_on)
                return result
        return None

    def save_overload(self, arguments: Any, result: Any) -> None:
        """Keep a compiled kernel; if it is long, callers get its symbol alone from now on."""
        library, function = result.library, result.fndesc
        relies_on = tuple(_callees(library))
        key = self._key(arguments, result.target_context)
        content = digest(key, [(callee.symbol, callee.returns, callee.content) for callee in relies_on])
        own = None
        if is_named(self.kernel):
            is_long = _is_long(library.get_function(function.llvm_func_name))
            module, name = self.kernel.py_func.__module__, self.kernel.py_func.__qualname__
            returns = digest(describe_type(result.signature.return_type))
            symbol = function.llvm_func_name
            own = Callee(module, name, function.argtypes, symbol, returns, "" if is_long else content)
            if is_long:
                # numba reads off its bitcode which names the machine code defines.
                defined = [part.name for part in library.get_defined_functions()]
                stubs = (f'define void @"{name}"() {{ ret void }}' for name in defined)
                library._shared_module = llvm.parse_assembly("\n".join(stubs))
        # Addresses of this process are in the machine code.
        if not library.has_dynamic_globals:
            body = dumps((own, result._reduce()))
            write_record(self.name, f"{key}-{content[:16]}", Record(relies_on, last_compile_s(), body))
        _note(library, own, relies_on)

    def _key(self, arguments: Any, context: Any) -> str:
        # The symbol of what another function of this process has the name of is another.
        symbol_id = _symbol_id(self.kernel.py_func, arguments)
        return kernel_key(self.kernel, arguments, (symbol_id, *context.codegen().magic_tuple()))[:32]


_NAMED: dict[str, Any] = {}
FunctionIdentity._unique_ids = count(randbits(48))


def _symbol_id(function: Any, arguments: tuple[Any, ...]) -> str:
    """Return what tells a kernel's symbol from others: its module, name and types of arguments.

    What no name leads to, as a kernel within a function, has its content in the symbol too.
    """
    module, name = function.__module__, function.__qualname__
    symbol_id = digest(module, name, *map(describe_type, arguments))[:16]
    is_only = getattr(find_kernel(module, name), "py_func", None) is function
    if not is_only or _NAMED.setdefault(symbol_id, function) is not function:
        symbol_id = digest(symbol_id, describe_function(function))[:16]
    return symbol_id


def _is_long(machine_code: Any) -> bool:
    """Return True if a function in LLVM's language has MIN_INSTRUCTIONS, and may stay a call."""
    if b"alwaysinline" in machine_code.attributes:
        return False
    instructions = chain.from_iterable(block.instructions for block in machine_code.blocks)
    return next(islice(instructions, MIN_INSTRUCTIONS, None), None) is not None


def _note(library: Any, own: Callee | None, relies_on: tuple[Callee, ...]) -> None:
    """Note with a kernel's machine code what its callers, and theirs, rely on."""
    library.own, library.relies_on = own, relies_on
    if own is not None and not own.content:
        nothing = llvm.parse_assembly("")
        library._get_module_for_linking = lambda: nothing


def _callees(library: Any) -> Iterable[Callee]:
    """Return the kernels that a library's machine code calls, or has in it."""
    known: Iterable[Callee] | None = getattr(library, "relies_on", None)
    if known is not None:
        return known
    callees: dict[str, Callee] = {}
    for part in library._linking_libraries:
        own = getattr(part, "own", None)
        callees.update((callee.symbol, callee) for callee in (_callees(part) if own is None else (own,)))
    return callees.values()


def _is_as_before(callee: Callee) -> bool:
    """Load or compile a kernel that another calls; return True if what the other relies on is as it was."""
    import_module(callee.module)
    kernel = find_kernel(callee.module, callee.name)
    try:
        kernel.compile(callee.arguments)
    except (AttributeError, NumbaError):
        return False
    now = kernel.overloads[callee.arguments].library.own
    return now is not None and now[3:] == callee[3:]


def enter_when_called(kernel: Any) -> None:
    """Give a kernel that numba compiles without entry points one when Python calls it."""
    compile_for = kernel._compile_for_args
    # numba owns no reference to what is inserted. Two entry points for the same types are ambiguous to it: it
    # would ask anew at each call.
    entries: dict[tuple[Any, ...], Any] = {}

    def keep(result: Any) -> None:
        kernel.overloads[tuple(result.signature.args)] = result

    def enter(*given: Any) -> Any:
        # Two threads may both ask before either has it.
        with global_compiler_lock:
            compiled = call_with_room(compile_for, *given)
            result = next(known for known in kernel.overloads.values() if known.entry_point is compiled)
            arguments = tuple(result.signature.args)
            if arguments not in entries:
                entries[arguments] = call_with_room(_entry, kernel, result)
                kernel._insert([type_._code for type_ in arguments], entries[arguments].entry_point, False)
        return entries[arguments].entry_point

    # Python calls what is inserted there, and asks for what is not.
    kernel.add_overload = keep
    kernel._compile_for_args = enter


def _entry(kernel: Any, result: Any) -> Any:
    """Return the entry point of a compiled kernel, from disk or compiled and kept there.

    It calls the kernel by its symbol. So it is compiled anew for another symbol, and for no other content.
    """
    context, symbol = result.target_context, result.fndesc.llvm_func_name
    described = map(describe_type, (result.signature.return_type, *result.signature.args))
    key = entry_key(kernel, symbol, *described, context.codegen().magic_tuple())
    for record in read_records(kernel._cache.name, key):
        kernel._cache_hits[symbol] += 1
        return CompileResult._rebuild(context, *pickle.loads(record.body))
    kernel._cache_misses[symbol] += 1
    data = {"dispatcher": kernel, "args": result.signature.args, "return_type": result.signature.return_type}
    with event.trigger_event("numba:compile", data=data):
        entry = _compiled_entry(kernel, result)
    write_record(kernel._cache.name, key, Record((), last_compile_s(), dumps(entry._reduce())))
    return entry


def _compiled_entry(kernel: Any, result: Any) -> Any:
    """Return an entry point as a record of its own, that calls the kernel by its symbol."""
    context = result.target_context.subtarget(enable_nrt=kernel.targetoptions.get("_nrt", True))
    function = copy(result.fndesc)
    # The constants of the entry point are its own.
    function.env_name = f"{function.env_name}.entry"
    environment = Environment.from_fndesc(function)
    library = context.codegen().create_library(f"entry of {function.qualname}")
    library.enable_object_caching()
    library.add_linking_library(rtsys.library)
    context.create_cpython_wrapper(library, function, environment, None, release_gil=True)
    entry_point = context.get_executable(library, function, environment)
    return result._replace(
        library=library, fndesc=function, environment=environment, entry_point=entry_point, referenced_envs=()
    )


def take_types_alone(kernel: Any) -> None:
    """Let other kernels call one without the constants among the arguments.

    numba would compile it anew for each constant, even for one that a loop starts from.
    """
    template, plain = kernel.get_call_template, numba.types.unliteral

    def without_constants(arguments: Iterable[Any], by_name: Mapping[str, Any]) -> Any:
        return template(tuple(map(plain, arguments)), {name: plain(type_) for name, type_ in by_name.items()})

    kernel.get_call_template = without_constants
