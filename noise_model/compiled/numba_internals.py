"""All of numba's private parts that kernels need, each with its reason: no public way does what follows.

- **The cache** (`dispatcher._cache`, `CompileResult._reduce` and `_rebuild`): numba's misses a change in
  another file. Here a kernel is kept under the digest of its content, with what it relies on of others.
- **Symbols** (`func_id.unique_id`, `_unique_ids`, `mangler`, `_optimize_final_module`): numba's count what a
  process compiles, and its records. Here a kernel finds what it calls in every process, and its machine code
  is the same bytes in each. numba's own functions stay hidden in a kernel: two of one name are never one.
- **Passes** (`passes`): those for reports, closures and literals are left out, no kernel has any: 3 %.
- **Search** (`get_call_type`, `TargetConfig`): numba tries all implementations of `+` at each `+`: 10 %.
- **Errors** (`build_excinfo_struct`): numba's machine code holds the file and line that raise.
- **Links** (`library._linking_libraries`, `_shared_module`, `_get_module_for_linking`): numba hands a caller
  the bitcode of all that it calls. What is long stays a call, so callers get its symbol: 25 % of the time.
- **Entry points** (`_compile_for_args`, `add_overload`, `create_cpython_wrapper`): numba compiles one with
  each kernel. Python calls one in ten: its entry point is compiled at its first call.
- **Results** (`PythonAPI`): made by functions of Python numba's are slow, and Ctrl-C crashes in them
  (docs/explanation/interrupts.md).
- **Types of arguments** (`get_call_template`): numba compiles a kernel again for each constant in a call.
"""

import pickle
import re
from copy import copy
from functools import cache, partial
from itertools import chain, count
from typing import Any

import numba
from llvmlite import binding as llvm
from numba.core import event
from numba.core.bytecode import FunctionIdentity
from numba.core.callconv import CPUCallConv
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import Environment, _rebuild_env, lookup_environment
from numba.core.funcdesc import default_mangler
from numba.core.pythonapi import PythonAPI
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.types.functions import BaseFunction

from noise_model.compiled.callee import Callee, callee_of, is_as_before, symbol_id
from noise_model.compiled.content import describe_type, digest, entry_key, kernel_key
from noise_model.compiled.deep_calls import call_with_room
from noise_model.compiled.packed import find_records
from noise_model.compiled.stopwatch import last_compile_s
from noise_model.compiled.store import Record, kernel_folder, write_record

NO_BITCODE = llvm.parse_assembly("")
ENVIRONMENT = "_ZN08NumbaEnv"  # So the names begin of what machine code needs of Python.
COUNT = re.compile(r"(?<=B19v)1\d{17}")  # numba's in symbols: as long as what `KernelLibrary` puts there.
NEEDLESS = {"annotate_types", "inline_closure_likes", "literal_unroll", "LiteralPropagation", "with_lifting"}
_search, _describe_error = BaseFunction.get_call_type, CPUCallConv.build_excinfo_struct
_search_once = cache(lambda callee, context, types, names, _: _search(callee, context, types, dict(names)))


def _searched(callee: Any, context: Any, types: Any, names: dict[str, Any]) -> Any:
    return _search_once(callee, context, tuple(types), tuple(names.items()), ConfigStack.top_or_none())


REPLACED = (
    (FunctionIdentity, "_unique_ids", count(10**17)),
    (BaseFunction, "get_call_type", _searched),
    (TargetConfig, "__hash__", lambda settings: len(settings.options)),
    (CPUCallConv, "build_excinfo_struct", lambda *given: _describe_error(*given[:3], None, given[4])),
)


class KernelCompiler(Compiler):  # type: ignore[misc]
    """numba's compiler, but for what is REPLACED, while it compiles and holds numba's lock, and no longer."""

    def _compile_core(self) -> Any:
        numbas_own = [getattr(owner, name) for owner, name, _ in REPLACED]
        for owner, name, value in REPLACED:
            setattr(owner, name, value)
        try:
            return super()._compile_core()
        finally:
            for (owner, name, _), value in zip(REPLACED, numbas_own, strict=True):
                setattr(owner, name, value)

    def define_pipelines(self) -> Any:
        """Return numba's own passes, but for those that no kernel needs."""
        identity = self.state.func_id
        identity.unique_id = symbol_id(identity.func, self.state.args)
        identity.unique_name = f"{identity.func_qualname}${identity.unique_id}"
        library = self.state.library = KernelLibrary(self.state.targetctx.codegen(), identity.func_qualname)
        library.enable_object_caching()
        library.symbol_id, library.environments = identity.unique_id, []
        self.state.targetctx = self.state.targetctx.subtarget(
            mangler=lambda name, _types, **more: default_mangler(name, (), **more)
        )
        (pipeline,) = super().define_pipelines()
        pipeline.passes = [step for step in pipeline.passes if step[0].name() not in NEEDLESS]
        return [pipeline]


