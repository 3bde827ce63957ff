"""Records as bytes and back, by MessagePack.

Bytes are decoded only to the classes that a journal's records are made of, so reading them runs no code of
whoever wrote them.
"""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, get_args, get_type_hints

import msgpack
import numpy as np

from noise_model.compiled.arrays import UInt8

ARRAY = 0
"""The key that marks an array; a class is marked by its place in `Packer.classes`, from 1 on."""


class Packer:
    """Binary codec of records whose classes follow from their fields' annotations.

    `roots` are the outermost records' classes: dataclasses or named tuples.
    """

    def __init__(self, roots: Sequence[type]) -> None:
        self.classes: list[type] = []
        for root in roots:
            self._add(root)
        self._keys = {record: key for key, record in enumerate(self.classes, ARRAY + 1)}
        self._names = {record: names for record in self.classes if (names := _field_names(record))}

    def pack(self, record: object) -> bytes:
        """Return a record as bytes; ValueError if a part of it is of no known class."""
        packed: bytes = msgpack.packb(record, default=self._encoded, strict_types=True)
        return packed

    def unpack(self, packed: UInt8) -> Any:
        """Return the record that `pack` made bytes of."""
        return msgpack.unpackb(packed.data, object_hook=self._decoded, use_list=False, strict_map_key=False)

    def _add(self, annotation: Any) -> None:
        """Add the classes that an annotation names, and those of their fields."""
        for argument in get_args(annotation):
            self._add(argument)
        if not isinstance(annotation, type) or annotation in self.classes:
            return
        if issubclass(annotation, Enum):
            self.classes.append(annotation)
        elif names := _field_names(annotation):
            self.classes.append(annotation)
            hints = get_type_hints(annotation)
            for name in names:
                self._add(hints[name])

    def _encoded(self, value: Any) -> Any:
        """Return the substitute of a value that MessagePack lacks: a map from its mark to its parts."""
        kind = type(value)
        if kind is tuple:
            return list(value)
        if kind is np.ndarray:
            return {ARRAY: [value.dtype.str, list(value.shape), value.tobytes()]}
        names = self._names.get(kind)
        if names is not None:
            return {self._keys[kind]: [getattr(value, name) for name in names]}
        if kind in self._keys:
            return {self._keys[kind]: value.value}
        if isinstance(value, np.generic):
            return value.item()
        raise ValueError(f"no record holds a {kind.__name__}")

    def _decoded(self, value: dict[Any, Any]) -> Any:
        if len(value) != 1:
            return value
        ((key, content),) = value.items()
        if not isinstance(key, int):
            return value
        if key == ARRAY:
            dtype, shape, held = content
            return np.frombuffer(bytearray(held), np.dtype(dtype)).reshape(shape)
        record = self.classes[key - ARRAY - 1]
        return record(content) if issubclass(record, Enum) else record(*content)


def _field_names(record: type) -> tuple[str, ...]:
    """Return the names of a record's fields, in the order in which its class takes them."""
    if is_dataclass(record):
        return tuple(field.name for field in fields(record))
    return getattr(record, "_fields", ())
