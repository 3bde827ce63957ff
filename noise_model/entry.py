"""What lets Python call a kernel is compiled when Python first does: most kernels are called by others alone.

numba compiles an entry point with each function. It unpacks the arguments and makes objects of the result.
Where those are records of hundreds of numbers, that is more machine code than the kernel's own.
"""

from __future__ import annotations

from copy import copy
from typing import Any

from numba.core import event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.lowering import Environment
from numba.core.runtime import rtsys

from noise_model.deep_calls import call_with_room


def enter_when_called(dispatcher: Any) -> None:
    """Give a function that numba compiles without entry points one when Python calls it."""
    compile_for = dispatcher._compile_for_args
    # numba owns no reference to what is inserted. Two entry points for the same types are ambiguous to it: it
    # would ask anew at each call.
    entries: dict[tuple[Any, ...], Any] = {}

    def keep(kernel: Any) -> None:
        dispatcher.overloads[tuple(kernel.signature.args)] = kernel

    def enter(*given: Any) -> Any:
        compiled = call_with_room(compile_for, *given)
        kernel = next(kernel for kernel in dispatcher.overloads.values() if kernel.entry_point is compiled)
        arguments = tuple(kernel.signature.args)
        # Two threads may both ask before either has it.
        with global_compiler_lock:
            if arguments not in entries:
                entries[arguments] = call_with_room(_entry_point, dispatcher, kernel)
                dispatcher._insert([type_._code for type_ in arguments], entries[arguments], False)
        return entries[arguments]

    # Python calls what is inserted there, and asks for what is not.
    dispatcher.add_overload = keep
    dispatcher._compile_for_args = enter


def _entry_point(dispatcher: Any, kernel: Any) -> Any:
    """Return what Python calls to call a kernel, from disk or compiled and kept there.

    It is kept under the kernel's symbol, which it calls: a kernel that is compiled anew may have another.
    """
    symbol, arguments = kernel.fndesc.llvm_func_name, kernel.signature.args
    entry = dispatcher._cache.load_overload(symbol, dispatcher.targetctx)
    if entry is not None:
        dispatcher._cache_hits[symbol] += 1
        return entry.entry_point
    dispatcher._cache_misses[symbol] += 1
    described = {"dispatcher": dispatcher, "args": arguments, "return_type": kernel.signature.return_type}
    with event.trigger_event("numba:compile", data=described):
        entry = _compiled_entry(dispatcher, kernel)
    dispatcher._cache.save_overload(symbol, entry)
    return entry.entry_point


def _compiled_entry(dispatcher: Any, kernel: Any) -> Any:
    """Return the entry point of a kernel as a record of its own, that calls the kernel by its symbol."""
    counts_references = dispatcher.targetoptions.get("_nrt", True)
    context = dispatcher.targetctx.subtarget(enable_nrt=counts_references)
    function = copy(kernel.fndesc)
    # The constants of the entry point are its own.
    function.env_name = f"{function.env_name}.entry"
    environment = Environment.from_fndesc(function)
    library = context.codegen().create_library(f"entry of {function.qualname}")
    library.enable_object_caching()
    library.add_linking_library(rtsys.library)
    context.create_cpython_wrapper(library, function, environment, None, release_gil=True)
    entry_point = context.get_executable(library, function, environment)
    return kernel._replace(
        library=library, fndesc=function, environment=environment, entry_point=entry_point, referenced_envs=()
    )
