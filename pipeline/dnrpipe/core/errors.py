"""Errors that are the user's to mend: one clear line, exit code 2, no traceback."""

from __future__ import annotations


class UserError(Exception):
    """Bad input. The message says what is wrong, where, and what to do, in one line whatever it quotes."""

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())


class NothingVisible(UserError):
    """A readable scene without any surface: there is nothing to make pictures of."""
