"""The server of the page: its address, what it answers, and what hostile browsers and programs send."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")

import msgspec
from waiting import wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from humansim_ros.errors import HumansimError
from humansim_ros.view.server.server import HOST, PageServer, check_value, inside, is_acceptable

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 800,
    "image_width": 1280,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


@pytest.fixture
def server() -> Iterator[PageServer]:
    made = PageServer("lab", 0)
    yield made
    made.close()


def get(server: PageServer, path: str, **headers: str) -> tuple[int, bytes]:
    request = urllib.request.Request(
        server.url + path, headers={k.replace("_", "-"): v for k, v in headers.items()}
    )
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def connected(server: PageServer, path: str = "", **options: Any) -> Any:
    return connect(f"ws://{HOST}:{server.port}{path}", subprotocols=["viser-v1.1.1"], **options)  # type: ignore[list-item]


def read_on(page: Any) -> None:
    """Read until the connection ends."""
    while True:
        page.recv(timeout=30)


def update(uuid: str, value: object) -> bytes:
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})


def test_only_this_machine_reaches_it(server: PageServer) -> None:
    own = set()
    with suppress(socket.gaierror):  # a minimal machine cannot resolve its own name
        own = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in own - {HOST}:
        with pytest.raises(OSError):
            socket.create_connection((address, server.port), timeout=2).close()
    assert get(server, "/")[0] == 200


def test_a_port_in_use_gives_the_next_free_one(server: PageServer) -> None:
    other = PageServer("lab", server.port)
    try:
        assert other.port > server.port
        assert get(other, "/")[0] == 200
    finally:
        other.close()


def test_the_page_has_its_title_and_our_script(server: PageServer) -> None:
    status, page = get(server, "/")
    assert status == 200
    assert b"<title>lab</title>" in page
    assert b'<script src="/humansim/page.js"></script>' in page
    assert get(server, "/humansim/page.js")[0] == 200


@pytest.mark.parametrize(
    "path",
    ["/../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/humansim/../../setup.py", "/humansim/none"],
)
def test_no_other_file_is_served(server: PageServer, path: str) -> None:
    assert get(server, path)[0] == 404


def test_requests_of_foreign_pages_are_refused(server: PageServer) -> None:
    picked: list[Any] = []
    server.on_request("pick", picked.append)
    assert get(server, "/humansim/pick?x=1", Origin="http://evil.example")[0] == 403
    assert get(server, "/humansim/pick?x=1", Sec_Fetch_Site="cross-site")[0] == 403
    # a name of a foreign page that its owner points at this machine
    assert get(server, "/humansim/pick?x=1", Host="evil.example")[0] == 403
    assert picked == []
    assert get(server, "/humansim/pick?x=1", Origin=server.url)[0] == 204
    assert picked == [{"x": "1"}]


def test_a_page_reached_through_a_tunnel_works(server: PageServer) -> None:
    assert get(server, "/", Host="localhost:9000", Origin="http://localhost:9000")[0] == 200


@pytest.mark.parametrize("path", ["", "/humansim/frames"])
def test_websockets_of_foreign_pages_are_refused(server: PageServer, path: str) -> None:
    with pytest.raises(InvalidStatus):
        connected(server, path, origin="http://evil.example")
    with connected(server, path, origin=server.url):
        pass


def test_a_stream_gives_the_latest_data_to_late_pages(server: PageServer) -> None:
    with connected(server, "/humansim/frames"):
        pass  # the server knows its event loop from the first connection on
    server.stream(b"old", "poses")
    server.stream(b"new", "poses")
    with connected(server, "/humansim/frames") as page:
        assert page.recv(timeout=30) == b"new"
        server.stream(b"newer", "poses")
        assert page.recv(timeout=30) == b"newer"


def test_images_wait_until_the_page_has_shown_the_ones_before(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("humansim_ros.view.server.server._SHOWN_WITHIN", 1e6)
    with connected(server, "/humansim/frames") as page:
        for data, kind in ((b"images 1", "images"), (b"images 2", "images"), (b"poses", "poses")):
            server.stream(data, kind)
            if data != b"images 2":
                assert page.recv(timeout=30) == data
        server.stream(b"images 3", "images")
        page.send("shown")
        assert page.recv(timeout=30) == b"images 3"


def hostile_messages(uuid: str) -> list[bytes | str]:
    encode = msgspec.msgpack.encode
    return [
        b"",
        b"\xc1",
        b"\x00" * 100,
        "text",
        encode([1, 2]),
        encode({"type": "Nonsense"}),
        encode({"type": "ShareUrlRequest"}),
        encode({"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "x"}),
        encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"update_cb": [1]}}),
        encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": 1, "removed": True}}),
        encode({"type": "GuiUpdateMessage", "uuid": uuid}),
        update(uuid, float("nan")),
        update(uuid, 1e300),
        update(uuid, "x" * 30_000),
        update(uuid, {"a": {"b": {"c": {"d": {"e": {}}}}}}),
        encode(CAMERA | {"position": [float("inf"), 0.0, 0.0]}),
        encode(CAMERA | {"extra": 1}),
        encode({key: value for key, value in CAMERA.items() if key != "fov"}),
    ]


@pytest.mark.parametrize("number", range(18))
def test_a_hostile_message_is_not_acceptable(number: int) -> None:
    assert not is_acceptable(hostile_messages("uuid")[number])


def test_good_messages_are_acceptable() -> None:
    assert is_acceptable(msgspec.msgpack.encode(CAMERA))
    assert is_acceptable(update("uuid", 3))
    assert is_acceptable(update("uuid", [0.1, 0.2]))


def test_hostile_messages_change_nothing_and_the_page_goes_on(server: PageServer) -> None:
    slider = server.viser.gui.add_slider("Frame", min=0, max=9, step=1, initial_value=3)
    uuid = slider._impl.uuid
    values: list[int] = []
    slider.on_update(lambda _: values.append(slider.value))
    with connected(server) as page:
        page.send(msgspec.msgpack.encode(CAMERA))
        for message in hostile_messages(uuid):
            page.send(message)
        page.send(update(uuid, 7))
        assert wait_until(lambda: values)
    assert values == [7]


def test_a_huge_message_ends_only_its_connection(server: PageServer) -> None:
    slider = server.viser.gui.add_slider("Frame", min=0, max=9, step=1, initial_value=3)
    with connected(server) as page:
        page.send(b"\x00" * (1 << 20))
        with pytest.raises(ConnectionClosed):
            read_on(page)
    with connected(server) as page:
        page.send(msgspec.msgpack.encode(CAMERA))
        page.send(update(slider._impl.uuid, 5))
        assert wait_until(lambda: slider.value == 5)


@pytest.mark.parametrize("name", ["../secret.yaml", "/etc/passwd", "a/../../b", "x\0y"])
def test_the_page_names_files_below_its_folder_only(tmp_path: Path, name: str) -> None:
    with pytest.raises(HumansimError, match="below"):
        inside(tmp_path, name)


@pytest.mark.parametrize(
    "value", ["/etc/passwd", "~/secret.npz", "file:///etc/passwd", {"file": "../x.bvh"}, [["a", "/b/c.obj"]]]
)
def test_values_of_the_page_name_files_below_its_folder_only(tmp_path: Path, value: object) -> None:
    with pytest.raises(HumansimError, match="below"):
        check_value(tmp_path, value)
    check_value(tmp_path, {"file": "walks/mine.bvh", "speed": 2.0, "body": "child", "parts": [1, None]})


def test_files_below_the_folder_are_found(tmp_path: Path) -> None:
    assert inside(tmp_path, "rigs/lab.yaml") == tmp_path.resolve() / "rigs" / "lab.yaml"