class KernelLibrary(JITCodeLibrary):  # type: ignore[misc]
    """A kernel's machine code, in which others see the kernel alone."""

    _final_module: Any

    def _optimize_final_module(self) -> None:
        for name in self._inner_environments():
            # LLVM drops one that nothing reads.
            self._final_module.get_global_variable(name).linkage = "linkonce_any"
        super()._optimize_final_module()
        self._name_environments(self._inner_environments())
        for part in chain(self._final_module.functions, self._final_module.global_variables):
            if part.name.startswith(ENVIRONMENT):
                part.linkage = "common"
            elif not part.is_declaration and self.symbol_id not in part.name:
                part.linkage = "private"

    def _finalize_specific(self) -> None:
        super()._finalize_specific()
        for environment in self.environments:
            self.codegen.set_env(environment.env_name, environment)

    def _inner_environments(self) -> list[str]:
        names = [variable.name for variable in self._final_module.global_variables]
        return [name for name in names if name.startswith(ENVIRONMENT) and self.symbol_id not in name]

    def _name_environments(self, counted: list[str]) -> None:
        """Give what numba's own functions need of Python names of the kernel's, which hold no count."""
        own_ids: dict[str, str] = {}

        def own_id(numbas: re.Match[str]) -> str:
            return own_ids.setdefault(numbas[0], f"{len(own_ids):02d}{self.symbol_id}")

        for name, numbas in zip(counted, map(lookup_environment, counted), strict=True):
            own_name = COUNT.sub(own_id, name)
            self.environments.append(_rebuild_env(numbas.globals["__name__"], numbas.consts, own_name))
        if own_ids:
            self._final_module = llvm.parse_assembly(COUNT.sub(own_id, str(self._final_module)))


class KernelCache:
    """Cache of machine code on disk, as numba's dispatcher uses it."""

    def __init__(self, kernel: Any) -> None:
        self.kernel, self.name = kernel, f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"

    cache_path = property(lambda _: str(kernel_folder()), doc="The folder of all kernels.")

    def load_overload(self, arguments: Any, context: Any) -> Any:
        """Return the kernel for types of arguments, None if it must be compiled."""
        context.refresh()
        for record in find_records(self.name, self._key(arguments, context)):
            if all(map(is_as_before, record.relies_on)):
                result = _rebuild(context, record)
                own = result.library.own
                if (own is None or own.content) and not record.bitcode:
                    result.library._get_module_for_linking = partial(self._bitcode, arguments)
                return result
        return None

    def _bitcode(self, arguments: Any) -> Any:
        """Return what LLVM writes out in callers of a kernel that was kept without it, in a pack."""
        with event.trigger_event("numba:compile", data={"dispatcher": self.kernel, "args": arguments}):
            result = self.kernel._compiler.compile(arguments, None)
        self.save_overload(arguments, result)
        return result.library._get_module_for_linking()

    def save_overload(self, arguments: Any, result: Any) -> None:
        """Keep a compiled kernel; if it is long, callers get its symbol alone from now on."""
        library, symbol = result.library, result.fndesc.llvm_func_name
        relies_on = tuple(_callees(library))
        key = self._key(arguments, result.target_context)
        content = digest(key, [(callee.symbol, callee.returns, callee.content) for callee in relies_on])
        own = callee_of(self.kernel, result, content)
        _note(library, own, relies_on)
        # Addresses of this process are in the machine code.
        if not library.has_dynamic_globals:
            write_record(self.name, f"{key}-{content[:16]}", _reduce(result, symbol, own, relies_on))

    def _key(self, arguments: Any, context: Any) -> str:
        target = symbol_id(self.kernel.py_func, arguments), *context.codegen().magic_tuple()
        return kernel_key(self.kernel, arguments, target)[:32]


def _note(library: Any, own: Callee | None, relies_on: tuple[Callee, ...]) -> None:
    """Note with a kernel's machine code what its callers, and theirs, rely on."""
    library.own, library.relies_on = own, relies_on
    if own is not None and not own.content:
        library._shared_module = NO_BITCODE


def _reduce(result: Any, symbol: str, own: Callee | None, relies_on: tuple[Callee, ...]) -> Record:
    """Return what is kept of compiled code: nothing that differs between two who compile the same."""
    function = copy(result.fndesc)
    function.doc = None
    (name, kind, (code, bitcode)), *more = result._replace(fndesc=function, type_annotation="")._reduce()
    linked = b"" if result.library._shared_module is NO_BITCODE else bitcode
    return Record(relies_on, last_compile_s(), dumps((own, symbol, name, kind, more)), code, linked)


