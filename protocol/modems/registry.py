"""Modem URLs to drivers. Adding a dialect is one module and one line here."""

import importlib
from collections.abc import Callable
from typing import cast

from protocol.errors import ConfigError
from protocol.modems.base import Modem, ModemContext, ModemUrl

DIALECTS: dict[str, str] = {
    "loopback": "protocol.modems.loopback:open_loopback",
    "micromodem": "protocol.modems.micromodem:open_micromodem",
    "nanomodem": "protocol.modems.nanomodem:open_nanomodem",
    "serial": "protocol.modems.serial_line:open_serial",
}
"""Scheme to module:function; imported when asked for, so one broken driver harms no other."""


def open_modem(url: str, context: ModemContext | None = None) -> Modem:
    """Return the driver that a URL names, its port open.

    Raises
    ------
    ConfigError
        For a text that is no URL, an unknown scheme or an unknown option.
    ModemUnavailable
        When the port is not there.
    """
    parsed = ModemUrl.parse(url)
    if parsed.scheme not in DIALECTS:
        known = ", ".join(f"{scheme}://" for scheme in sorted(DIALECTS))
        raise ConfigError(f"no modem dialect {parsed.scheme!r}; known are {known}")
    module_name, function_name = DIALECTS[parsed.scheme].split(":")
    opener = getattr(importlib.import_module(module_name), function_name)
    return cast(Callable[[ModemUrl, ModemContext], Modem], opener)(
        parsed, context or ModemContext()
    )
