"""Arrays as they enter: float64, finite, of the expected shape."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError


def finite_array(name: str, values: Shaped[np.ndarray, "..."], shape: Sequence[int | str]) -> Float[np.ndarray, "..."]:
    """`values` as float64; a number in `shape` is a length that is required, a letter stands for any length.

    Raises `InputError` with both shapes where they differ, and with the first place that is not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    fits = array.ndim == len(shape) and all(
        isinstance(wanted, str) or wanted == given for wanted, given in zip(shape, array.shape, strict=True)
    )
    if not fits:
        expected = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
        raise InputError(f"{name} has shape {array.shape}, expected ({expected})")
    finite = np.isfinite(array)
    if not finite.all():
        place = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise InputError(f"{name}{list(place)} is {array[place]}: every entry must be a finite number")
    return array


def checked_discount(discount: float | int) -> float:
    """`discount` itself. Raises `InputError` outside [0, 1]."""
    if not 0.0 <= discount <= 1.0:
        raise InputError(f"discount = {discount}: give a number in [0, 1]; 1 is no discount")
    return float(discount)
