"""A process that yields the processor still lets go of the writers' memory at once."""

from __future__ import annotations

import json
import subprocess
import sys

from peers import new_rig

PROGRAM = """
import json, os, sys, threading
from pathlib import Path
from endo3d.services.runtime import priority
from endo3d.services.runtime.bus import Bus

before = os.getpriority(os.PRIO_PROCESS, 0)
priority.settle(before + 3)
with Bus.open(sys.argv[1], name="looker"):
    found = {}
    threading.Thread(target=lambda: found.update(own=os.getpriority(os.PRIO_PROCESS, 0))).start()
    for task in Path("/proc/self/task").iterdir():
        name = (task / "comm").read_text().strip()
        found[name] = os.getpriority(os.PRIO_PROCESS, int(task.name))
print(json.dumps({name: nice - before for name, nice in found.items()}))
"""


def test_who_yields_computes_later_but_receives_at_once() -> None:
    ran = subprocess.run([sys.executable, "-c", PROGRAM, new_rig()], capture_output=True, text=True, check=True)
    yields = json.loads(ran.stdout)
    assert yields["own"] == 3
    receiving = {name: by for name, by in yields.items() if name.startswith(("rx", "tx", "net"))}
    assert receiving
    assert set(receiving.values()) == {0}
