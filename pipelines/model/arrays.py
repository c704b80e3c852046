"""Types of the columns, and the check of shapes that makes a value read-only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import InputError

Array = NDArray[np.float64]
Column = NDArray[np.float32]
Index = NDArray[np.intp]
Nanos = NDArray[np.int64]
Mask = NDArray[np.bool_]
Rings = NDArray[np.uint8]
Shape = tuple[int | None, ...]

RING_UNKNOWN = 255  # the ring of a return where the recording has none


def seal(value: object, **shapes: Shape) -> None:
    """Check the shapes of a value's arrays and make them read-only.

    Parameters
    ----------
    value : object
        Dataclass instance that owns the arrays.
    **shapes : tuple
        Expected shape by field name; ``None`` stands for any length.

    Raises
    ------
    InputError
        If an array has another shape.
    """
    for name, shape in shapes.items():
        array = getattr(value, name)
        agrees = array.ndim == len(shape) and all(
            expected is None or expected == found
            for expected, found in zip(shape, array.shape, strict=True)
        )
        if not agrees:
            kind = type(value).__name__
            expected_text = str(tuple("n" if n is None else n for n in shape)).replace("'", "")
            raise InputError(f"{kind}.{name} has shape {array.shape}, not {expected_text}.")
        array.flags.writeable = False


def same_length(value: object, *names: str) -> None:
    """Check that columns of a value are equally long.

    Parameters
    ----------
    value : object
        Dataclass instance that owns the columns.
    *names : str
        Fields to compare.

    Raises
    ------
    InputError
        If their lengths differ.
    """
    lengths = {name: len(getattr(value, name)) for name in names}
    if len(set(lengths.values())) > 1:
        raise InputError(f"{type(value).__name__} has columns of different lengths: {lengths}.")
