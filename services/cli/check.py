"""``endo3d check``: a stack file, validated and drawn."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from endo3d.services.cli.options import JsonOption, SetOption, StackArgument

if TYPE_CHECKING:
    from rich.tree import Tree

    from endo3d.services.runtime.graph import Graph
    from endo3d.services.runtime.stack_file import Stack


def check(
    stack: StackArgument = "demo",
    overrides: SetOption = None,
    as_json: JsonOption = False,
    mermaid: Annotated[bool, typer.Option("--mermaid", help="The graph for a README.")] = False,
    dot: Annotated[bool, typer.Option("--dot", help="The graph for Graphviz.")] = False,
    zenohd: Annotated[
        bool, typer.Option("--zenohd", help="The router's configuration, for a stock zenohd (JSON5).")
    ] = False,
    keys: Annotated[
        str, typer.Option("--keys", metavar="SERVICE", help="List the keys of a service's table.")
    ] = "",
) -> None:
    """Check a stack file and print its dataflow.

    Refuses an unknown key, a read that nobody writes, and two writers of one topic.

    Examples: endo3d check demo; endo3d check my.toml --keys decoder
    """
    from rich import print as show

    from endo3d.services.runtime import graph, stack_file

    described = stack_file.load(stack, overrides or ())
    if keys:
        _show_keys(described, keys)
        return
    wiring = graph.of(described)
    if zenohd:
        print(_zenohd(described))
    elif as_json:
        print(json.dumps(wiring.as_dict(), indent=2))
    elif mermaid:
        print(wiring.mermaid())
    elif dot:
        print(wiring.dot())
    else:
        show(_tree(described, wiring))


def _zenohd(stack: Stack) -> str:
    """What the router service gives to zenoh, with the certificates where a unit file has them."""
    from pathlib import Path

    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.identity import AUTHORITY, Identity
    from endo3d.services.runtime.network import nested, router_settings

    if not stack.placement.hosts:
        raise UserError(f"{stack.label} has no hosts, and so no router; add [hosts.NAME] tables")
    folder, host = Path(stack.rig.keys or "/etc/endo3d/keys"), stack.placement.router
    identity = Identity(folder / f"{AUTHORITY}.pem", folder / f"{host}.pem", folder / f"{host}.key")
    settings = nested(router_settings(stack.rig.name, stack.placement, identity))
    head = f"// Written by: endo3d check {stack.path.stem if stack.path else 'STACK'} --zenohd\n"
    head += "// Run as: zenohd --config FILE, in the place of the stack's own router.\n"
    return head + json.dumps(settings, indent=2)


def _tree(stack: Stack, wiring: Graph) -> Tree:
    from rich.tree import Tree

    tree = Tree(f"[bold]endo3d/{wiring.rig}[/]  [dim]{stack.label}, head {stack.rig.head}[/]")
    hosts = stack.placement.services
    for entry in wiring.entries:
        other = f" [dim](module {entry.module})[/]" if entry.module != entry.name else ""
        where = f" [yellow]on {', '.join(hosts[entry.name]) or 'no host: zenohd stands in'}[/]" if hosts else ""
        branch = tree.add(f"[bold cyan]{entry.name}[/]{other}{where}")
        for topic in entry.kind.writes:
            how = f"{topic.message.__name__}, up to {topic.rate_hz:g} Hz"
            how += ", shared memory" if topic.bulk else ""
            readers = wiring.readers(entry.name, topic)
            branch.add(f"[green]{topic.name}[/] [dim]({how})[/] → {', '.join(readers) or '[dim]nobody[/]'}")
        if not entry.kind.writes and entry.kind.reads:
            read = sorted({edge.topic.name for edge in wiring.edges if edge.reader == entry.name})
            branch.add(f"[dim]reads {', '.join(read)}[/]")
    if hosts:
        _add_hosts(tree, stack, wiring)
    return tree


def _add_hosts(tree: Tree, stack: Stack, wiring: Graph) -> None:
    """The hosts, and what crosses between them."""
    from endo3d.services.runtime.hosts import lanes

    for name, host in stack.placement.hosts.items():
        router = f", router at {stack.placement.endpoint}" if name == stack.placement.router else ""
        thin = ", reduced streams" if host.preview else ""
        branch = tree.add(f"[bold yellow]{name}[/] [dim]({host.role}{router}{thin})[/]")
        for lane in lanes(stack.placement, wiring):
            crossing = [topic.name for topic in lane.topics if not topic.per_service]
            if lane.sender == name and crossing:
                shared = " [dim](its share of the frames)[/]" if lane.shared else ""
                branch.add(f"[green]{', '.join(crossing)}[/]{shared} → {lane.receiver}")


def _show_keys(stack: Stack, service: str) -> None:
    from rich import box
    from rich import print as show
    from rich.table import Table

    table = Table(title=f"[{service}]", box=box.SIMPLE, title_justify="left")
    for column in ("key", "type", "default", "here"):
        table.add_column(column)
    given = stack.tables.get(service, {})
    for name, field in stack.kind(service).Config.model_fields.items():
        default = "required" if field.is_required() else repr(field.get_default(call_default_factory=True))
        annotation = getattr(field.annotation, "__name__", str(field.annotation))
        table.add_row(name, annotation, default, repr(given[name]) if name in given else "")
    show(table)
