"""Output folders on file systems of fsspec: a file has its name only when it is there as a whole."""

from __future__ import annotations

import errno
import pickle
import sys
from pathlib import Path
from typing import Any

import pytest

from humansim_ros.data.engine.output import OutputFolder
from humansim_ros.errors import BagError

fsspec = pytest.importorskip("fsspec")


@pytest.fixture(params=["path", "file", "memory"])
def output(request: pytest.FixtureRequest, tmp_path: Path) -> OutputFolder:
    urls = {
        "path": str(tmp_path / "bags"),
        "file": f"file://{tmp_path}/bags",
        "memory": f"memory://{tmp_path.name}/bags",
    }
    return OutputFolder(urls[request.param])


def test_files_are_moved_written_read_and_removed(output: OutputFolder, tmp_path: Path) -> None:
    assert output.names() == set() and output.name == "bags"
    output.create()
    assert output.names() == set()
    source = tmp_path / "shard"
    source.write_bytes(b"first")
    output.put(source, "a_0.mcap")
    assert not source.exists()
    output.write("plan.json", b"{}")
    assert output.names() == {"a_0.mcap", "plan.json"}
    assert output.read("plan.json") == b"{}"
    with output.open("a_0.mcap") as file:
        assert file.read(3) == b"fir" and file.read() == b"st"
    output.get("a_0.mcap", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == b"first"
    source.write_bytes(b"second")
    output.put(source, "a_0.mcap")  # as a worker does whose first result was lost
    assert output.read("a_0.mcap") == b"second"
    output.remove("plan.json")
    assert output.names() == {"a_0.mcap"}
    output.folder("inner").create()
    output.folder("inner").write("x", b"")
    assert output.folder("inner").names() == {"x"}


def test_an_output_can_be_given_to_another_process(output: OutputFolder) -> None:
    output.create()
    assert pickle.loads(pickle.dumps(output)) == output


def test_only_a_path_or_a_file_url_is_local(tmp_path: Path) -> None:
    assert OutputFolder(str(tmp_path)).local == OutputFolder(f"file://{tmp_path}").local == tmp_path
    assert OutputFolder("memory://bags").local is None


@pytest.mark.parametrize("url", ["file://{}/bags", "memory://{}/full"])
def test_a_disk_that_is_full_leaves_no_file(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = OutputFolder(url.format(tmp_path))
    output.create()
    system = output._place[0]
    put = type(system).put_file

    def put_half(self: Any, source: str, target: str, **options: Any) -> None:
        put(self, source, target, **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(system), "put_file", put_half)
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(errno.EXDEV, "other disk")))
    source = tmp_path / "shard"
    source.write_bytes(b"content")
    with pytest.raises(BagError, match=r"(bags|full): the output cannot be used: No space left on device"):
        output.put(source, "a_0.mcap")
    assert output.names() == set() and source.exists()
    assert system.find(output._place[1]) == []


def test_a_file_is_moved_to_another_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(errno.EXDEV, "other disk")))
    output = OutputFolder(str(tmp_path / "bags"))
    output.create()
    source = tmp_path / "shard"
    source.write_bytes(b"content")
    output.put(source, "a_0.mcap")
    assert output.read("a_0.mcap") == b"content" and not source.exists()


def test_a_file_system_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"^nothing://x: the output cannot be used: Protocol not known"):
        OutputFolder("nothing://x").names()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BagError, match="file"):
        OutputFolder(str(tmp_path / "file")).names()
    with pytest.raises(BagError, match="output cannot be used"):
        OutputFolder(str(tmp_path / "file" / "bags")).create()


def test_missing_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(BagError, match=r"s3://bucket/x: Install s3fs to access S3"):
        OutputFolder("s3://bucket/x").names()
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(BagError, match=r"pip install 'humansim_ros\[ray\]'"):
        OutputFolder("s3://bucket/x").names()
