"""Long kernels are compiled once, and called by their symbol instead of compiled again in each caller.

numba hands a caller all machine code of what it calls, as LLVM's bitcode. It is optimised and compiled anew
there, in each caller and in each of theirs: of ten kernels, each of which calls the next, the last is
compiled ten times. LLVM writes out what is short, and the caller gains by it. What is long stays a call all
the same. Such a kernel is left out: its callers name its symbol, which the process's one JIT engine resolves
when it loads them. So what they call is loaded before.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from itertools import chain, islice
from typing import Any, NamedTuple

from llvmlite import binding as llvm
from numba.core.caching import CompileResultCacheImpl

from noise_model.kernel_place import KernelPlace

MIN_INSTRUCTIONS = 250
"""From so many of LLVM's instructions on a kernel is long. LLVM writes out what has some fifty."""


class Link(NamedTuple):
    """A long kernel that others call: `name` in `module`, compiled for the types of `arguments`.

    `symbol` is its name in machine code, which another compilation may choose otherwise.
    """

    module: str
    name: str
    arguments: tuple[Any, ...]
    symbol: str


class LinkedCacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    """What of a compiled kernel is kept on disk: numba's own record, and what is linked."""

    _locator_classes = (KernelPlace,)

    def reduce(self, result: Any) -> Any:
        """Return what is kept of a compiled kernel."""
        library = result.library
        return _calls(library), _own_link(library), super().reduce(result)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Return a kernel from what is kept of it, None where what it calls has been compiled anew since."""
        calls, link, kept = payload
        if not all(map(_is_loaded, calls)):
            return None
        result = super().rebuild(target_context, kept)
        result.library.calls = calls
        if link is not None:
            _link_by_symbol(result.library, link)
        return result


def keep_linked(function: Callable[..., Any], result: Any, keep: Callable[[], None]) -> None:
    """Let `keep` write a compiled kernel to disk; if it is long, callers get its symbol alone afterwards."""
    library, symbol = result.library, result.fndesc.llvm_func_name
    link = Link(function.__module__, function.__qualname__, result.fndesc.argtypes, symbol)
    # What no name leads to, as a function within another, nobody could load.
    if getattr(_named(link), "py_func", None) is not function or not _is_long(library.get_function(symbol)):
        keep()
        return
    library.link = link
    # numba keeps the bitcode for callers and reads off it which names the machine code defines.
    library._shared_module = llvm.parse_assembly(
        "\n".join(f'define void @"{part.name}"() {{ ret void }}' for part in library.get_defined_functions())
    )
    keep()
    _link_by_symbol(library, link)


def _is_long(machine_code: Any) -> bool:
    """Say whether a function in LLVM's language has MIN_INSTRUCTIONS, and may stay a call."""
    if b"alwaysinline" in machine_code.attributes:
        return False
    instructions = chain.from_iterable(block.instructions for block in machine_code.blocks)
    return next(islice(instructions, MIN_INSTRUCTIONS, None), None) is not None


def _link_by_symbol(library: Any, link: Link) -> None:
    """Hand callers of a long kernel nothing but its symbol."""
    nothing = llvm.parse_assembly("")
    library.link, library._get_module_for_linking = link, lambda: nothing


def _own_link(library: Any) -> Link | None:
    """Return a long kernel's link, None for a short one."""
    link: Link | None = getattr(library, "link", None)
    return link


def _calls(library: Any) -> tuple[Link, ...]:
    """Return what a library's machine code calls by symbol, that of short kernels in it included."""
    if not hasattr(library, "calls"):
        calls: dict[Link, None] = {}
        for part in library._linking_libraries:
            link = _own_link(part)
            calls.update(dict.fromkeys(_calls(part) if link is None else (link,)))
        library.calls = tuple(calls)
    known: tuple[Link, ...] = library.calls
    return known


def _is_loaded(link: Link) -> bool:
    """Load a long kernel, and say whether it has the symbol that is asked for."""
    dispatcher = _named(link)
    dispatcher.compile(link.arguments)
    symbol: str = dispatcher.overloads[link.arguments].fndesc.llvm_func_name
    return symbol == link.symbol


def _named(link: Link) -> Any:
    """Return what has a link's name, None if nothing has."""
    return getattr(import_module(link.module), link.name, None)
