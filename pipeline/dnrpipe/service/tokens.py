"""Token files: one line, readable by their owner alone."""

from __future__ import annotations

import re
import stat
from pathlib import Path

from ..core.errors import UserError

PATTERN = r"[A-Za-z0-9_-]{16,256}"


def read_token(path: Path) -> str:
    """The token in a file. Raises UserError: unreadable, readable by others, too short or of other letters."""
    try:
        mode, text = path.stat().st_mode, path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as a token file ({error})") from None
    if mode & (stat.S_IRGRP | stat.S_IROTH):
        raise UserError(f"{path}: others can read it; run `chmod 600 {path}`")
    if not re.fullmatch(PATTERN, text):
        raise UserError(
            f"{path}: a token is 16 to 256 letters, digits, dashes and underscores;"
            f" make one with `python -c 'import secrets; print(secrets.token_urlsafe(32))' > {path}`"
        )
    return text
