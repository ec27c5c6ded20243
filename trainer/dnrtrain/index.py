"""Downloads: a plain URL, or one named file from a Python package index, without running an installer.

``pip download`` of a source archive would execute its setup.py to read metadata; this only fetches bytes.
"""

from __future__ import annotations

import hashlib
import html
import http.client
import os
import re
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request

CONNECT_SECONDS = 15.0
"""Longest silence on a connection; an unreachable host must cost seconds, not minutes."""
DEFAULT_INDEX = "https://pypi.org/simple"
MAX_BYTES = 1 << 30


class DownloadError(RuntimeError):
    """A source is unreachable or delivers something else; the message is one line."""


def download(url: str) -> bytes:
    """The body behind a URL (https, http or file). Raises DownloadError."""
    request = urllib.request.Request(url, headers={"User-Agent": "dnrpipe", "Accept": "text/html, */*;q=0.1"})
    try:
        with urllib.request.urlopen(request, timeout=CONNECT_SECONDS) as response:
            body = response.read(MAX_BYTES + 1)
    except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
        raise DownloadError(f"{url}: {getattr(error, 'reason', error)}") from None
    if len(body) > MAX_BYTES:
        raise DownloadError(f"{url}: larger than expected")
    return body


def download_from_index(project: str, filename: str, *, sha256: str) -> bytes:
    """One file of a project from the configured package indexes (PEP 503), SHA-256 verified.

    Raises:
        DownloadError: no index has it, none is reachable, or the checksum differs.
    """
    reasons: list[str] = []
    for index in package_indexes():
        page_url = f"{index.rstrip('/')}/{project}/"
        try:
            page = download(page_url if not page_url.startswith("file:") else f"{page_url}index.html")
            link = _find_link(page.decode("utf-8", "replace"), filename)
            if link is None:
                raise DownloadError(f"{page_url}: does not list {filename}")
            body = download(urllib.parse.urljoin(page_url, link))
        except DownloadError as error:
            reasons.append(str(error))
            continue
        if hashlib.sha256(body).hexdigest() == sha256:
            return body
        reasons.append(f"{page_url}: {filename} has another checksum than expected")
    raise DownloadError("; ".join(reasons))


def package_indexes() -> list[str]:
    """Index URLs as pip would use them: environment, pip's configuration, else pypi.org."""
    first = os.environ.get("PIP_INDEX_URL") or _pip_setting("global.index-url") or DEFAULT_INDEX
    extra = os.environ.get("PIP_EXTRA_INDEX_URL") or _pip_setting("global.extra-index-url")
    return list(dict.fromkeys([first, *extra.split()]))


def _pip_setting(key: str) -> str:
    command = [sys.executable, "-m", "pip", "config", "get", key]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""  # no pip here: its configuration does not exist either
    return done.stdout.strip() if done.returncode == 0 else ""


def _find_link(page: str, filename: str) -> str | None:
    """The href of ``filename`` on a simple-index page, without its fragment."""
    for match in re.finditer(r'href\s*=\s*["\']([^"\']+)["\']', page, flags=re.IGNORECASE):
        link = html.unescape(match.group(1)).split("#", 1)[0]
        if urllib.parse.unquote(link.rsplit("/", 1)[-1].split("?", 1)[0]) == filename:
            return link
    return None
