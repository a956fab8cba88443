"""Server of the page: viser on 127.0.0.1, checks of everything that arrives, and our part of the page."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import http
import io
import json
import math
import re
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib.parse import parse_qs, unquote, urlsplit

import msgspec
import viser
import websockets.asyncio.server
import websockets.exceptions
from viser import _messages
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from humansim_ros.errors import HumansimError, printable
from humansim_ros.io.files import read_bytes, read_text

#: The only address that the page is served on.
HOST = "127.0.0.1"
#: Ports that are tried after the one that was asked for.
_PORTS = 100
#: Path of our own files of the page.
PREFIX = "/humansim/"
_NAMES = {"127.0.0.1", "localhost", "[::1]", "::1"}
#: Largest message of a browser, bytes.
_MOST_BYTES = 1 << 16
#: Messages of a browser that are taken; all others (uploads, public tunnels …) are dropped.
_TAKEN = {
    "CommandTriggerMessage",
    "GuiButtonHoldMessage",
    "GuiUpdateMessage",
    "SceneNodeClickMessage",
    "SceneNodeDragMessage",
    "ScenePointerMessage",
    "TransformControlsDragEndMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsUpdateMessage",
    "ViewerCameraMessage",
}
#: Largest file of the page itself, bytes.
_MOST_OWN = 1 << 26
#: Longest text and longest list in a message.
_LONGEST_TEXT, _LONGEST_LIST = 20_000, 64
_LARGEST = 1e12
_LOCK = threading.Lock()


class PageServer:
    """A viser server that only browsers on this machine reach, and only from its own page.

    Args:
        title: Title of the page.
        port: Port; the next free one if it is in use.

    Attributes:
        viser: The server of the page's elements.
        port: Port that it got.

    Raises:
        HumansimError: No port is free.
    """

    def __init__(self, title: str, port: int = 8080) -> None:
        self.files: dict[str, tuple[str, bytes]] = {}
        self.requests: dict[str, Callable[[Mapping[str, str]], None]] = {}
        self._page = _index_page(title)
        self._add_script("page.js")
        self._compressed = b""
        self._streams: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._latest: bytes | None = None
        with _LOCK, self._checked_connections(), contextlib.redirect_stdout(io.StringIO()):
            self.viser = viser.ViserServer(host=HOST, port=_free_port(port), label=title, verbose=False)
        self.port = int(self.viser.get_port())

    @property
    def url(self) -> str:
        """Address for the browser."""
        return f"http://{HOST}:{self.port}"

    def add_file(self, name: str, kind: str, data: bytes) -> None:
        """Serve ``data`` as ``/humansim/<name>``, with its MIME type."""
        self.files[PREFIX + name] = (kind, data)

    def replace_files(self, folder: str, files: Mapping[str, tuple[str, bytes]]) -> None:
        """Serve files, by name in ``folder`` (``people/``), as MIME type and content; none else in it."""
        kept = {path: file for path, file in self.files.items() if not path.startswith(PREFIX + folder)}
        # one assignment: the thread of the server reads it meanwhile
        self.files = kept | {f"{PREFIX}{folder}{name}": file for name, file in files.items()}

    def add_script(self, name: str) -> None:
        """Add a script of the folder ``page`` to the page; browsers that open it later run it."""
        self._add_script(name)
        tag = f'<script src="{PREFIX}{name}"></script>'.encode()
        self._page = self._page.replace(b"</head>", tag + b"</head>", 1)
        self._compressed = b""

    def _add_script(self, name: str) -> None:
        script = read_bytes(Path(__file__).with_name("page") / name, HumansimError, "script", _MOST_OWN)
        self.add_file(name, "text/javascript", script)

    def add_json(self, name: str, value: Any) -> None:
        """Serve a value as JSON."""
        self.add_file(name, "application/json", json.dumps(value).encode())

    def on_request(self, name: str, function: Callable[[Mapping[str, str]], None]) -> None:
        """Call ``function`` with the query of requests of ``/humansim/<name>``, in the server's thread."""
        self.requests[PREFIX + name] = function

    def stream(self, data: bytes) -> None:
        """Send data to the scripts of all pages; a slow or a new page gets the latest only."""
        self._latest = data
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for event in self._streams:
            event.set()

    async def _stream_to(self, connection: Any) -> None:
        """Send what :meth:`stream` is given until the browser goes away."""
        event = asyncio.Event()
        if self._latest is not None:
            event.set()
        self._streams.add(event)
        closed = asyncio.ensure_future(connection.wait_closed())
        try:
            while not closed.done():
                woken = asyncio.ensure_future(event.wait())
                await asyncio.wait({woken, closed}, return_when=asyncio.FIRST_COMPLETED)
                woken.cancel()
                event.clear()
                if self._latest is not None and not closed.done():
                    await connection.send(self._latest)
        except websockets.exceptions.ConnectionClosed:
            pass
        finally:
            self._streams.discard(event)
            closed.cancel()

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()

    @contextlib.contextmanager
    def _checked_connections(self) -> Iterator[None]:
        """Connections of servers that start meanwhile are checked.

        Viser has no parameter for it; it calls ``websockets.asyncio.server.serve`` with its handlers.
        """
        serve = websockets.asyncio.server.serve

        def checked(handler: Any, host: str, port: int, **options: Any) -> Any:
            answer_of_viser = options.pop("process_request")

            def answer(connection: Any, request: Request) -> Response | None:
                ours = self._answer(request)
                return ours if ours is not None else answer_of_viser(connection, request)

            async def handle(connection: Any) -> None:
                self._loop = asyncio.get_running_loop()
                if urlsplit(connection.request.path).path == f"{PREFIX}frames":
                    await self._stream_to(connection)
                    return
                receive = connection.recv

                async def receive_checked(*args: Any, **named: Any) -> Any:
                    while not is_acceptable(data := await receive(*args, **named)):
                        pass
                    return data

                connection.recv = receive_checked
                await handler(connection)

            options |= {"max_size": _MOST_BYTES, "process_request": answer}
            return serve(handle, host, port, **options)

        with patch.object(websockets.asyncio.server, "serve", checked):
            yield

    def _answer(self, request: Request) -> Response | None:
        """Answer to a request that is not for viser, or that is refused; None for the others."""
        if not _is_own(request.headers):
            return _response(http.HTTPStatus.FORBIDDEN, "text/plain", b"only this page may ask\n")
        parts = urlsplit(request.path)
        path = unquote(parts.path)
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        if path in ("/", "/index.html"):
            return self._index(request)
        if path in self.requests:
            query = {name: values[0] for name, values in parse_qs(parts.query).items()}
            self.requests[path](query)
            return _response(http.HTTPStatus.NO_CONTENT, "text/plain", b"")
        file = self.files.get(path)
        if file is not None:
            kind, data = file
            return _response(http.HTTPStatus.OK, kind, data)
        return None

    def _index(self, request: Request) -> Response:
        kind = "text/html; charset=utf-8"
        if "gzip" not in request.headers.get("Accept-Encoding", ""):
            return _response(http.HTTPStatus.OK, kind, self._page)
        self._compressed = self._compressed or gzip.compress(self._page, 5)
        return _response(http.HTTPStatus.OK, kind, self._compressed, {"Content-Encoding": "gzip"})


