"""The processor that kernels are compiled for: a level that many machines have, not this machine's own.

Machines of one level run the same machine code, so a recording gives the same tracks on each of them, to the
last bit, and what one has compiled serves the others. A step takes as long as if it were compiled for the
very processor: for x86-64-v4 1.00 times that on an AMD Zen 5.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Set

import numba
from llvmlite import binding as llvm

V3 = frozenset({"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"})
V4 = V3 | {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"}
"""Features of a processor of x86-64-v3, and of v4, in LLVM's names and by the psABI of x86-64."""

CPU_NAMES = {"x86-64-v4": "x86-64-v4", "x86-64-v3": "x86-64-v3", "aarch64": "generic"}
"""LLVM's processor of each target."""


def compile_for_level() -> None:
    """Let numba compile for the level of this machine, where the user has chosen no processor.

    It has to come before numba compiles anything. Whatever numba compiles in this process is for that level.
    """
    targets = host_targets()
    if targets and numba.config.CPU_NAME is None and numba.config.CPU_FEATURES is None:
        # numba reads its settings again whenever one of them changes.
        os.environ |= {"NUMBA_CPU_NAME": CPU_NAMES[targets[0]], "NUMBA_CPU_FEATURES": ""}
        numba.config.reload_config()


def host_targets() -> list[str]:
    """Return the targets whose machine code this machine runs, the best first; none where it stays native."""
    if sys.platform != "linux":
        return []
    if platform.machine() == "aarch64":
        return ["aarch64"]
    return levels(frozenset(name for name, has in llvm.get_host_cpu_features().items() if has))


def levels(features: Set[str]) -> list[str]:
    """Return the levels of x86-64 for which a processor has what is needed, the highest first."""
    needs = {"x86-64-v4": V4, "x86-64-v3": V3}
    return [level for level, needed in needs.items() if needed <= features]


def target() -> str | None:
    """Return the target that numba compiles for in this process, None if it is the user's or native."""
    if numba.config.CPU_FEATURES != "":
        return None
    return next((name for name in host_targets() if CPU_NAMES[name] == numba.config.CPU_NAME), None)
