from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service


class Odometry(Service[Config]):
    reads = (topics.CLOUD,)
    writes = (topics.POSE, topics.MAP)