def is_acceptable(data: object) -> bool:
    """Whether a message of a browser is one that its page sends, with values that are in range."""
    if not isinstance(data, bytes):
        return False
    try:
        content = msgspec.msgpack.decode(data)
        if not isinstance(content, dict) or content.get("type") not in _TAKEN or not _is_plain(content):
            return False
        if content["type"] == "GuiUpdateMessage" and set(content.get("updates", ())) != {"value"}:
            return False
        _messages.Message.deserialize(data)
    except Exception:  # anything at all may be in it, and viser's own reader raises many kinds of errors
        return False
    return True


def inside(folder: Path, name: str) -> Path:
    """Path of a file that a page names: below ``folder`` only.

    Raises:
        HumansimError: It is elsewhere. The page is not trusted with other files.
    """
    path = (folder / name.replace("\0", "")).resolve()
    if "\0" in name or not path.is_relative_to(folder.resolve()):
        raise HumansimError(
            f"{printable(name)}: the page reads and writes files below {folder} only; use the command line"
        )
    return path


def check_value(folder: Path, value: object) -> None:
    """Check a value that a page gives to a key of a scene: files that it names are below ``folder``.

    Raises:
        HumansimError: A text in it is a path or URL of a file elsewhere.
    """
    if isinstance(value, str):
        if "://" in value or value.startswith("~"):
            raise HumansimError(f"{printable(value)}: the page takes names of files below {folder} only")
        if re.search(r"[/\\\0]", value) or ".." in value:
            inside(folder, value)
    elif isinstance(value, dict):
        for part in value.values():
            check_value(folder, part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            check_value(folder, part)


def _is_plain(value: object, depth: int = 0) -> bool:
    """Whether a value is shallow, short and finite."""
    if depth > 4:
        return False
    if isinstance(value, float):
        return math.isfinite(value) and abs(value) <= _LARGEST
    if isinstance(value, int):
        return abs(value) <= _LARGEST
    if isinstance(value, (str, bytes)):
        return len(value) <= _LONGEST_TEXT
    if isinstance(value, dict):
        return len(value) <= _LONGEST_LIST and all(
            isinstance(key, str) and _is_plain(part, depth + 1) for key, part in value.items()
        )
    if isinstance(value, list):
        return len(value) <= _LONGEST_LIST and all(_is_plain(part, depth + 1) for part in value)
    return value is None


def _is_own(headers: Headers) -> bool:
    """Whether a request is for this machine by name, and comes from our own page or from no page.

    A foreign page that points its own name at 127.0.0.1 sends that name as Host; other foreign pages are
    told by Origin or Sec-Fetch-Site.
    """
    host = headers.get("Host", "")
    if re.sub(r":\d+$", "", host).lower() not in _NAMES:
        return False
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    return headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")


def _response(
    status: http.HTTPStatus, kind: str, data: bytes, more: Mapping[str, str] | None = None
) -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(data)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Connection": "close",
        }
        | dict(more or {})
    )
    return Response(status, status.phrase, headers, data)


def _free_port(port: int) -> int:
    """The first free port from ``port`` on; 0 stays 0: any."""
    if port == 0:
        return 0
    for candidate in range(port, min(port + _PORTS, 1 << 16)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, candidate))
            except OSError:
                continue
            return candidate
    raise HumansimError(f"ports {port} to {port + _PORTS - 1} are in use: choose another one with --port")


def _index_page(title: str) -> bytes:
    """Viser's page, with our script before its own."""
    root = Path(viser.__file__).parent / "client" / "build" / "index.html"
    text = read_text(root, HumansimError, "page of viser", _MOST_OWN)
    safe = title.replace("&", "&amp;").replace("<", "&lt;")
    text = re.sub(r"<title>.*?</title>", lambda _: f"<title>{safe}</title>", text, count=1, flags=re.DOTALL)
    script = f'<script src="{PREFIX}page.js"></script>'
    return text.replace("<head>", f"<head>{script}", 1).encode()
