"""Decorator of kernels: how they are compiled, and kept on disk under a key of their content."""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any, TypeVar, overload

import numba

from noise_model.compiled.numba_internals import (
    KernelCache,
    KernelCompiler,
    enter_when_called,
    take_types_alone,
)
from noise_model.compiled.target import compile_for_level

compile_for_level()

Function = TypeVar("Function", bound=Callable[..., Any])

# Short kernels run faster if no references to arrays are counted. numba's one option for it is private; what
# is compiled with it must not make arrays.
NO_REFERENCE_COUNTS = {"_nrt": False}

REDUCTION = frozenset({"reassoc", "contract", "arcp", "nsz"})
"""Liberties by which LLVM sums many terms at once; NaN stays NaN."""


class _Liberties(set[str]):
    """A set that reads the same in each process: numba writes it into the kernel's symbol."""

    def __repr__(self) -> str:
        return repr(sorted(self))


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(
    *, allocates: bool = False, inline: bool = False, fastmath: Set[str] = frozenset()
) -> Callable[[Function], Function]: ...


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    allocates: bool = False,
    inline: bool = False,
    fastmath: Set[str] = frozenset(),
) -> Callable[..., Any]:
    """Compile a function, kept on disk; it runs without Python's lock and divides as NumPy does.

    `allocates` says that it, or what it calls, makes or returns arrays. `inline` lets LLVM write it out where
    it is called; `fastmath` are the liberties that LLVM may take with its arithmetic. What is kept on disk is
    used again while the kernel, and what it reads and calls, would become the same machine code.
    """
    compiled = numba.njit(
        nogil=True,
        error_model="numpy",
        # Entry points: nobody calls one from C, and `enter_when_called` makes those for Python.
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
        pipeline_class=KernelCompiler,
        forceinline=inline,
        fastmath=_Liberties(fastmath),
        **({} if allocates else NO_REFERENCE_COUNTS),
    )

    def keep(plain: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = compiled(plain)
        dispatcher._cache = KernelCache(dispatcher)
        take_types_alone(dispatcher)
        enter_when_called(dispatcher)
        result: Callable[..., Any] = dispatcher
        return result

    return keep if function is None else keep(function)
