from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service


class Scanner(Service[Config]):
    writes = (topics.FRAME, topics.MODE)
