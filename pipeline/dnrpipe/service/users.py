"""Who may do what: named tokens with roles, from the operator's token file.

    viewer      looks at everything
    submitter   also uploads scenes, submits jobs, and cancels, retries and deletes what is their own
    admin       also what is others'
    worker      takes whole jobs over HTTP (`dnrpipe worker`), nothing else

Without a token file the server listens on the loopback interface, and everybody there is its admin.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from fastapi import Depends
from starlette.requests import HTTPConnection

from ..core.errors import UserError

Role = Literal["viewer", "submitter", "admin", "worker"]
TOKEN_PATTERN = r"[A-Za-z0-9_-]{16,256}"
USER_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
MAKE_ONE = "python -c 'import secrets; print(secrets.token_urlsafe(32))'"


@dataclass(frozen=True)
class User:
    """name: as the token file has it."""

    name: str
    role: Role

    def may_change(self, owner: str | None) -> bool:
        """Whether what belongs to ``owner`` (None: nobody) is this user's to cancel, retry and delete."""
        return self.role == "admin" or (self.role == "submitter" and owner == self.name)


LOCAL = User("local", "admin")
"""Everybody, where no token is needed."""


def read_token(path: Path) -> str:
    """The one token in a file. Raises UserError: unreadable, readable by others, too short or of other letters."""
    text = _private_text(path)
    if not re.fullmatch(TOKEN_PATTERN, text):
        raise UserError(
            f"{path}: a token is 16 to 256 letters, digits, dashes and underscores; make one with `{MAKE_ONE} > {path}`"
        )
    return text


def read_users(path: Path) -> Mapping[str, User]:
    """By token: the users of a file with one line ``NAME ROLE TOKEN`` each, or with one token alone, the admin's.

    Raises UserError: as `read_token`; an unknown role; a name or a token twice.
    """
    lines = [words for line in _private_text(path).splitlines() if (words := line.partition("#")[0].split())]
    if len(lines) == 1 and len(lines[0]) == 1:
        return {read_token(path): User("admin", "admin")}
    found: dict[str, User] = {}
    for number, words in enumerate(lines, 1):
        where = f"{path}, user {number}"
        if len(words) != 3:
            raise UserError(f"{where}: expected NAME ROLE TOKEN, or in the whole file one token alone")
        name, role, token = words
        if not re.fullmatch(USER_PATTERN, name) or name in (user.name for user in found.values()):
            raise UserError(f"{where}: {name[:80]!r} is twice there, or no name (letters, digits, dot, - and _)")
        if role not in get_args(Role):
            raise UserError(f"{where}: {role[:80]!r} is no role; there are {', '.join(get_args(Role))}")
        if not re.fullmatch(TOKEN_PATTERN, token) or token in found:
            raise UserError(f"{where}: the token is twice there, or is no token; make one with `{MAKE_ONE}`")
        found[token] = User(name, role)  # type: ignore[arg-type]  # checked
    if not found:
        raise UserError(f"{path}: has no token; make one with `{MAKE_ONE} > {path}`")
    return found


def _private_text(path: Path) -> str:
    try:
        mode, text = path.stat().st_mode, path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as a token file ({error})") from None
    if mode & (stat.S_IRGRP | stat.S_IROTH):
        raise UserError(f"{path}: others can read it; run `chmod 600 {path}`")
    return text


def _caller(connection: HTTPConnection) -> User:
    return connection.state.user


Caller = Annotated[User, Depends(_caller)]
"""Who sent the request; the guard says so."""
