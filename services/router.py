"""The router: where the hosts of a rig meet. The only process that listens beyond the loopback."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from endo3d.services.runtime import network, stack_file
from endo3d.services.runtime.identity import identity_of
from endo3d.services.runtime.service import Config, Service

log = logging.getLogger(__name__)


class RouterConfig(Config):
    rig: str = ""
    stack_toml: str = ""
    host: str = ""
    keys: Path = Path()


class Router(Service[RouterConfig]):
    """A zenoh router with mutual TLS and access control by certificate; a stock ``zenohd`` may stand in."""

    Config = RouterConfig
    nice = 5

    def __init__(self, config: RouterConfig) -> None:
        super().__init__(config)
        self.placement = stack_file.loads(config.stack_toml).placement
        self._router: network.Router | None = None

    def open(self) -> None:
        """Listens. Raises ``UserError``."""
        role = self.placement.hosts[self.config.host].role
        identity = identity_of(self.config.host, role, self.config.keys)
        self._router = network.Router(network.router_settings(self.config.rig, self.placement, identity))
        log.info("listening at %s", self.placement.endpoint)

    def values(self) -> Mapping[str, float]:
        return {"lines": float(self._router.connected)} if self._router is not None else {}

    def close(self) -> None:
        if self._router is not None:
            self._router.close()
