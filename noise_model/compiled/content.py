"""Key of a kernel: a digest of all that its machine code depends on, except for what it calls.

That is its bytecode with constants and defaults, each global that it reads, by value, the types of its
arguments, and what compiles it. Comments, docstrings, line numbers and names of folders are not in the key.
So a kernel is compiled again when it would change, and a clone elsewhere finds it.

A called kernel is named here, no more: `noise_model.compiled.numba_internals` checks whether its result's
type is still the same, and, if it is inlined into its callers, its own key.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
import os
import platform
import sys
from collections.abc import Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba import types
from numba.extending import is_jitted

FOREIGN = sys.stdlib_module_names | {"numba", "llvmlite", "numpy"}
"""Packages whose functions and classes are named by the key: it holds their versions."""

COMPILER = ("noise_model.compiled.callee", "noise_model.compiled.numba_internals")
"""The files that decide how kernels are compiled."""

NO_MATTER = ("NUMBA_CACHE", "NUMBA_COLOR", "NUMBA_CPU", "NUMBA_CUDA", "NUMBA_NUM", "NUMBA_THREADING")
"""Prefixes of those settings of numba's that change no machine code, or are in the target."""

_PLAIN = (type(None), type(...), bool, int, float, complex, str, bytes)


def digest(*parts: object) -> str:
    """Return the digest of nested tuples of plain values."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def kernel_key(kernel: Any, arguments: tuple[Any, ...], target: tuple[Any, ...]) -> str:
    """Return the key of a kernel for types of arguments and a CPU, without that of the kernels it calls."""
    described = tuple(map(describe_type, arguments))
    return digest(_Description().kernel(kernel), described, target, _compiler())


def entry_key(kernel: Any, *parts: object) -> str:
    """Return the key of what lets Python call a kernel."""
    return digest("entry", _options(kernel), parts, _compiler())


def describe_function(function: FunctionType) -> tuple[object, ...]:
    """Return the content of a function in plain values."""
    return _Description().function(function)


def find_kernel(module: str, name: str) -> Any:
    """Return the object of a name in an imported module, None if there is none."""
    return getattr(sys.modules.get(module), name, None)


def is_named(kernel: Any) -> bool:
    """Return True if a kernel is what its module and name lead to; one within a function is not."""
    return find_kernel(kernel.py_func.__module__, kernel.py_func.__qualname__) is kernel


@cache
def describe_type(type_: Any) -> tuple[object, ...]:
    """Return a type of numba's in plain values; two classes of the same name differ."""
    if isinstance(type_, types.BaseNamedTuple):
        return *_class(type_.instance_class), *map(describe_type, type_)
    if isinstance(type_, types.BaseTuple):
        return "tuple", *map(describe_type, type_)
    if isinstance(type_, types.Dispatcher):
        return _Description().value(type_.dispatcher, ())
    module = type(type_).__module__
    return str(type_), () if _is_foreign(module) else _source(module)


