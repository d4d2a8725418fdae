"""Cleaning settings: the rules that run, and the limits of trust."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Annotated

from msgspec import Meta

from imutool import registry
from imutool.config import Settings
from imutool.errors import ConfigError

GROUP = "imutool.clean"  # of rules: one file each

Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class CleaningSettings(Settings, frozen=True, kw_only=True):
    """Rules that run (by default all), and the limits of trust."""

    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    convert_units: bool = True  # where the unit is settled beyond doubt; else it is only said
    max_invalid_share: Share = 0.1  # of the messages dropped, from which on the log is not trusted
    max_missing_share: Share = 0.3  # of the samples its own rate would have brought
    force: bool = False  # clean what cannot be trusted all the same

    def names(self) -> list[str]:
        """Rules that run, sorted by name.

        Raises:
            ConfigError: a name that is no rule; the message names the nearest.
        """
        known = every()
        for name in (*self.only, *self.without):
            if name not in known:
                registry.load(GROUP, name)  # says what was meant
        return [name for name in known if (not self.only or name in self.only) and name not in self.without]


@cache
def every() -> tuple[str, ...]:
    """Rules, sorted by name; the installed packages are listed once."""
    return tuple(registry.names(GROUP))


def chosen(only: Iterable[str], without: Iterable[str], force: bool = False) -> CleaningSettings:
    """Settings for the rules of a command line.

    Raises:
        ConfigError: a name that is no rule, or one both asked for and left out.
    """
    rules = CleaningSettings(only=tuple(only), without=tuple(without), force=force)
    rules.names()
    if both := set(rules.only) & set(rules.without):
        raise ConfigError(f"{min(both)} is asked for and left out", where="rule", fix="Give `rule` or `no_rule`")
    return rules
