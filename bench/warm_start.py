"""Warm start: from the command to the first cloud, all services as processes, kernels compiled before.

The goal is 5 s on two cores.
"""

from __future__ import annotations

import os
import tempfile

from endo3d.services.cli.demo import scan

RUNS = 3
GOAL_S = 5.0


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        settings = [
            f"rig.name=warm{os.getpid()}",
            f"recorder.directory={folder}",
            "viewer.port=0",
            "viewer.web_port=0",
        ]
        cold_s = scan("demo", settings, seconds=1.0, quiet=True)["start_s"]
        warm_s = [scan("demo", settings, seconds=1.0, quiet=True)["start_s"] for _ in range(RUNS)]
    print(f"first start (compiles what no start before it did)  {cold_s:5.1f} s")
    print(f"warm start, best and worst of {RUNS}                     {min(warm_s):5.1f} {max(warm_s):5.1f} s")
    print(f"goal                                                 {GOAL_S:5.1f} s")


if __name__ == "__main__":
    main()
