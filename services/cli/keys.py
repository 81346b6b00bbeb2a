"""``endo3d keys``: certificates for the hosts of a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from endo3d.services.runtime.hosts import HOST_NAME, Role

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Certificates for the hosts of a rig: nobody joins from another host without one.",
)

AUTHORITY_DAYS = 3650
HOST_DAYS = 825
"""What today's TLS libraries accept at most."""

FolderOption = Annotated[
    Path | None, typer.Option("--folder", help="Where keys lie; by default $ENDO3D_KEYS or ~/.config/endo3d/keys.")
]


@app.command()
def init(
    rig: Annotated[str, typer.Argument(help="The rig's name, for people to read.")] = "rig",
    folder: FolderOption = None,
    days: Annotated[int, typer.Option("--days", min=1, help="How long it is valid.")] = AUTHORITY_DAYS,
) -> None:
    """Make the authority that signs the certificates of a rig's hosts.

    Its key stays in this folder: whoever has it can let anybody in. Back it up, and never copy it to a host.
    """
    from endo3d.services.runtime.certificates import make_authority
    from endo3d.services.runtime.identity import keys_folder

    print(make_authority(folder or keys_folder(), rig, days))


@app.command()
def host(
    name: Annotated[str, typer.Argument(help="The host's name in the stack file: [hosts.NAME].")],
    role: Annotated[Role, typer.Option("--role", help="rig takes part, operator sees and commands, viewer sees.")],
    address: Annotated[
        list[str] | None, typer.Option("--address", help="Where others reach it, name or number; repeatable.")
    ] = None,
    folder: FolderOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write its files there, to be copied to the host's own folder of keys.")
    ] = None,
    days: Annotated[int, typer.Option("--days", min=1, help="How long it is valid.")] = HOST_DAYS,
) -> None:
    """Make a host's certificate and key: NAME.pem, NAME.key, and ca.pem beside them.

    Example: endo3d keys host workstation --role operator --out workstation-keys
    """
    import re

    from endo3d.services.runtime.certificates import make_host
    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.identity import keys_folder

    if not re.fullmatch(HOST_NAME, name):
        raise UserError(f"{name!r} is no host's name: letters, digits and -, at most 32")
    authority = folder or keys_folder()
    print(make_host(authority, out or authority, name, role, address or [], days))
