"""The conversation of a peer's program with the benchmark: a number of steps comes in, their CPU time goes out."""

import sys
import time
from collections.abc import Callable
from typing import Any


def serve(take_steps: Callable[[int], Any]) -> None:
    """Answer every line of standard input, a number of steps, with `seconds S`, the CPU time that they took."""
    for line in sys.stdin:
        began = time.process_time()
        take_steps(int(line))
        print(f"\nseconds {time.process_time() - began}", flush=True)
