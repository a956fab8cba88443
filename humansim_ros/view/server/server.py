"""Web server of the page: viser on 127.0.0.1, checks of all requests, and scripts of this package."""

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
from dataclasses import dataclass, field
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
from humansim_ros.files.reading import read_bytes, read_text, size_text

#: The only address that the page is served on.
HOST = "127.0.0.1"
#: If the requested port is in use, the next ports are tried: this number of ports in total.
_PORTS = 100
#: Path of the files that this package, not viser, serves.
PREFIX = "/humansim/"
_NAMES = {"127.0.0.1", "localhost", "[::1]", "::1"}
#: Largest message of a browser, bytes.
_MOST_BYTES = 1 << 16
#: Bytes of one message of an upload: viser's page cuts files into parts of this size.
PART = 512 * 1024
#: Largest uploaded file, and most bytes of all uploads that run at the same time, bytes.
MOST_UPLOAD, _MOST_ON_THE_WAY = 200 << 20, 400 << 20
#: Largest result that is served, bytes. It is limited because results are read into memory.
_MOST_RESULT = 1 << 30
#: Types of the messages with which a browser uploads a file.
_UPLOAD = ("FileTransferStartUpload", "FileTransferPart")
#: Types of accepted messages of a browser. All others (such as requests for public tunnels) are ignored.
_TAKEN = {
    "CommandTriggerMessage",
    "FileTransferPart",
    "FileTransferStartUpload",
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
#: Longest text and longest list in a message of a browser.
_LONGEST_TEXT, _LONGEST_LIST = 20_000, 64
_LARGEST = 1e12
#: Images are sent without waiting for a page that has not reported for this number of seconds, because such a
#: page is in the background.
_SHOWN_WITHIN = 1.0
_LOCK = threading.Lock()
#: Scripts of every page, in this order, before viser's own.
SCRIPTS = ("page.js", "tiles.js", "recording.js", "through.js", "measure.js", "keys.js", "timeline.js")


class PageServer:
    """A viser server that accepts only browsers on this machine, and only requests of its own page.

    Args:
        title: Title of the page.
        port: Port. If the port is in use, the next free one is taken.

    Attributes:
        viser: The viser server, for the elements and the 3D scene of the page.
        port: Port on which the page is served.
        on_refused: Function that is called with a reason for the user when an upload is refused.
        result: Function that maps a path below ``/humansim/results/`` to the file to serve, or to None.

    Raises:
        HumansimError: No port is free.
    """

    def __init__(self, title: str, port: int = 8080) -> None:
        self.files: dict[str, tuple[str, bytes]] = {}
        self.requests: dict[str, Callable[[Mapping[str, str]], None]] = {}
        self._page = _index_page(title)
        for script in SCRIPTS:
            self._add_script(script)
        self._compressed = b""
        self._streams: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.on_refused: Callable[[str], None] = lambda reason: None
        self.result: Callable[[str], Path | None] = lambda name: None
        self._on_the_way: dict[str, int] = {}
        self._latest: dict[str, bytes | str] = {}
        with _LOCK, self._checked_connections(), contextlib.redirect_stdout(io.StringIO()):
            self.viser = viser.ViserServer(host=HOST, port=_free_port(port), label=title, verbose=False)
        self.port = int(self.viser.get_port())

    @property
    def url(self) -> str:
        """Address for the browser."""
        return f"http://{HOST}:{self.port}"

    @property
    def has_pages(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self._streams or self.viser.get_clients())

    def add_file(self, name: str, kind: str, data: bytes) -> None:
        """Serve ``data`` at ``/humansim/<name>``. ``kind``: MIME type."""
        self.files[PREFIX + name] = (kind, data)

    def replace_files(self, folder: str, files: Mapping[str, tuple[str, bytes]]) -> None:
        """Serve ``files`` (MIME type and content by name) below ``folder``, such as ``people/``, instead of
        all files that were served there before."""
        kept = {path: file for path, file in self.files.items() if not path.startswith(PREFIX + folder)}
        # a single assignment, since the thread of the server reads the files at the same time
        self.files = kept | {f"{PREFIX}{folder}{name}": file for name, file in files.items()}

    def add_script(self, name: str, **data: float) -> None:
        """Add a script of the folder ``page`` to the page. Only browsers that open the page later run the
        script. ``data``: numbers for the script, which become data attributes of its HTML element."""
        self._add_script(name)
        given = "".join(f' data-{key}="{value}"' for key, value in data.items())
        tag = f'<script src="{PREFIX}{name}"{given}></script>'.encode()
        self._page = self._page.replace(b"</head>", tag + b"</head>", 1)
        self._compressed = b""

    def _add_script(self, name: str) -> None:
        script = read_bytes(Path(__file__).with_name("page") / name, HumansimError, "script", _MOST_OWN)
        self.add_file(name, "text/javascript", script)

    def add_json(self, name: str, value: Any) -> None:
        """Serve a value as JSON."""
        self.add_file(name, "application/json", json.dumps(value).encode())

    def on_request(self, name: str, function: Callable[[Mapping[str, str]], None]) -> None:
        """Call ``function`` with the query of each request of ``/humansim/<name>``, in the server's
        thread."""
        self.requests[PREFIX + name] = function

    def stream(self, data: bytes | str, kind: str) -> None:
        """Send data of a kind to the scripts of all pages: ``poses``, ``images`` or ``state`` (JSON text). A
        slow or new page gets only the latest data of each kind."""
        if self._latest.get(kind) == data:
            return
        self._latest[kind] = data
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for event in self._streams:
            event.set()

    async def _stream_to(self, connection: Any) -> None:
        """Send the data of :meth:`stream` to one browser until it disconnects. New images are sent only after
        the page has shown the previous ones, so that no image is old when it arrives."""
        event = asyncio.Event()
        event.set()
        sent: dict[str, bytes | str] = {}
        shown_by = 0.0  # time at which the page has shown the last images, at the latest
        self._streams.add(event)
        loop = asyncio.get_running_loop()

        async def receive() -> None:
            nonlocal shown_by
            async for _ in connection:  # the images are shown
                shown_by = 0.0
                event.set()

        closed = asyncio.ensure_future(receive())
        try:
            while not closed.done():
                woken = asyncio.ensure_future(event.wait())
                await asyncio.wait({woken, closed}, return_when=asyncio.FIRST_COMPLETED)
                woken.cancel()
                event.clear()
                for kind, latest in list(self._latest.items()):
                    if closed.done() or sent.get(kind) is latest:
                        continue
                    if kind == "images":
                        if (left := shown_by - loop.time()) > 0:
                            loop.call_later(left, event.set)
                            continue
                        shown_by = loop.time() + _SHOWN_WITHIN
                    await connection.send(latest)
                    sent[kind] = latest
        except websockets.exceptions.ConnectionClosed:
            pass
        finally:
            self._streams.discard(event)
            closed.cancel()

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()

    @contextlib.contextmanager
    def _checked_connections(self) -> Iterator[None]:
        """Check the connections of all servers that are started in the ``with`` block. It replaces
        ``websockets.asyncio.server.serve``, which viser calls, because viser has no option for checks."""
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
                gate = UploadGate(lambda reason: self.on_refused(reason), self._on_the_way)

                async def receive_checked(*args: Any, **named: Any) -> Any:
                    while not is_acceptable(data := await receive(*args, **named), gate):
                        pass
                    return data

                connection.recv = receive_checked
                try:
                    await handler(connection)
                finally:
                    gate.close()

            options |= {"max_size": PART + _MOST_BYTES, "process_request": answer}
            return serve(handle, host, port, **options)

        with patch.object(websockets.asyncio.server, "serve", checked):
            yield

    def _answer(self, request: Request) -> Response | None:
        """Answer a request for a file of this package, or refuse the request; None if viser should answer."""
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
        if path.startswith(f"{PREFIX}results/"):
            return _result(self.result(path.removeprefix(f"{PREFIX}results/")))
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


def is_acceptable(data: object, gate: UploadGate | None = None) -> bool:
    """Whether a message of a browser has an accepted type and plain values. ``gate``: checks messages of
    uploads. If None, uploads are refused."""
    if not isinstance(data, bytes):
        return False
    try:
        content = msgspec.msgpack.decode(data)
        if not isinstance(content, dict) or content.get("type") not in _TAKEN:
            return False
        part = content["type"] == "FileTransferPart"
        if not part and len(data) > _MOST_BYTES:
            return False
        if not _is_plain({key: value for key, value in content.items() if not (part and key == "content")}):
            return False
        if content["type"] == "GuiUpdateMessage" and set(content.get("updates", ())) != {"value"}:
            return False
        _messages.Message.deserialize(data)
        if content["type"] in _UPLOAD:
            return gate is not None and gate.takes(content)
    except Exception:  # anything at all may be in it, and viser's own reader raises many kinds of errors
        return False
    return True


# --- files of browsers, while they arrive


@dataclass
class UploadGate:
    """Filter for the uploads of one browser. Accepts each part of an announced file once, and nothing else.

    Attributes:
        refused: Function that is called with a reason for the user when an upload is refused.
        on_the_way: Size in bytes of each running upload of all browsers, by upload; shared by all gates.
    """

    refused: Callable[[str], None]
    on_the_way: dict[str, int]
    _left: dict[str, set[int]] = field(default_factory=dict)

    def takes(self, message: Mapping[str, Any]) -> bool:
        """Whether a message of an upload may be passed on to viser."""
        transfer = str(message.get("transfer_uuid"))
        if message["type"] == "FileTransferStartUpload":
            return self._begins(transfer, message)
        left = self._left.get(transfer)
        index, content = message.get("part_index"), message.get("content")
        if left is None or index not in left or not isinstance(content, bytes) or len(content) > PART:
            return False
        left.discard(index)
        if not left:
            self._end(transfer)
        return True

    def close(self) -> None:
        """End the running uploads of a browser that has disconnected, so that they no longer count."""
        for transfer in list(self._left):
            self._end(transfer)

    def _begins(self, transfer: str, message: Mapping[str, Any]) -> bool:
        size, parts, name = message.get("size_bytes"), message.get("part_count"), message.get("filename")
        if not (isinstance(size, int) and isinstance(parts, int) and isinstance(name, str)):
            return False
        if transfer in self.on_the_way or len(transfer) > 100 or size < 0 or parts != -(-size // PART):
            return False
        name = printable(name, 60)
        if not 0 < size <= MOST_UPLOAD:
            self.refused(f"{name}: {size_of_upload(size)}")
            return False
        if sum(self.on_the_way.values()) + size > _MOST_ON_THE_WAY:
            self.refused(f"{name}: too many files are on their way: send it again in a moment")
            return False
        self._left[transfer] = set(range(parts))
        self.on_the_way[transfer] = size
        return True

    def _end(self, transfer: str) -> None:
        del self._left[transfer]
        self.on_the_way.pop(transfer, None)


def size_of_upload(size: object) -> str:
    """Reason to refuse an uploaded file that is empty or too large. ``size``: bytes, as a number or text."""
    try:
        count = int(str(size)[:20])
    except ValueError:
        count = 0
    most = f"a file has at most {size_text(MOST_UPLOAD)}"
    return f"{size_text(count)}; {most}" if count > MOST_UPLOAD else "this file is empty"


def inside(folder: Path, name: str) -> Path:
    """Path of a file that the page names; only files below ``folder`` are allowed.

    Raises:
        HumansimError: The file is not below ``folder``. The page may not use other files.
    """
    path = (folder / name.replace("\0", "")).resolve()
    if "\0" in name or not path.is_relative_to(folder.resolve()):
        raise HumansimError(
            f"{printable(name)}: the page reads and writes files below {folder} only; use the command line"
        )
    return path


def check_value(folder: Path, value: object) -> None:
    """Check that a value, which the page sets in a scene, names only files below ``folder``.

    Raises:
        HumansimError: A text in the value is a URL, or the path of a file elsewhere.
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
    """Whether a value of a message is simple: little nesting, short texts and lists, finite numbers."""
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
    """Whether a request names this machine as its host, and comes from our own page or from no web page.

    A foreign page that points its own name at 127.0.0.1 sends that name as Host; other foreign pages are
    recognised by the headers Origin or Sec-Fetch-Site.
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


#: MIME types of results that a browser shows, by suffix. Results with other suffixes are downloaded.
_SHOWN = {
    ".html": "text/html; charset=utf-8",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".txt": "text/plain; charset=utf-8",
    ".csv": "text/plain; charset=utf-8",
    ".json": "text/plain; charset=utf-8",
    ".yaml": "text/plain; charset=utf-8",
}


def _result(path: Path | None) -> Response:
    """Answer with a file that a command has written. It is sandboxed, so that scripts in the file (such as in
    reports) cannot access this page."""
    if path is None:
        return _response(http.HTTPStatus.NOT_FOUND, "text/plain", b"no such result\n")
    try:
        if path.stat().st_size > _MOST_RESULT:
            text = f"this file is too large for the page; it is {path}\n".encode()
            return _response(http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "text/plain; charset=utf-8", text)
        data = read_bytes(path, HumansimError, "result", _MOST_RESULT) if path.stat().st_size else b""
    except (HumansimError, OSError):
        return _response(http.HTTPStatus.NOT_FOUND, "text/plain", b"this result cannot be read\n")
    kind = _SHOWN.get(path.suffix.lower())
    more = {"Content-Security-Policy": "sandbox allow-scripts allow-popups"}
    if kind is None:
        name = re.sub(r"[^A-Za-z0-9._-]", "_", path.name)
        more["Content-Disposition"] = f'attachment; filename="{name}"'
    return _response(http.HTTPStatus.OK, kind or "application/octet-stream", data, more)


def _free_port(port: int) -> int:
    """The first free port from ``port`` on. 0 stays 0, which means any port."""
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
    """HTML of viser's page, with the scripts of this package inserted before viser's own scripts."""
    root = Path(viser.__file__).parent / "client" / "build" / "index.html"
    text = read_text(root, HumansimError, "page of viser", _MOST_OWN)
    safe = title.replace("&", "&amp;").replace("<", "&lt;")
    text = re.sub(r"<title>.*?</title>", lambda _: f"<title>{safe}</title>", text, count=1, flags=re.DOTALL)
    scripts = "".join(f'<script src="{PREFIX}{name}"></script>' for name in SCRIPTS)
    return text.replace("<head>", f"<head>{scripts}", 1).encode()
