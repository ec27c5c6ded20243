"""Words for people. Imports nothing: the command line's help needs it."""

from __future__ import annotations


def one_line(text: object) -> str:
    """A text or an error's message in one line; runs of white space become one space."""
    return " ".join(str(text).split())
