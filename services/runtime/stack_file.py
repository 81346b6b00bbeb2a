"""A stack file: one TOML in flow order, one table per service.

    [rig]
    name = "bench"
    head = "base6_wd20"        # deploy/heads, or a file

    [grabber]                  # table name = module name; keys = its Config
    camera = "sim:"

    [left]                     # a second instance, or a module of your own ("package.module")
    module = "decoder"

Several hosts: see ``hosts.py``.

Nothing is imported until an entry is asked for: a child process loads only the service that it runs.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import json
import pkgutil
import re
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import HOST_NAME, RELAY, ROUTER, HostTable, Placement, placement_of
from endo3d.services.runtime.identity import keys_folder
from endo3d.services.runtime.service import Config, Service, Source

M = TypeVar("M", bound=BaseModel)

RESERVED = frozenset({"module", "host"})
"""Keys of a service's table that are the loader's own, not the service's."""


class RigTable(BaseModel):
    """The ``[rig]`` table: what all services share."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field("rig", pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
    """The second part of every key: ``endo3d/<name>/...``."""
    head: str = "base6_wd20"
    """A stock head's name, or a file with the calibration, relative to the stack file."""
    port: int | None = Field(None, ge=1024, le=65535)
    """Where the services of this host meet, on the loopback; None derives it from the name."""
    keys: str = ""
    """Folder of the certificates for other hosts; by default ``$ENDO3D_KEYS``, or ~/.config/endo3d/keys."""


@dataclass(frozen=True)
class Entry:
    """One service of a stack: its table, validated."""

    name: str
    module: str
    kind: type[Service[Any]]
    config: Config

    @property
    def is_source(self) -> bool:
        return issubclass(self.kind, Source)

    def build(self) -> Service[Any]:
        """The service itself; nothing is opened yet. Raises ``UserError``."""
        try:
            return self.kind(self.config)
        except ValueError as error:
            raise UserError(f"[{self.name}] {error}") from None


@dataclass(frozen=True)
class Stack:
    """A parsed stack file. ``entry`` and ``entries`` import and validate, and raise ``UserError``."""

    path: Path | None
    """None when it came from a log."""
    base: Path
    """What relative paths in it start from: the file's folder, for a stock stack the current one."""
    toml: str
    """The effective text, overrides applied."""
    rig: RigTable
    tables: Mapping[str, Mapping[str, Any]]
    """The services' tables, in flow order."""
    placement: Placement
    """Which of them runs where."""
    host: str = ""
    """The host that this process is on, of a stack with several."""

    @property
    def label(self) -> str:
        return str(self.path) if self.path else "stack"

    @property
    def head(self) -> Path:
        """The file with the calibration."""
        return _stock_or_file("head", self.rig.head, "heads", ".yaml", self.base)

    def on(self, host: str) -> Stack:
        """The same stack, seen from one of its hosts. Raises ``UserError`` for a host that it hasn't."""
        known = self.placement.hosts
        if not known and host:
            raise UserError(f"{self.label} has no hosts; leave --host out, or add [hosts.{host}]")
        if known and host not in known:
            which = f"no host {host!r}" if host else "several hosts: say which one this is, --host NAME"
            raise UserError(f"{self.label} has {which}; {_nearest(host, known)}")
        return replace(self, host=host)

    def share(self) -> dict[str, str]:
        """Tables whose services run on this host -> the names by which they go."""
        return self.placement.on(self.host) if self.host else {table: table for table in self.tables}

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """All services, in flow order."""
        return tuple(self.entry(name) for name in self.tables)

    def entry(self, name: str) -> Entry:
        """One service, imported and validated."""
        kind = self.kind(name)
        given = {key: value for key, value in self.tables[name].items() if key not in RESERVED}
        return Entry(name, kind.__module__.rpartition(".")[2], kind, self._config(name, kind.Config, given))

    def kind(self, name: str) -> type[Service[Any]]:
        """The class behind a table, imported; its keys are not looked at."""
        if name not in self.tables:
            raise UserError(f"{self.label} has no service {name!r}; {_nearest(name, self.tables)}")
        return _service_class(self.tables[name].get("module", name), self._where(name, "module"))

    def _config(self, name: str, model: type[Config], given: dict[str, Any]) -> Config:
        shared = {"rig": self.rig.name, "stack": str(self.path or ""), "stack_toml": self.toml, "host": self.host}
        if "keys" in model.model_fields:
            shared["keys"] = str(keys_folder(self.rig.keys, self.base))
        if "head" in model.model_fields:
            shared["head"] = str(self.head)
        known = {key: value for key, value in shared.items() if key in model.model_fields}
        paths = {
            key: str(self.base / Path(value).expanduser())
            for key, value in given.items()
            if isinstance(value, str) and key in model.model_fields and _is_path(model.model_fields[key].annotation)
        }
        try:
            return model.model_validate(known | given | paths)
        except ValidationError as error:
            raise UserError(self._explain(name, model, error)) from None

    def _checked(self, table: str, model: type[M], given: object) -> M:
        """A table that is no service's."""
        try:
            return model.model_validate(given)
        except ValidationError as error:
            raise UserError(self._explain(table, model, error)) from None

    def _explain(self, table: str, model: type[BaseModel], error: ValidationError) -> str:
        """The first fault in one line: where, what, and the nearest right key."""
        first, *others = error.errors()
        key = str(first["loc"][0]) if first["loc"] else ""
        where = self._where(table, key)
        more = f" (and {len(others)} more)" if others else ""
        if first["type"] == "extra_forbidden":
            known = [field for field in model.model_fields if field not in ("rig", "stack", "stack_toml")]
            return f"{where}: [{table}] has no key {key!r}; {_nearest(key, known)}{more}"
        if first["type"] == "missing":
            return f"{where}: [{table}] needs the key {key!r}; add it{more}"
        what = first["msg"].removeprefix("Value error, ")
        value = f"{table}.{key} = {first['input']!r}"
        return f"{where}: {value} is wrong: {what}; `endo3d check --keys {table}` lists what it takes{more}"

    def _where(self, table: str, key: str = "") -> str:
        """``file:line`` of a key, or of its table."""
        line = line_of(self.toml, table, key)
        return f"{self.label}:{line}" if line else self.label


