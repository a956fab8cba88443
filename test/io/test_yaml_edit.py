"""Edits of YAML texts: only the lines of the key change, and the values are those asked for."""

from __future__ import annotations

import random
import re
from typing import Any

import pytest
import yaml
from conftest import ROOT

from humansim_ros.errors import SceneError
from humansim_ros.view.edit.yaml_edit import remove_value, rename_key, set_value

#: Text with everything that an edit must keep.
MIXED = """\
# head
a: &x {b: 1,   c: [1, 2]}  # one
d: *x
e:
  <<: *x   # merged
  f: |
    text
    more

  g: 3

h:
- a: 1   # first
  b: "two"
- 3
k:
m: {x, y: }
long: {
  p: 1,  # of p
  q: 2   # of q
}
# tail
"""


def scene_texts() -> dict[str, str]:
    """Scene files of the package and of the documentation, by name."""
    texts = {
        str(path.relative_to(ROOT)): path.read_text() for path in (ROOT / "config/scenes").glob("*.yaml")
    }
    for page in sorted((ROOT / "docs").glob("*.md")):
        for number, block in enumerate(re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL)):
            texts[f"{page.name}#{number}"] = block
    return texts


TEXTS = scene_texts() | {"mixed": MIXED}


def paths(data: Any, before: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    found = []
    for key, value in items:
        found += [(*before, key), *paths(value, (*before, key))]
    return found


def get(data: Any, keys: tuple[Any, ...]) -> Any:
    for key in keys:
        data = data[key]
    return data


def other_lines(text: str, new: str) -> tuple[list[str], list[str]]:
    """Lines of two texts that differ."""
    old, changed = text.splitlines(), new.splitlines()
    while old and changed and old[0] == changed[0]:
        del old[0], changed[0]
    while old and changed and old[-1] == changed[-1]:
        del old[-1], changed[-1]
    return old, changed


@pytest.mark.daily("config*", "scene.md*", "mixed")
@pytest.mark.parametrize("name", TEXTS)
def test_a_new_value_changes_the_line_of_its_key_only(name: str) -> None:
    text = TEXTS[name]
    data = yaml.safe_load(text)
    single = [keys for keys in paths(data) if not isinstance(get(data, keys), (dict, list, str))]
    for keys in single if name == "mixed" else single[:: len(single) // 5 + 1]:
        if name == "mixed" and keys[0] in ("d", "e", "a", "m", "long"):
            continue  # of anchors and comments in lists: below
        new = set_value(text, keys, 17.25, name)
        assert get(yaml.safe_load(new), keys) == 17.25
        old, changed = other_lines(text, new)
        assert len(old) == len(changed) == 1
        before, after = changed[0].split("17.25")
        value, comment = re.fullmatch(r"(.*?)(?: +(#.*))?", after).groups()  # comments keep their column
        assert old[0].startswith(before.rstrip()) and old[0].endswith(comment or value)
        assert value in old[0]


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("name", [name for name in TEXTS if name.startswith("config") or name == "mixed"])
def test_a_new_key_adds_lines_and_changes_none(name: str, newline: str) -> None:
    text = TEXTS[name].replace("\n", newline)
    new = set_value(text, ["added", "deep"], [1, "two: three"], name)
    assert yaml.safe_load(new) == yaml.safe_load(text) | {"added": {"deep": [1, "two: three"]}}
    assert [line for line in new.splitlines(True) if "added" not in line] == text.splitlines(True)
    assert remove_value(new, ["added"], name) == text


@pytest.mark.daily("1")
@pytest.mark.parametrize("seed", range(3))
def test_random_edits_read_as_they_should_and_keep_all_comments(seed: int) -> None:
    rng = random.Random(seed)
    values: list[Any] = [1, 2.5, True, None, "on", "a: b, c # d", "tab\tline\nnext", [1, [2]], {}, [], ""]
    values += [{"a": {"b": [1.5]}}, {f"key_{number}": "x" * 12 for number in range(12)}]
    count = 0
    for name, original in TEXTS.items():
        if "&" in original:
            continue
        text = original
        for _ in range(4):
            expected = yaml.safe_load(text)
            keys, value = rng.choice(paths(expected)), rng.choice(values)
            comments = set(re.findall(r"^\s*#.*$", text, re.MULTILINE))
            if isinstance(get(expected, keys[:-1]), dict) and rng.random() < 0.3:
                keys = (*keys[:-1], "new_key")
            get(expected, keys[:-1])[keys[-1]] = value
            new = set_value(text, keys, value, name)
            assert yaml.safe_load(new) == expected
            removed = comments - set(re.findall(r"^\s*#.*$", new, re.MULTILINE))
            assert all(line in "\n".join(other_lines(text, new)[0]) for line in removed)
            text, count = new, count + 1
    assert count > 80


def test_anchors_stay_and_an_alias_is_overridden_where_it_stands() -> None:
    changed = set_value(MIXED, ["a", "b"], 5, "f")
    assert changed == MIXED.replace("{b: 1,   c: [1, 2]}  # one", "{b: 5, c: [1, 2]}    # one")
    changed = set_value(MIXED, ["d", "b"], 5, "f")
    assert changed == MIXED.replace("d: *x", "d: {b: 5, c: [1, 2]}")
    assert yaml.safe_load(changed)["a"]["b"] == 1
    changed = set_value(MIXED, ["e", "b"], 5, "f")
    assert yaml.safe_load(changed)["e"] == {"b": 5, "c": [1, 2], "f": "text\nmore\n", "g": 3}
    assert changed == MIXED.replace("  g: 3\n", "  g: 3\n  b: 5\n")
    assert set_value("a: &x 1  # one\nb: *x\n", ["a"], 7, "f") == "a: &x 7  # one\nb: *x\n"


def test_an_anchor_in_use_cannot_be_removed() -> None:
    with pytest.raises(SceneError, match=r"f: a: cannot be changed: other keys of the file use its anchor"):
        remove_value(MIXED, ["a"], "f")
    with pytest.raises(SceneError, match=r"e\.b: cannot be changed: it comes from an anchor"):
        remove_value(MIXED, ["e", "b"], "f")


def test_lists_are_edited_by_number() -> None:
    assert set_value("a: [1, 2]", ["a", 2], 3, "f") == "a: [1, 2, 3]"
    assert set_value(MIXED, ["h", 2], "end", "f") == MIXED.replace("- 3\n", "- 3\n- end\n")
    assert remove_value(MIXED, ["h", 1], "f") == MIXED.replace("- 3\n", "")
    assert yaml.safe_load(remove_value(MIXED, ["h", 0, "a"], "f"))["h"] == [{"b": "two"}, 3]
    with pytest.raises(SceneError, match="the list has 2 items"):
        set_value("a: [1, 2]", ["a", 9], 3, "f")


def test_quotes_comments_and_the_end_of_the_file_stay() -> None:
    assert set_value(MIXED, ["h", 0, "b"], "on", "f") == MIXED.replace('"two"', '"on"')
    assert set_value("a: 'x'  # c", ["a"], "it's", "f") == "a: 'it''s' # c"
    assert set_value("a: 1", ["b"], 2, "f") == "a: 1\nb: 2"
    assert set_value("# only a comment\n", ["a", "b"], 1, "f") == "# only a comment\na: {b: 1}\n"
    assert set_value("", ["a"], 1, "f") == "a: 1\n"
    assert remove_value("a:\n  b: 1  # c\nd: 2\n", ["a", "b"], "f") == "a: {}\nd: 2\n"
    assert remove_value("a:  # c\n  b: 1\nd: 2\n", ["a", "b"], "f") == "a: {}  # c\nd: 2\n"
    assert remove_value("a:\n- b:  # c\n  - 1\n", ["a", 0, "b", 0], "f") == "a:\n- b: []  # c\n"


def test_names_in_quotes_stay_as_they_are() -> None:
    text = 'a: {"*": {b: 1}, 2: c}\n"d":\n  x: 1  # of d\n'
    assert set_value(text, ["a", "*"], {"e": 5}, "f") == text.replace("{b: 1}", "{e: 5}")
    assert set_value(text, ["d"], {"e": 5}, "f") == 'a: {"*": {b: 1}, 2: c}\n"d": {e: 5}\n'
    assert set_value(text, ["a", "2"], "f", "f") == text.replace("c}", "f}")
    assert set_value(text, ["a", "*", "b"], 2, "f") == text.replace("b: 1", "b: 2")
    assert rename_key(text, ["d"], "new", "f") == text.replace('"d"', "new")


def test_names_are_changed_in_place() -> None:
    assert rename_key(MIXED, ["e", "g"], "new", "f") == MIXED.replace("  g: 3", "  new: 3")
    with pytest.raises(SceneError, match="there is a 'e' already"):
        rename_key(MIXED, ["d"], "e", "f")


def test_what_cannot_be_edited_in_place_is_refused() -> None:
    with pytest.raises(SceneError, match="this is a single value: it has no keys"):
        set_value("a: 1", ["a", "b"], 2, "f")
    with pytest.raises(SceneError, match="b: cannot be changed: the file does not have it"):
        remove_value("a: 1", ["b"], "f")
    with pytest.raises(SceneError, match="f:1: not valid YAML"):
        set_value("a: [", ["a"], 2, "f")


def test_a_comment_that_would_be_lost_is_not() -> None:
    """ruamel.yaml does not keep comments within braces."""
    with pytest.raises(SceneError, match=r"long\.p: this cannot be edited where it stands: edit the file"):
        set_value(MIXED, ["long", "p"], 2, "f")
    with pytest.raises(SceneError, match="this cannot be edited where it stands"):
        remove_value("long: {\n  p: 1,  # c\n  q: 2\n}\n", ["long", "q"], "f")


@pytest.mark.parametrize("indent", ["  ", "    "])
@pytest.mark.parametrize("dash", ["", "  "])
def test_new_lines_have_the_indentation_of_the_file(indent: str, dash: str) -> None:
    text = f"humans:\n{indent}anna:\n{2 * indent}body: child  # small\nlist:\n{dash}- a\n{dash}- b\n"
    section = {f"key_{number}": "x" * 12 for number in range(12)}
    lines = set_value(text, ["humans", "anna", "motion"], section, "f").splitlines()
    assert lines[3:5] == [f"{2 * indent}motion:", f"{3 * indent}key_0: xxxxxxxxxxxx"]
    assert set_value(text, ["list", 2], "c", "f") == f"{text}{dash}- c\n"
