from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service


class Viewer(Service[Config]):
    reads = (topics.FRAME, topics.CLOUD, topics.POSE, topics.MAP, topics.MODE)