def load(source: str | Path, overrides: Sequence[str] = ()) -> Stack:
    """Parse a stack file, or a stock stack by its name, with ``table.key=value`` overrides applied.

    Raises ``UserError`` for a missing file, bad TOML, a bad override or a bad ``[rig]`` table.
    """
    path = _stock_or_file("stack", str(source), "stacks", ".toml", Path.cwd())
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"can't read {path}: {error}; check the file") from None
    return loads(text, overrides, path=path, base=Path.cwd() if path in stock("stacks").values() else path.parent)


def loads(text: str, overrides: Sequence[str] = (), *, path: Path | None = None, base: Path | None = None) -> Stack:
    """Parse a stack's text, e.g. the one that a log carries."""
    label = str(path) if path else "stack"
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{label} is not valid TOML: {error}; correct that line") from None
    stray = [key for key, value in tables.items() if not isinstance(value, dict)]
    if stray:
        line = line_of(text, "", stray[0])
        raise UserError(f"{label}:{line}: {stray[0]!r} stands outside of a table; move it below [rig] or a service")
    for override in overrides:
        _override(tables, override)
    if overrides:
        text = to_toml(tables)
    rig, hosts = tables.pop("rig", {}), tables.pop("hosts", {})
    if hosts:
        tables |= {name: tables.pop(name, {}) for name in (RELAY, ROUTER)}  # last to stop: others are heard to the end
    stack = Stack(path, base or Path.cwd(), text, RigTable.model_construct(), tables, Placement({}, {}))
    checked = {name: stack._checked(f"hosts.{name}", HostTable, table) for name, table in hosts.items()}
    if wrong := next((name for name in hosts if not re.fullmatch(HOST_NAME, name)), None):
        raise UserError(f"{stack._where(f'hosts.{wrong}')}: {wrong!r} is no host's name: letters, digits and -")
    try:
        placement = placement_of(checked, tables)
    except UserError as error:
        raise UserError(f"{label}: {error}") from None
    return replace(stack, rig=stack._checked("rig", RigTable, rig), placement=placement)


