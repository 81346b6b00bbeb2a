"""Devices are opened by URI: ``scheme:body?option=value&option=value``."""

from __future__ import annotations

import difflib
import importlib
from dataclasses import dataclass, field
from typing import Any


class DeviceError(Exception):
    """A device can't be opened or used; the text says why and what to do."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What a device may need to know about the rig that it belongs to."""

    rig: str
    """The rig's name."""
    head_yaml: str
    """The sensor head's file, as text."""


@dataclass
class Uri:
    """A device's address being read: every option must be asked for before ``finish``."""

    text: str
    scheme: str
    body: str
    options: dict[str, str]
    asked: list[str] = field(default_factory=list)

    @classmethod
    def parse(cls, text: str) -> Uri:
        """Split an address. Raises ``DeviceError``."""
        scheme, colon, rest = text.partition(":")
        if not colon or not scheme:
            raise DeviceError(f"device {text!r} has no scheme; write for example 'sim:'")
        body, _, query = rest.partition("?")
        options: dict[str, str] = {}
        for word in query.split("&") if query else []:
            key, equals, value = word.partition("=")
            if not equals or not key or key in options:
                raise DeviceError(f"device {text!r}: {word!r} is not a new option=value")
            options[key] = value
        return cls(text, scheme, body, options)

    def text_of(self, key: str, default: str) -> str:
        self.asked.append(key)
        return self.options.get(key, default)

    def number(self, key: str, default: float) -> float:
        text = self.text_of(key, repr(default))
        try:
            return float(text)
        except ValueError:
            raise DeviceError(f"device {self.text!r}: {key}={text} is not a number") from None

    def finish(self) -> None:
        """Raises ``DeviceError`` for an option that the driver doesn't know, with the nearest right one."""
        for key in self.options:
            if key not in self.asked:
                near = difflib.get_close_matches(key, self.asked, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"it knows: {', '.join(self.asked) or 'none'}"
                raise DeviceError(f"device {self.text!r} has no option {key!r}; {hint}")


def open_device(text: str, role: str, drivers: tuple[str, ...], setting: Setting) -> Any:
    """Import ``<scheme>_<role>`` beside this file and let its ``open_uri`` open the device."""
    uri = Uri.parse(text)
    if uri.scheme not in drivers:
        raise DeviceError(f"no {role} driver {uri.scheme!r}; there are: {', '.join(drivers)}")
    module = importlib.import_module(f"endo3d.services.devices.{uri.scheme}_{role}")
    return module.open_uri(uri, setting)