def _rebuild(context: Any, record: Record) -> Any:
    """Return compiled code that was kept."""
    own, symbol, name, kind, more = pickle.loads(record.body)
    # numba reads off the bitcode which names the machine code defines.
    stub = llvm.parse_assembly(f'define void @"{symbol}"() {{ ret void }}').as_bitcode()
    code = record.machine_code, record.bitcode or stub
    result = CompileResult._rebuild(context, (name, kind, code), *more)
    _note(result.library, own, record.relies_on)
    return result


def _callees(library: Any) -> Any:
    """Return the kernels that a library's machine code calls, or has in it."""
    if hasattr(library, "relies_on"):
        return library.relies_on
    parts = ((part, getattr(part, "own", None)) for part in library._linking_libraries)
    callees = chain.from_iterable(_callees(part) if own is None else (own,) for part, own in parts)
    return {callee.symbol: callee for callee in callees}.values()


def enter_when_called(kernel: Any) -> None:
    """Give a kernel that numba compiles without entry points one when Python calls it."""
    compile_for = kernel._compile_for_args
    # numba owns no reference to what is inserted. It asks at each call where two have the same types.
    entries: dict[tuple[Any, ...], Any] = {}

    def enter(*given: Any) -> Any:
        with global_compiler_lock:  # Two threads may both ask before either has it.
            compiled = call_with_room(compile_for, *given)
            result = next(known for known in kernel.overloads.values() if known.entry_point is compiled)
            arguments = tuple(result.signature.args)
            if arguments not in entries:
                entries[arguments] = call_with_room(_entry, kernel, result)
                kernel._insert([type_._code for type_ in arguments], entries[arguments].entry_point, False)
        return entries[arguments].entry_point

    # Python calls what is inserted there, and asks for what is not.
    kernel.add_overload = lambda result: kernel.overloads.update({result.signature.args: result})
    kernel._compile_for_args = enter


def _entry(kernel: Any, result: Any) -> Any:
    """Return the entry point of a compiled kernel, from disk or compiled and kept: one for its symbol."""
    context, symbol = result.target_context, result.fndesc.llvm_func_name
    described = map(describe_type, (result.signature.return_type, *result.signature.args))
    key = entry_key(kernel, symbol, *described, context.codegen().magic_tuple())
    for record in find_records(kernel._cache.name, key):
        kernel._cache_hits[symbol] += 1
        return _rebuild(context, record)
    kernel._cache_misses[symbol] += 1
    with event.trigger_event("numba:compile", data={"dispatcher": kernel, "args": result.signature.args}):
        entry = _compiled_entry(kernel, result)
    write_record(kernel._cache.name, key, _reduce(entry, entry.fndesc.llvm_cpython_wrapper_name, None, ()))
    return entry


class _ResultMaker(PythonAPI):  # type: ignore[misc]
    """Maker of a kernel's result in its entry point: C functions alone."""

    def get_env_manager(self, *environment: Any) -> Any:
        self.environment = super().get_env_manager(*environment)
        return self.environment

    def serialize_object(self, value: Any) -> Any:
        return value if isinstance(value, type) else super().serialize_object(value)

    def unserialize(self, value: Any) -> Any:
        return self._constant(value) if isinstance(value, type) else super().unserialize(value)

    def call(self, named_tuple: Any, fields: Any, *_: Any) -> Any:
        # numba gives up the class that `unserialize` returned.
        self.incref(named_tuple)
        return self.call_function_objargs(self._constant(tuple.__new__), (named_tuple, fields))

    def _constant(self, value: Any) -> Any:
        return self.environment.read_const(self.environment.add_const(value))


def _compiled_entry(kernel: Any, result: Any) -> Any:
    """Return an entry point as a record of its own, that calls the kernel by its symbol."""
    context = result.target_context.subtarget(enable_nrt=kernel.targetoptions.get("_nrt", True))
    context.get_python_api = partial(_ResultMaker, context)
    function = copy(result.fndesc)
    function.env_name = f"{function.env_name}.entry"
    environment = Environment.from_fndesc(function)
    library = context.codegen().create_library(f"entry of {function.qualname}")
    library.enable_object_caching()
    library.add_linking_library(rtsys.library)
    context.create_cpython_wrapper(library, function, environment, None, release_gil=True)
    entry_point = context.get_executable(library, function, environment)
    library._shared_module = NO_BITCODE
    return result._replace(
        library=library, fndesc=function, environment=environment, entry_point=entry_point, referenced_envs=()
    )


def take_types_alone(kernel: Any) -> None:
    """Let other kernels call one without the constants among the arguments."""
    template, plain = kernel.get_call_template, numba.types.unliteral
    kernel.get_call_template = lambda arguments, by_name: template(
        tuple(map(plain, arguments)), {name: plain(type_) for name, type_ in by_name.items()}
    )