def stock(kind: str) -> dict[str, Path]:
    """The stock files that come with endo3d: ``stacks`` or ``heads``, by name."""
    folder = Path(str(resources.files("endo3d.deploy"))).resolve() / kind
    return {path.stem: path for path in sorted(folder.iterdir()) if path.suffix in (".toml", ".yaml")}


def service_modules() -> list[str]:
    """The modules of ``endo3d.services`` that may hold a service."""
    services = importlib.import_module("endo3d.services")
    return sorted(module.name for module in pkgutil.iter_modules(services.__path__) if not module.ispkg)


def to_toml(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Tables of plain values as TOML; reads back as the same."""
    return "\n".join(
        f"[{name}]\n" + "".join(f"{key} = {_toml_value(value)}\n" for key, value in table.items())
        for name, table in tables.items()
    )


def line_of(text: str, table: str, key: str = "") -> int | None:
    """Line number of a key in a table, of the table's head when it has no such key, None when neither."""
    current, head = "", None
    for number, line in enumerate(text.splitlines(), 1):
        if match := re.match(r"\s*\[\s*([\w.-]+)\s*\]", line):
            current = match[1]
            if current == table:
                head = number
        elif current == table and key and re.match(rf"\s*{re.escape(key)}\s*=", line):
            return number
    return head


def _override(tables: dict[str, Any], override: str) -> None:
    target, separator, value = override.partition("=")
    table, dot, key = target.strip().partition(".")
    if not (separator and dot and key):
        raise UserError(f"--set {override}: this is not table.key=value, e.g. --set decoder.mode=interleaved")
    if table not in ("rig", ROUTER, RELAY) and table not in tables:
        raise UserError(f"--set {override}: the stack has no table [{table}]; {_nearest(table, tables)}")
    *within, last = key.split(".")  # hosts.NAME.key
    keys = tables.setdefault(table, {})
    for name in within:
        keys = keys.setdefault(name, {})
    keys[last] = _plain_value(value.strip())


def _plain_value(text: str) -> Any:
    """A TOML value, or the bare text: ``3``, ``true``, ``[1, 2]``, ``interleaved f1=25``."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml_value(key)} = {_toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # legal in JSON, not in TOML
    return str(value)


def _stock_or_file(what: str, name: str, kind: str, suffix: str, base: Path) -> Path:
    """The file meant by a path or by a stock file's name."""
    path = base / Path(name).expanduser()
    if path.is_file():
        return path.resolve()
    known = stock(kind)
    if name in known:
        return known[name]
    looks_like_file = "/" in name or name.endswith(suffix)
    hint = "check the path" if looks_like_file else _nearest(name, known)
    raise UserError(f"no {what} {name!r} here; {hint}")


def _service_class(module: str, where: str) -> type[Service[Any]]:
    """The one service of a module of ``endo3d.services``, or of a module of the user's own (with a dot)."""
    qualified = module if "." in module else f"endo3d.services.{module}"
    try:
        loaded = importlib.import_module(qualified)
    except ModuleNotFoundError as error:
        if error.name == qualified or (error.name and qualified.startswith(error.name + ".")):
            raise UserError(f"{where}: no service module {module!r}; {_nearest(module, service_modules())}") from None
        raise UserError(f"service {module!r} needs the package {error.name!r}; pip install it") from None
    kinds = [
        kind
        for kind in vars(loaded).values()
        if inspect.isclass(kind) and issubclass(kind, Service) and kind.__module__ == loaded.__name__
    ]
    if len(kinds) != 1:
        raise UserError(f"{where}: module {module!r} holds {len(kinds)} services, not one; name another module")
    return kinds[0]


def _is_path(annotation: Any) -> bool:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return any(_is_path(argument) for argument in typing.get_args(annotation))
    return inspect.isclass(annotation) and issubclass(annotation, Path)


def _nearest(name: str, known: Iterable[str]) -> str:
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    listed = f"known: {', '.join(known) or 'none'}"
    return f"the nearest is {close[0]!r} ({listed})" if close else listed
