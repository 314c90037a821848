"""The live canvas as a page on this machine: `canvas.js` over one WebSocket for each tab.

Any page in a browser may open sockets to this machine. So the address of page and socket contains a
random token, new for every server, and only the page itself may open the socket (its Origin).
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import secrets
import socket
import struct
from collections.abc import AsyncIterator, Set
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from traitbrdf.studio.session import LARGEST, Header, Session

_HERE = Path(__file__).parent
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' blob: data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def pack(header: Header, buffers: list[bytes]) -> bytes:
    """Pack one message of the socket.

    It is the header's length (uint32, little endian), the header as JSON in UTF-8, and the buffer.

    Parameters
    ----------
    header : dict
    buffers : list of bytes, at most one
    """
    text = json.dumps(header, allow_nan=False).encode()
    return b"".join([struct.pack("<I", len(text)), text, *buffers])


def unpack(message: bytes) -> tuple[object, list[bytes]]:
    """Unpack header and buffer of a message.

    Parameters
    ----------
    message : bytes

    Raises
    ------
    ValueError
        If it is no message.
    """
    if len(message) < 4:
        raise ValueError(f"message: expected at least 4 bytes, got {len(message)}")
    (length,) = struct.unpack_from("<I", message)
    if length > len(message) - 4:
        raise ValueError(f"message: expected a header of {length} bytes, got {len(message) - 4}")
    try:
        header = json.loads(message[4 : 4 + length])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"message: expected a JSON header, got {error}") from None
    rest = message[4 + length :]
    return header, [rest] if rest else []


def application(session: Session, token: str, origins: Set[str]) -> Starlette:
    """Make the web application: the page, its modules and its socket.

    Parameters
    ----------
    session : Session
    token : str
        What the addresses of page and socket have to contain as ``?token=``.
    origins : set of str
        Addresses that the page can have.
    """

    def known(given: str | None) -> bool:
        return given is not None and hmac.compare_digest(given.encode(), token.encode())

    async def page(request: Request) -> Response:
        if not known(request.query_params.get("token")):
            return PlainTextResponse(
                "Expected the address that `traitbrdf studio` printed: it ends in a token.\n",
                403,
                _HEADERS,
            )
        return FileResponse(_HERE / "page.html", headers=_HEADERS)

    async def module(request: Request) -> Response:
        name = request.url.path.lstrip("/")
        return FileResponse(_HERE / name, headers=_HEADERS, media_type="text/javascript")

    async def channel(websocket: WebSocket) -> None:
        if not known(websocket.query_params.get("token")) or (
            websocket.headers.get("origin") not in origins
        ):
            await websocket.close(4403)
            return
        await websocket.accept()
        loop = asyncio.get_running_loop()
        news: asyncio.Queue[bytes] = asyncio.Queue(maxsize=4)

        def offer(message: bytes) -> None:
            if news.full():  # the oldest news that a slow page did not take is out of date
                news.get_nowait()
            news.put_nowait(message)

        def push(header: Header, buffers: list[bytes]) -> None:
            with contextlib.suppress(RuntimeError):  # the server is ending
                loop.call_soon_threadsafe(offer, pack(header, buffers))

        async def pass_on() -> None:
            while True:
                await websocket.send_bytes(await news.get())

        end = session.subscribe(push)
        passing = asyncio.create_task(pass_on())
        try:
            while True:
                message = await websocket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                raw = message.get("bytes")
                try:
                    header, buffers = unpack(raw if raw is not None else b"")
                except ValueError as error:
                    refusal: Header = {"kind": "error", "view": "", "seq": None}
                    await websocket.send_bytes(pack(refusal | {"message": str(error)}, []))
                    continue
                for reply in await run_in_threadpool(session.handle, header, buffers):
                    await websocket.send_bytes(pack(*reply))
        except (WebSocketDisconnect, RuntimeError):  # closed while a reply was under way
            pass
        finally:
            end()
            passing.cancel()

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(session.close)

    return Starlette(
        routes=[
            Route("/", page),
            Route("/canvas.js", module),
            Route("/link.js", module),
            Route("/page.js", module),
            WebSocketRoute("/socket", channel),
        ],
        lifespan=lifespan,
    )


class Server:
    """A session's page on 127.0.0.1, until it is stopped.

    Parameters
    ----------
    session : Session
    port : int
        0 takes any free port.

    Attributes
    ----------
    url, socket_url : str
        Addresses of the page and of its socket, with the token.
    origins : set of str
        Pages that may open the socket; more may be added.
    listener : socket.socket

    Raises
    ------
    OSError
        If the port is taken.
    """

    def __init__(self, session: Session, port: int = 0) -> None:
        self.session = session
        self.token = secrets.token_urlsafe(24)
        # asyncio turns Nagle's algorithm off only if the protocol is named: otherwise every frame
        # comes 40 ms late
        self.listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        try:
            self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.listener.bind(("127.0.0.1", port))
            self.listener.listen(64)  # connections before `run` wait
        except OSError:
            self.listener.close()
            raise
        self.port = int(self.listener.getsockname()[1])
        self.url = f"http://127.0.0.1:{self.port}/?token={self.token}"
        self.socket_url = f"ws://127.0.0.1:{self.port}/socket?token={self.token}"
        self.origins = {f"http://{host}:{self.port}" for host in ("127.0.0.1", "localhost")}
        self._server = uvicorn.Server(
            uvicorn.Config(
                application(session, self.token, self.origins),
                log_level="error",
                access_log=False,
                ws="websockets-sansio",
                ws_per_message_deflate=False,
                ws_max_size=LARGEST,
                timeout_graceful_shutdown=2,
            )
        )

    def run(self) -> None:
        """Serve until `stop` or Ctrl+C."""
        try:
            self._server.run(sockets=[self.listener])
        finally:
            self.listener.close()

    def stop(self) -> None:
        """End `run` soon; any thread may call it."""
        self._server.should_exit = True
