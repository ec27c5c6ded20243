"""Bytes and frames a second of a page that `dnrpipe export-web` wrote, from a static server, in headless Chromium.

    python -m tools.bench_page page [--side 256] [--json]

Software GL and WebAssembly want two idle cores; `chrt -r 1 python -m ...` takes them from everything else meanwhile.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import sys
import threading
from pathlib import Path
from typing import Any

from dnrpipe.core.errors import UserError
from dnrpipe.export.browser import open_page, wait_for
from dnrpipe.export.web import OFFLINE


class StaticServer(http.server.ThreadingHTTPServer):
    """Serves a folder on a free port while it is entered. `sent`: bytes of each file that was asked for, by path."""

    def __init__(self, folder: Path, headers: dict[str, str] | None = None) -> None:
        sent = self.sent = dict[str, int]()

        class Handler(http.server.SimpleHTTPRequestHandler):
            def end_headers(self) -> None:
                for name, value in (headers or {}).items():
                    self.send_header(name, value)
                super().end_headers()

            def copyfile(self, source: Any, outputfile: Any) -> None:
                content = source.read()
                sent[self.path] = len(content)
                outputfile.write(content)

            def log_message(self, format: str, *args: Any) -> None: ...

        super().__init__(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))

    def __enter__(self) -> StaticServer:
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/index.html"


def bench(folder: Path, side: int) -> dict[str, Any]:
    """Bytes of the folder (without offline.js), of offline.js, of the first load; `figures` of viewer.js on a turntable
    of that width in pixels. Raises UserError: no such page, no Chromium, or the page failed in it."""
    if not (folder / OFFLINE).is_file():
        raise UserError(f"{folder}: no page of `dnrpipe export-web`")
    offline = (folder / OFFLINE).stat().st_size
    whole = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    with StaticServer(folder) as server, open_page(server.address) as (page, _):
        figures = wait_for(page, f"window.dnr.then(page => page.measure({side}))")
        sent = sum(server.sent.values())
    return {"folder": whole - offline, "offline": offline, "first_load": sent, "side": side, **figures}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    try:
        found = bench(given.page, given.side)
    except UserError as error:
        sys.exit(str(error))
    if given.json:
        print(json.dumps(found))
        return
    sizes = {name: f"{found[name] / 1e6:.2f} MB" for name in ("folder", "first_load", "offline")}
    print(f"folder {sizes['folder']}, first load {sizes['first_load']}; offline.js {sizes['offline']} more")
    print(
        f"{given.side} pixels: {found['fps']:.1f} frames a second; {found['frame_ms']:.0f} ms a frame, network"
        f" {found['network_ms']:.0f}, waiting for WebGL2 {found['wait_ms']:.0f} ({found['provider']}, {found['gl']})"
    )


if __name__ == "__main__":
    main()
