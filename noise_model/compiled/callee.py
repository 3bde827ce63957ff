"""Dependencies of a kernel's machine code on the kernels that it calls."""

from __future__ import annotations

from importlib import import_module
from itertools import chain, islice
from typing import Any, NamedTuple

from numba.core.errors import NumbaError

from noise_model.compiled.content import describe_function, describe_type, digest, find_kernel, is_named

MIN_INSTRUCTIONS = 250
"""Least number of LLVM's instructions of a long kernel. LLVM inlines what has some fifty."""


class Callee(NamedTuple):
    """A kernel that others call, and what their machine code relies on.

    `module` and `name` lead to it; `arguments` are the types that it is compiled for, `symbol` is its name in
    machine code. `returns` is the digest of its result's type, `content` that of the sources of its bitcode,
    which is inlined into its callers; empty for a long kernel.
    """

    module: str
    name: str
    arguments: tuple[Any, ...]
    symbol: str
    returns: str
    content: str


def callee_of(kernel: Any, result: Any, content: str) -> Callee | None:
    """Return what others rely on of a compiled kernel, None if no name leads to it."""
    if not is_named(kernel):
        return None
    symbol, signature = result.fndesc.llvm_func_name, result.signature
    names = kernel.py_func.__module__, kernel.py_func.__qualname__
    written_out = "" if is_long(result.library.get_function(symbol)) else content
    return Callee(*names, signature.args, symbol, digest(describe_type(signature.return_type)), written_out)


def is_as_before(callee: Callee) -> bool:
    """Load or compile a kernel that another calls; return True if what the other relies on is as it was."""
    import_module(callee.module)
    kernel = find_kernel(callee.module, callee.name)
    try:
        kernel.compile(callee.arguments)
    except (AttributeError, NumbaError):
        return False
    now = kernel.overloads[callee.arguments].library.own
    return now is not None and now[3:] == callee[3:]


def is_long(machine_code: Any) -> bool:
    """Return True if a function in LLVM's language has MIN_INSTRUCTIONS, and may stay a call."""
    if b"alwaysinline" in machine_code.attributes:
        return False
    instructions = chain.from_iterable(block.instructions for block in machine_code.blocks)
    return next(islice(instructions, MIN_INSTRUCTIONS, None), None) is not None


_NAMED: dict[str, Any] = {}


def symbol_id(function: Any, arguments: tuple[Any, ...]) -> str:
    """Return the unique part of a kernel's symbol: its module, name and types of arguments.

    A kernel without a qualified name, such as one within a function, has its content in the symbol too.
    """
    module, name = function.__module__, function.__qualname__
    named_id = digest(module, name, *map(describe_type, arguments))[:16]
    is_only = getattr(find_kernel(module, name), "py_func", None) is function
    if not is_only or _NAMED.setdefault(named_id, function) is not function:
        return digest(named_id, describe_function(function))[:16]
    return named_id
