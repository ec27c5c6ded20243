"""The live viewer's WebSocket: ``/workspaces/<name>/live``.

server  {"kind": "hello", center, radius, distance, size, modes}                  text
client  a LiveRequest as JSON, at any time; only the newest one counts            text
server  4 bytes length of the header, little endian; header as JSON; the picture  binary
        header: type, width, height, mode, moving, refined, samples, rays, spp, repaired, ms by stage, total_ms,
        waited_ms, viewers, nearest
server  {"kind": "problem", "detail": one line}                                   text

After the last request of a moving camera the server renders the view once more at full quality; it adds samples to a
reference, and rays to a base image, until the next request; refined counts such frames.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import struct
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Path, WebSocket, WebSocketDisconnect
from pydantic import ValidationError

from dnrtrain.text import one_line

from ..core.errors import UserError
from .guard import SUBPROTOCOL
from .live_pool import MOST_RAYS, MOST_SPP, LiveSession
from .live_scene import LiveRequest
from .models import NAME_PATTERN, first_fault
from .state import get_state

SETTLED = 0.2
"""Seconds without a request after which a moving camera counts as at rest."""
REFINED = {
    **dict.fromkeys(("reference", "error"), ("spp", MOST_SPP)),
    **dict.fromkeys(("neural", "base"), ("rays", MOST_RAYS)),
}
"""Modes whose pictures get better while the camera rests: by which figure of the answer, and until where."""
REFUSED = 1008

router = APIRouter()


Latest = asyncio.Queue[LiveRequest | None]
"""Holds one: a viewer's newest request; None when the viewer has gone."""


@router.websocket("/workspaces/{name}/live")
async def live(socket: WebSocket, name: Annotated[str, Path(pattern=NAME_PATTERN)]) -> None:
    """Frames of a workspace for a camera that moves."""
    service = get_state(socket)
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        with service.stream():
            async with service.live.session(name) as session:
                await socket.send_json({"kind": "hello", **session.scene.hello})
                latest = Latest(1)
                reading = asyncio.create_task(_read(socket, latest))
                try:
                    await _answer(socket, session, latest)
                finally:
                    reading.cancel()
                    await asyncio.gather(reading, return_exceptions=True)
    except WebSocketDisconnect:
        return
    except (UserError, HTTPException) as error:
        detail = str(error.detail) if isinstance(error, HTTPException) else str(error)
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await socket.send_json({"kind": "problem", "detail": one_line(detail)})
            await socket.close(REFUSED)


async def _read(socket: WebSocket, latest: Latest) -> None:
    def put(request: LiveRequest | None) -> None:
        if latest.full():
            latest.get_nowait()
        latest.put_nowait(request)

    try:
        while True:
            text = await socket.receive_text()
            try:
                put(LiveRequest.model_validate_json(text))
            except ValidationError as error:
                await socket.send_json({"kind": "problem", "detail": first_fault(error)})
    except (WebSocketDisconnect, RuntimeError, KeyError):  # gone, or sent bytes where text is wanted
        put(None)


async def _answer(socket: WebSocket, session: LiveSession, latest: Latest) -> None:
    current: LiveRequest | None = None
    unsettled = refining = False
    refined = 0
    while True:
        refined = refined + 1 if refining else 0
        try:
            async with asyncio.timeout(0.0 if refining else SETTLED if unsettled else None):
                current = await latest.get()
                refined = 0
        except TimeoutError:
            if unsettled and current is not None:
                current = current.model_copy(update={"moving": False})
        if current is None:
            return
        try:
            answer = await session.frame(current)
        except UserError as error:
            await socket.send_json({"kind": "problem", "detail": str(error)})
            unsettled = refining = False
            continue
        await socket.send_bytes(pack(answer | {"refined": refined}, current))
        await session.warm(current)
        unsettled = current.moving
        refining = not current.moving and _gets_better(current.mode, answer)


def _gets_better(mode: str, answer: dict[str, Any]) -> bool:
    figure, most = REFINED.get(mode, ("", 0))
    return figure != "" and answer[figure] is not None and answer[figure] < most


def pack(answer: dict[str, Any], request: LiveRequest) -> bytes:
    """Header and picture as one message."""
    facts = {key: value for key, value in answer.items() if key != "picture"}
    header = json.dumps({**facts, "mode": request.mode, "moving": request.moving}).encode()
    return struct.pack("<I", len(header)) + header + base64.b64decode(answer["picture"])


def unpack(message: bytes) -> tuple[dict[str, Any], bytes]:
    """The inverse of `pack`: (header, picture)."""
    (length,) = struct.unpack_from("<I", message)
    return json.loads(message[4 : 4 + length]), message[4 + length :]
