"""How the kernels are compiled, and kept on disk under a key of all sources that they are made of."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Mapping, Set
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from noise_model.boxing import make_results_in_c
from noise_model.entry import enter_when_called
from noise_model.kernel_place import KernelPlace
from noise_model.linking import LinkedCacheImpl, keep_linked

Function = TypeVar("Function", bound=Callable[..., Any])

# Short kernels run faster if no references to arrays are counted. numba's one option for it is private; what
# is compiled with it must not make arrays.
NO_REFERENCE_COUNTS = {"_nrt": False}

REDUCTION = frozenset({"reassoc", "contract", "arcp", "nsz"})
"""Liberties by which LLVM sums many terms at once; NaN stays NaN."""

make_results_in_c()

_IMPORTED = re.compile(
    r"^\s*(?:from\s+([\w.]+)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+([\w.]+))", re.MULTILINE
)


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
    used again only while no source that the function's file imports, directly or not, has changed.
    """
    compiled = numba.njit(
        nogil=True,
        error_model="numpy",
        # Entry points: nobody calls one from C, and `enter_when_called` makes those for Python.
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
        forceinline=inline,
        fastmath=set(fastmath),
        **({} if allocates else NO_REFERENCE_COUNTS),
    )

    def keep(plain: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = compiled(plain)
        dispatcher._cache = KernelCache(plain)
        dispatcher.get_call_template = _by_types_alone(dispatcher.get_call_template)
        enter_when_called(dispatcher)
        result: Callable[..., Any] = dispatcher
        return result

    return keep if function is None else keep(function)


def _by_types_alone(template: Callable[..., Any]) -> Callable[..., Any]:
    """Return `template`, by which one kernel calls another, without the constants among the arguments.

    numba would compile the other anew for each constant, even for one that a loop starts from.
    """
    plain = numba.types.unliteral

    def without_constants(arguments: Iterable[Any], by_name: Mapping[str, Any]) -> Any:
        return template(tuple(map(plain, arguments)), {name: plain(type_) for name, type_ in by_name.items()})

    return without_constants


@cache
def source_key(path: Path) -> str:
    """Return the digest of a source file and of all those of this project that it imports, directly or not.

    numba's own key is a file's time and size. It misses a kernel of another file that is written out, or
    linked, into this one's machine code: after an update old physics would run on.
    """
    digest = hashlib.sha256()
    for source in sorted(_sources(path)):
        digest.update(hashlib.sha256(source.read_bytes()).digest())
    return digest.hexdigest()


def _sources(path: Path) -> set[Path]:
    """Return a file and all files beside its own package that it imports, directly or not."""
    todo, sources = [path], {path}
    while todo:
        for imported in _imports(todo.pop()) - sources:
            sources.add(imported)
            todo.append(imported)
    return sources


@cache
def _imports(path: Path) -> frozenset[Path]:
    """Return the files beside a file's own package that its import statements name."""
    root = _root(path)
    imported = set()
    for package, names, module in _IMPORTED.findall(path.read_text(encoding="utf-8")):
        dotted = package or module
        for name in (dotted, *(f"{dotted}.{name}" for name in re.findall(r"\w+", names))):
            place = root.joinpath(*name.split("."))
            for candidate in (place.with_suffix(".py"), place / "__init__.py"):
                if candidate.is_file():
                    imported.add(candidate)
    return frozenset(imported)


@cache
def _root(path: Path) -> Path:
    """Return the folder that holds a file's top package."""
    folder = path.parent
    while (folder / "__init__.py").is_file():
        folder = folder.parent
    return folder


class _KernelFile(IndexDataCacheFile):  # type: ignore[misc]
    """numba's files of one kernel; what is damaged counts as absent, so that it is compiled and kept anew.

    Unpickling raises nearly anything: files are cut by a full disk, and an update moves the class of an
    argument.
    """

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:
            return {}

    def _load_data(self, name: str) -> Any:
        try:
            return super()._load_data(name)
        except Exception:
            return None


class KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one kernel, whose index is out of date when `source_key` is another.

    Or that of this file: what is kept has another form then.
    """

    _impl_class = LinkedCacheImpl

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = f"{source_key(Path(function.__code__.co_filename))} {source_key(Path(__file__))}"
        self._place: KernelPlace = self._impl.locator
        self._files = [
            _KernelFile(str(folder), self._impl.filename_base, stamp) for folder in self._place.folders
        ]
        # The last folder is the one that is written to.
        self._cache_file = self._files[-1]

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return a kernel that was compiled before, None if no folder has it."""
        for file in self._files:
            self._cache_file = file
            compiled = super().load_overload(signature, target_context)
            if compiled is not None:
                return compiled
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep a compiled kernel, where a folder may be written and has room."""

        def keep() -> None:
            if self._place.kept is not None:
                self._cache_file = self._files[-1]
                with suppress(OSError):
                    super(KernelCache, self).save_overload(signature, result)

        keep_linked(self._py_func, result, keep)
