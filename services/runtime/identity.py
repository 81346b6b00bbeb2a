"""Who this host is to other hosts: its certificate, its key, and that nobody else may read the key."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import Role, common_name

AUTHORITY: Final = "ca"
"""Files ``ca.pem``, which every host has, and ``ca.key``, which stays where the certificates are made."""


def keys_folder(named: str = "", base: Path | None = None) -> Path:
    """Where the keys lie: as the stack file names it (relative to ``base``), or ``$ENDO3D_KEYS``, or at home."""
    if named:
        return (base or Path.cwd()) / Path(named).expanduser()
    return Path(os.environ.get("ENDO3D_KEYS") or "~/.config/endo3d/keys").expanduser()


@dataclass(frozen=True)
class Identity:
    """The files that a host shows to others."""

    authority: Path
    certificate: Path
    key: Path

    def listening(self) -> dict[str, Any]:
        """zenoh's settings of one that is connected to; who has no certificate of ours is turned away."""
        return {
            "transport/link/tls/root_ca_certificate": str(self.authority),
            "transport/link/tls/listen_certificate": str(self.certificate),
            "transport/link/tls/listen_private_key": str(self.key),
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/close_link_on_expiration": True,
        }

    def connecting(self) -> dict[str, Any]:
        """zenoh's settings of one that connects."""
        return {
            "transport/link/tls/root_ca_certificate": str(self.authority),
            "transport/link/tls/connect_certificate": str(self.certificate),
            "transport/link/tls/connect_private_key": str(self.key),
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/verify_name_on_connect": True,
            "transport/link/tls/close_link_on_expiration": True,
        }


def identity_of(host: str, role: Role, folder: Path) -> Identity:
    """A host's files, found and looked at.

    Raises ``UserError`` for a missing file, a key that others may read, a certificate of another host or role,
    or one that has expired.
    """
    from endo3d.services.runtime.certificates import name_in  # its library is only needed off-host

    files = Identity(folder / f"{AUTHORITY}.pem", folder / f"{host}.pem", folder / f"{host}.key")
    for path in (files.authority, files.certificate, files.key):
        if not path.is_file():
            raise UserError(f"no {path}; make it with endo3d keys host {host} --role {role}, and copy it there")
    if files.key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise UserError(f"others may read {files.key}; chmod 600 it, and make a new one if others had access")
    name, ends = name_in(files.certificate)
    if name != common_name(role, host):
        raise UserError(f"{files.certificate} is of {name!r}, not of {common_name(role, host)!r}; make another")
    if ends < datetime.now(UTC):
        raise UserError(f"{files.certificate} was valid until {ends:%Y-%m-%d}; make another: endo3d keys host {host}")
    return files
