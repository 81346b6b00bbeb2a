from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service


class Decoder(Service[Config]):
    reads = (topics.FRAME,)
    writes = (topics.CLOUD, topics.DEPTH)
