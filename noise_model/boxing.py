"""What a kernel returns becomes Python objects without running Python code: so no signal comes in between.

A kernel runs without Python's lock. A Ctrl-C that comes meanwhile waits for the next line of Python. numba
runs that while it makes the result: a Python function looks up each class, and the `__new__` of a named tuple
is another. KeyboardInterrupt is then raised where numba's machine code expects no error: the process ended by
SIGSEGV. Here the classes are constants of the kernel, and `tuple.__new__` is called, both in C. So
KeyboardInterrupt is raised in the line that called the kernel. It also takes half the time.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import boxing, pythonapi


def make_results_in_c() -> None:
    """Replace what makes numba's results, for kernels that are compiled from now on."""
    # numba has no public way to replace what makes an object of its own types.
    makers = pythonapi._boxers.functions
    makers[types.NamedTuple] = makers[types.NamedUniTuple] = _box_named_tuple
    makers[types.Array] = _box_array


def _box_named_tuple(type_: Any, value: Any, context: Any) -> Any:
    """Return machine code that makes a named tuple: numba's own, but for how the class is called."""
    api = context.pyapi
    plain = boxing.box_tuple(type_, value, context)
    new, named = _constant(context, tuple.__new__), _constant(context, type_.instance_class)
    result = api.call_function_objargs(new, (named, plain))
    api.decref(plain)
    return result


def _box_array(type_: Any, value: Any, context: Any) -> Any:
    """Return numba's own machine code that makes an array, but for how its class is looked up."""
    api = context.pyapi
    api.serialize_object, api.unserialize = (
        (lambda class_: class_),
        (lambda class_: _constant(context, class_)),
    )
    try:
        return boxing.box_array(type_, value, context)
    finally:
        del api.serialize_object, api.unserialize


def _constant(context: Any, constant: Any) -> Any:
    """Return a reference to a constant that is kept with the kernel; it is borrowed."""
    return context.env_manager.read_const(context.env_manager.add_const(constant))
