"""Prints the clouds of a running rig (``endo3d up`` or ``make demo``): endo3d's reader, without a copy."""

import sys

from endo3d.services.tap import tap

for cloud in tap("cloud", rig=sys.argv[1] if len(sys.argv) > 1 else "demo"):
    print(f"cloud {cloud.sequence}: {cloud.points.shape} points, {cloud.valid_count} valid", flush=True)