class _Description:
    """Python's values in nested tuples of plain ones; what refers to itself is described once."""

    def __init__(self) -> None:
        self._begun: set[int] = set()

    def kernel(self, kernel: Any) -> tuple[object, ...]:
        """Return a kernel's content and options."""
        return _options(kernel), self.function(kernel.py_func)

    def function(self, function: FunctionType) -> tuple[object, ...]:
        """Return a function's bytecode, and what it reads."""
        code = function.__code__
        name = function.__module__, function.__qualname__
        if id(code) in self._begun:
            return name
        self._begun.add(id(code))
        names = sorted(_names(code))
        # A global of the name of an attribute is described too: no harm is done by more.
        scope = {**vars(builtins), **function.__globals__}
        read = tuple((read, self.value(scope[read], names)) for read in names if read in scope)
        cells = tuple(self.value(cell.cell_contents, names) for cell in function.__closure__ or ())
        defaults = self.value((function.__defaults__, function.__kwdefaults__), names)
        return name, self._code(code, function.__doc__), read, cells, defaults

    def _code(self, code: CodeType, docstring: str | None) -> tuple[object, ...]:
        constants = code.co_consts
        if docstring is not None and constants[:1] == (docstring,):
            constants = (None, *constants[1:])
        plain = tuple(
            self._code(constant, None) if isinstance(constant, CodeType) else self.value(constant, ())
            for constant in constants
        )
        tables = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        shape = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        return code.co_code, getattr(code, "co_exceptiontable", b""), plain, tables, shape

    def value(self, value: Any, names: list[str] | tuple[()]) -> tuple[object, ...]:
        """Return a value that a kernel reads, of a module what has one of `names`."""
        if type(value) in _PLAIN:
            return type(value).__name__, value
        if isinstance(value, Enum):
            return *_class(type(value)), value.name, *self.value(value.value, ())
        if isinstance(value, tuple):
            return *_class(type(value)), *(self.value(part, names) for part in value)
        if isinstance(value, Mapping):
            return "mapping", *((self.value(key, ()), self.value(value[key], names)) for key in value)
        if isinstance(value, frozenset):
            return "set", *sorted(map(repr, value))
        if isinstance(value, np.ndarray | np.generic):
            content = hashlib.sha256(value.tobytes()).hexdigest()
            flags = value.flags.c_contiguous, value.flags.f_contiguous, value.flags.writeable
            return "array", value.dtype.descr, value.shape, flags, content
        if isinstance(value, types.Type):
            return describe_type(value)
        if isinstance(value, type):
            return _class(value)
        if is_jitted(value) and not _is_foreign(value.py_func.__module__):
            module, name = value.py_func.__module__, value.py_func.__qualname__
            return ("kernel", module, name) if is_named(value) else self.kernel(value)
        if isinstance(value, ModuleType):
            if _is_foreign(value.__name__):
                return "module", value.__name__
            known = [name for name in names if hasattr(value, name)]
            return value.__name__, *((name, self.value(getattr(value, name), names)) for name in known)
        return _named(value)


def _names(code: CodeType) -> set[str]:
    """Return the names of globals and attributes that a function reads, and those within it."""
    within = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, within))


def _class(class_: type) -> tuple[object, ...]:
    """Return a class in plain values: a record's fields and defaults, the members of an enumeration."""
    fields = getattr(class_, "_fields", ()), repr(getattr(class_, "_field_defaults", {}))
    members = tuple((m.name, repr(m.value)) for m in class_) if issubclass(class_, Enum) else ()
    return class_.__module__, class_.__qualname__, fields, members


def _named(value: Any) -> tuple[object, ...]:
    """Return what numba knows by its name: NumPy's functions, and instructions that the project teaches it.

    The content of an instruction is that of its file: it calls other functions as it likes.
    """
    module = getattr(value, "__module__", None) or type(value).__module__
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None) or type(value).__name__
    return module, name, () if _is_foreign(module) else _source(module)


def _is_foreign(module: str) -> bool:
    return module.partition(".")[0] in FOREIGN


@cache
def _source(module: str) -> tuple[object, ...]:
    """Return a module's name and the digest of its code, without comments and docstrings."""
    file = getattr(sys.modules[module], "__file__", None)
    if file is None:
        return (module,)
    tree = ast.parse(Path(file).read_bytes())
    for part in ast.walk(tree):
        if isinstance(part, ast.Module | ast.ClassDef | ast.FunctionDef):
            part.body = [line for line in part.body if not _is_docstring(line)] or [ast.Pass()]
    return module, digest(ast.unparse(tree))


def _is_docstring(line: ast.stmt) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)


def _options(kernel: Any) -> tuple[object, ...]:
    """Return a kernel's options of numba's in plain values; sets have no order."""
    options = sorted(kernel.targetoptions.items())
    return tuple((name, sorted(value) if isinstance(value, set) else value) for name, value in options)


def versions() -> list[str]:
    """Return the installed versions that machine code depends on: Python and numba's packages.

    numba distinguishes NumPy's minor versions, and no more.
    """
    python = f"{platform.python_implementation()} {sys.version_info[0]}.{sys.version_info[1]}"
    numpy = ".".join(np.__version__.split(".")[:2])
    return [python, f"numba {numba.__version__}", f"llvmlite {llvmlite.__version__}", f"NumPy {numpy}"]


@cache
def _compiler() -> tuple[object, ...]:
    """Return the compiler's content: versions, numba's settings, and the files that use it."""
    # numba takes an empty setting for none.
    settings = sorted(
        (name, value) for name, value in os.environ.items() if name.startswith("NUMBA_") and value
    )
    return (
        *versions(),
        *(setting for setting in settings if not setting[0].startswith(NO_MATTER)),
        # Functions of Intel's library, where that is installed.
        numba.config.USING_SVML,
        *map(_source, COMPILER),
    )
