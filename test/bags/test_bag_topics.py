"""Topics of bags: definitions and hashes of types, QoS, wrong names, missing libraries."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT
from waiting import PATIENCE

from humansim_ros.data.bags.topics import (
    BagTopic,
    Qos,
    check_topics,
    described,
    message_types,
    qos_of_text,
    qos_text,
)
from humansim_ros.errors import BagError, HumansimWarning

#: Message packages of Jazzy as pip installs them; there is a JSON file with the hash of each type.
MESSAGES = Path(sys.prefix, "share")


@pytest.mark.skipif(not (MESSAGES / "sensor_msgs").is_dir(), reason="no message packages are installed")
def test_hashes_are_those_of_ros() -> None:
    found = 0
    for package in (
        "sensor_msgs",
        "std_msgs",
        "geometry_msgs",
        "visualization_msgs",
        "shape_msgs",
        "tf2_msgs",
    ):
        for path in sorted((MESSAGES / package / "msg").glob("*.json")):
            name = f"{package}/msg/{path.stem}"
            types = {each["type_name"]: each for each in json.loads(path.read_text())["type_hashes"]}
            topic = described(BagTopic("/a", name))
            assert topic.type_hash == types[name]["hash_string"], name
            if name != "std_msgs/msg/Char":  # the one that rosbags computes in another way
                assert message_types().hash_rihs01(name) == topic.type_hash, name
            assert topic.definition or name == "std_msgs/msg/Empty"
            found += 1
    assert found > 80


def test_types_of_installed_packages_are_described(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "share" / "zoo_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Zoo.msg").write_text(
        "std_msgs/Header header\nAnimal[] animals # all of them\nAnimal[2] pair\n"
    )
    (folder / "Animal.msg").write_text("string<=20 name\nfloat64[3] place\nuint8 LION=1\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(["/nowhere", str(tmp_path)]))
    topic = described(BagTopic("/zoo", "zoo_msgs/msg/Zoo"))
    for part in ("zoo_msgs/Animal[] animals", "MSG: zoo_msgs/Animal", "MSG: std_msgs/Header"):
        assert part in topic.definition
    assert topic.type_hash.startswith("RIHS01_")


@pytest.mark.parametrize("text", ["", "NoType", "gone_msgs/Gone nothing", "\N{BOMB} ="])
def test_an_unknown_type_is_recorded_without_definition(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"T{abs(hash(text))}"
    folder = tmp_path / "share" / "zoo_msgs" / "msg"
    folder.mkdir(parents=True)
    if text:
        (folder / f"{name}.msg").write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with pytest.warns(HumansimWarning, match="/zoo: no definition of zoo_msgs"):
        topic = described(BagTopic("/zoo", f"zoo_msgs/msg/{name}"))
    assert (topic.definition, topic.type_hash) == ("", "")


def test_a_topic_with_definition_stays_as_it_is() -> None:
    topic = BagTopic("/zoo", "zoo_msgs/msg/Zoo", definition="uint8 a", type_hash="RIHS01_0")
    assert described(topic) is topic


@pytest.mark.parametrize("name", ["", "/", "a", "/a/", "/1a", "/a b", "//a", "/a\n", "/ä", "/a/~b"])
def test_wrong_names_are_refused(name: str) -> None:
    with pytest.raises(BagError, match="absolute topic name"):
        check_topics([BagTopic(name, "std_msgs/msg/Header")])


@pytest.mark.parametrize(
    "kind", ["", "Header", "std_msgs", "std_msgs/msg/", "std_msgs/msg/header", "a/b/c/D"]
)
def test_wrong_types_are_refused(kind: str) -> None:
    with pytest.raises(BagError, match=r"/a: .*is not a message type"):
        check_topics([BagTopic("/a", kind)])


def test_a_name_occurs_once() -> None:
    with pytest.raises(BagError, match="/a: the topic is listed twice"):
        check_topics([BagTopic("/a", "std_msgs/msg/Header"), BagTopic("/a", "std_msgs/msg/String")])


@pytest.mark.parametrize(
    "qos", [Qos(), Qos(reliable=False, depth=3), Qos(transient_local=True, depth=1), Qos(keep_all=True)]
)
def test_qos_survives_its_text(qos: Qos) -> None:
    assert qos_of_text(qos_text(BagTopic("/a", "std_msgs/msg/Header", (qos, Qos(depth=7))))) == (
        qos,
        Qos(depth=7),
    )


@pytest.mark.parametrize("text", ["[", "a", "[1]", "{a: 1}", "[{depth: x}]"])
def test_damaged_qos_is_left_out(text: str) -> None:
    assert qos_of_text(text) == ()


WITHOUT_LIBRARY = """
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == sys.argv[1]:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hide())
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError
for use in (BagWriter, BagReader):
    try:
        use(sys.argv[2])
    except BagError as error:
        print(error)
"""


@pytest.mark.parametrize("library", ["mcap", "rosbags"])
def test_a_missing_library_is_named_with_the_command_that_installs_it(library: str, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_LIBRARY, library, tmp_path / "a.mcap"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 2 and f"No module named '{library}" in lines[0]
    assert "pip install 'humansim_ros[record]'" in lines[0]
    assert not (tmp_path / "bag").exists()
