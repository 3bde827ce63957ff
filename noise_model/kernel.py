"""How the kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any, TypeVar, overload

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

# Short kernels run faster if no references to arrays are counted. numba's one option for it is private; what
# is compiled with it must not make arrays.
NO_REFERENCE_COUNTS = {"_nrt": False}

REDUCTION = frozenset({"reassoc", "contract", "arcp", "nsz"})
"""Liberties by which LLVM sums many terms at once; NaN stays NaN."""


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

    `allocates` says that it, or what it calls, makes arrays. `inline` writes it out where it is called;
    `fastmath` are the liberties that LLVM may take with its arithmetic. What is kept on disk notices neither
    a change here nor one of an inlined kernel of another file.
    """
    compiled = numba.njit(
        cache=True,
        nogil=True,
        error_model="numpy",
        inline="always" if inline else "never",
        fastmath=set(fastmath),
        **({} if allocates else NO_REFERENCE_COUNTS),
    )
    result: Callable[..., Any] = compiled if function is None else compiled(function)
    return result
