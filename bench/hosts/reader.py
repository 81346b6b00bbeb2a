"""A service that reads what a viewer reads, and counts."""

from __future__ import annotations

from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service


class Reader(Service[Config]):
    reads = (topics.FRAME, topics.CLOUD, topics.POSE, topics.MAP, topics.MODE)
    optional = reads
