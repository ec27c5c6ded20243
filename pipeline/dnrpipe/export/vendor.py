"""onnxruntime-web from npm, once per machine: what the page runs the network with."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tarfile
import tempfile
from importlib.resources import files
from pathlib import Path

from dnrtrain.atomic import atomic_path, write_text

from ..core.errors import UserError

VERSION = "1.30.0"
SHA256 = "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71"
FILES = (
    "ort.wasm.bundle.min.mjs",
    "ort-wasm-simd-threaded.wasm",
    "ort.webgpu.bundle.min.mjs",
    "ort-wasm-simd-threaded.asyncify.wasm",
)


def runtime() -> Path:
    """The folder with FILES and ``LICENSE``, in the cache; fetched by npm the first time and checked against SHA256.

    Raises UserError: no npm, no network, or other bytes than expected.
    """
    cache = Path(os.environ.get("DNRPIPE_CACHE") or Path.home() / ".cache" / "dnrpipe")
    folder = cache / f"onnxruntime-web-{VERSION}"
    if all((folder / name).is_file() for name in (*FILES, "LICENSE")):
        return folder
    npm = shutil.which("npm")
    if npm is None:
        raise UserError("npm is not installed: the page needs onnxruntime-web from it, once; install Node.js")
    with tempfile.TemporaryDirectory(prefix="dnrpipe-") as scratch:
        command = [npm, "pack", f"onnxruntime-web@{VERSION}", "--silent"]
        done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, timeout=600, check=False)
        (archive,) = [*Path(scratch).glob("*.tgz")] or [None]
        if done.returncode != 0 or archive is None:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise UserError(f"npm did not deliver onnxruntime-web {VERSION} ({reason}); try again with a network")
        found = hashlib.sha256(archive.read_bytes()).hexdigest()
        if found != SHA256:
            raise UserError(f"onnxruntime-web {VERSION} from npm has other bytes than expected (sha256 {found})")
        with tarfile.open(archive) as content:
            for name in FILES:
                member = content.extractfile(f"package/dist/{name}")
                assert member is not None
                with atomic_path(folder / name) as temporary:
                    temporary.write_bytes(member.read())
    licence = files("dnrpipe.export") / "page" / "onnxruntime-LICENSE"
    write_text(folder / "LICENSE", licence.read_text(encoding="utf-8").format(version=VERSION))
    return folder
