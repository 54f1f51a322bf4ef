"""One rate from many clocks: the value of a channel at given rows, and whether its samples allow one.

Times are seconds from a common start, strictly increasing. A row is valid when the samples around it are close
enough; what stands in an invalid row is not to be used. A sample within `ROUNDING_S` of a row counts as at the row:
stamps are rounded, to nanoseconds or microseconds.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

ROUNDING_S = 1e-6


def rows_between(start_ns: int, end_ns: int, fps: int) -> Float[np.ndarray, "T"]:
    """Times t_k = k / fps [s] after `start_ns`, rounded to nanoseconds as stamps are, up to `end_ns`."""
    span = end_ns - start_ns + round(ROUNDING_S * 1e9)
    count = max(0, span * fps // 10**9 + 1)
    return np.round(np.arange(count) * (1e9 / fps)) / 1e9


def hold(
    times: Float[np.ndarray, "N"], rows: Float[np.ndarray, "T"], max_gap_s: float
) -> tuple[Int[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Index of the last sample at or before each row; valid when it is at most `max_gap_s` old."""
    before = np.searchsorted(times, rows + ROUNDING_S, side="right") - 1
    index = np.maximum(before, 0)
    return index, (before >= 0) & (rows - times[index] <= max_gap_s + ROUNDING_S)


def nearest(
    times: Float[np.ndarray, "N"], rows: Float[np.ndarray, "T"], max_gap_s: float
) -> tuple[Int[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Index of the sample nearest to each row, the earlier of two as near; valid within half of `max_gap_s`.

    Samples `max_gap_s` apart are thus the farthest between which every row is valid.
    """
    after = np.clip(np.searchsorted(times, rows), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(times[after] - rows) < np.abs(rows - times[before]), after, before)
    return index, np.abs(times[index] - rows) <= 0.5 * max_gap_s + ROUNDING_S


def linear(
    times: Float[np.ndarray, "N"], values: Float[np.ndarray, "N D"], rows: Float[np.ndarray, "T"], max_gap_s: float
) -> tuple[Float[np.ndarray, "T D"], Bool[np.ndarray, "T"]]:
    """(1 - s) x_i + s x_{i+1} with s = (t - t_i) / (t_{i+1} - t_i).

    Valid when t_{i+1} - t_i is at most `max_gap_s`, or a sample stands at the row.
    """
    index, share, valid = _between(times, rows, max_gap_s)
    after = np.minimum(index + 1, len(times) - 1)
    s = share[:, None]
    return (1 - s) * values[index] + s * values[after], valid


def slerp(
    times: Float[np.ndarray, "N"], quats: Float[np.ndarray, "N 4"], rows: Float[np.ndarray, "T"], max_gap_s: float
) -> tuple[Float[np.ndarray, "T 4"], Bool[np.ndarray, "T"]]:
    """Rotation at constant angular velocity between unit quaternions, along the shorter arc; valid as `linear` is.

    (sin((1 - s) a) q_i + sin(s a) q_{i+1}) / sin(a), with a the angle between q_i and q_{i+1} as four-vectors
    (Shoemake, "Animating rotation with quaternion curves", 1985). Samples are first given the sign that is nearer to
    the sample before, so that rows have no jump of sign. Half a turn between samples has two shorter arcs; one is
    taken. The order of the components does not matter.
    """
    flips = np.einsum("nd,nd->n", quats[1:], quats[:-1]) < 0
    quats = quats * np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))[:, None]
    index, share, valid = _between(times, rows, max_gap_s)
    a, b = quats[index], quats[np.minimum(index + 1, len(times) - 1)]
    angle = 2 * np.arctan2(np.linalg.norm(b - a, axis=1), np.linalg.norm(a + b, axis=1))  # exact near 0, unlike arccos
    apart = angle > 1e-9
    sine = np.where(apart, np.sin(angle), 1.0)
    weight_a = np.where(apart, np.sin((1 - share) * angle) / sine, 1 - share)
    weight_b = np.where(apart, np.sin(share * angle) / sine, share)
    turned = weight_a[:, None] * a + weight_b[:, None] * b
    return turned / np.linalg.norm(turned, axis=1, keepdims=True), valid


def _between(
    times: Float[np.ndarray, "N"], rows: Float[np.ndarray, "T"], max_gap_s: float
) -> tuple[Int[np.ndarray, "T"], Float[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Index of the sample before each row, the row's share of the way to the next one, and whether it is valid."""
    index = np.clip(np.searchsorted(times, rows, side="right") - 1, 0, len(times) - 1)
    after = np.minimum(index + 1, len(times) - 1)
    length = times[after] - times[index]
    share = np.clip((rows - times[index]) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    share = np.where(length > 0, share, 0.0)
    at_sample = np.minimum(np.abs(rows - times[index]), np.abs(times[after] - rows)) <= ROUNDING_S
    inside = (rows >= times[0]) & (rows <= times[-1])
    return index, share, at_sample | (inside & (length > 0) & (length <= max_gap_s + ROUNDING_S))


def longest_interval(times: Float[np.ndarray, "N"]) -> tuple[int, float]:
    """Index of the sample before the longest time without one, and its length [s]; (0, 0.0) for a single sample."""
    if len(times) < 2:
        return 0, 0.0
    lengths = np.diff(times)
    at = int(lengths.argmax())
    return at, float(lengths[at])
