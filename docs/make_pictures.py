"""Makes the pictures of the documentation from the demo's artifacts (`make pictures`, after `make demo`).

Rerun's viewer runs without a screen; it needs a Vulkan driver (`make system`).
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from rerun.experimental import ViewerClient

PORT = 9877
NOTICES_S = 8.0  # the viewer shows notices in a corner when it starts
ROLLOUT = Path("outputs/demo/rollout.rrd")


def main() -> None:
    """Write docs/pictures/replay.png."""
    rerun = Path(sys.executable).with_name("rerun")
    options = ["--headless", "--port", str(PORT), "--window-size", "1200x700"]
    viewer = subprocess.Popen(
        [rerun, ROLLOUT, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        time.sleep(NOTICES_S)
        ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy").save_screenshot("docs/pictures/replay.png")
        time.sleep(1.0)
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)  # the command is a wrapper around the viewer
        viewer.wait()


if __name__ == "__main__":
    main()
