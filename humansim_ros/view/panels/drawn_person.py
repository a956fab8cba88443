"""Part of the tab ``Human``: a person drawn at random from a seed, with sliders for properties that the user
sets."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable
from typing import Any

from humansim_ros.errors import HumansimError, MeshError
from humansim_ros.files.reading import exists
from humansim_ros.people.humans import write_human
from humansim_ros.people.loading import make_person
from humansim_ros.people.makehuman import (
    AGES,
    BEARDS,
    BMIS,
    BOTTOMS,
    FOOTWEAR,
    HAIR,
    TOPS,
    Person,
    draw_person,
)
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.edit.scene_keys import find_key
from humansim_ros.view.panels.page import Background, Page, by_user, plain_markdown
from humansim_ros.view.server.server import inside

_DRAWN = "(drawn)"
#: Smallest value, largest value and step of a slider, by the option of ``humansim human make``.
_SLIDERS: dict[str, tuple[float, float, float]] = {
    "age": (*AGES, 1.0),
    "height": (0.7, 2.1, 0.01),
    "weight": (8.0, 180.0, 0.5),
    "skin": (1, 10, 1),
}
#: Values to choose from, by option.
_CHOICES: dict[str, Iterable[str]] = {"sex": ("female", "male"), "hair": HAIR, "beard": BEARDS}
_CLOTHES: dict[str, Iterable[str]] = {"top": TOPS, "bottom": BOTTOMS, "shoes": FOOTWEAR}


class DrawnPersonPanel:
    """Folder that draws a person at random from a seed, and has a button to add the person to the scene.

    Args:
        app: The page. All methods run in its thread.
        document: The scene that gets the person.
        background: Runs the building of the person in a thread.
        back: Function that shows the scene again.
    """

    def __init__(
        self, app: Page, document: SceneDocument, background: Background, back: Callable[[], None]
    ) -> None:
        self._app, self._document, self._background, self._back = app, document, background, back
        #: Properties that the user has set, by option; all others are drawn at random.
        self.given: dict[str, Any] = {}
        gui = app.gui
        with gui.add_folder("Or: a person by seed", expand_by_default=False):
            self._state = gui.add_markdown("")
            self._seed = gui.add_number("Seed", 1, min=0, max=10**9, step=1, hint="of all that is drawn")
            self.sliders = {
                name: gui.add_slider(name.capitalize(), low, high, step, low, hint=_HINTS[name])
                for name, (low, high, step) in _SLIDERS.items()
            }
            self.choices = {
                name: gui.add_dropdown(name.capitalize(), (_DRAWN, *names))
                for name, names in {**_CHOICES, **_CLOTHES}.items()
            }
            self._wears = gui.add_text("Wears", "", hint="such as glasses, backpack; nothing; empty: drawn")
            self._again = gui.add_button("All as drawn")
            self._name = gui.add_text("Name", "person_1")
            self._add = gui.add_button("Add to the scene", color="green")
            self._same = gui.add_markdown("")
        for name, handle in {**self.sliders, **self.choices, "wears": self._wears}.items():
            handle.on_update(by_user(app.post, self._setter(name, handle)))
        for handle in (self._seed, self._name):
            handle.on_update(by_user(app.post, self.show))
        self._again.on_click(by_user(app.post, self.reset))
        self._add.on_click(by_user(app.post, self.add))
        self.show()

    def set(self, option: str, value: Any) -> None:
        """Set a property, so that it is not drawn at random."""
        if value in (_DRAWN, ""):
            self.given.pop(option, None)
        else:
            self.given[option] = value
        self.show()

    def reset(self) -> None:
        """Draw all properties at random again."""
        self.given.clear()
        for handle in self.choices.values():
            handle.value = _DRAWN
        self._wears.value = ""
        self.show()

    def person(self) -> Person:
        """The person that is drawn. Raises HumansimError, which names the valid range, if there is no such
        person."""
        given = dict(self.given)
        clothes = {key: given.pop(key) for key in (*_CLOTHES, "hair", "beard", "wears") if key in given}
        if "wears" in clothes:
            names = [name.strip() for name in clothes["wears"].split(",")]
            clothes["wears"] = () if names == ["nothing"] else tuple(names)
        age = given.pop("age", None)
        try:
            return draw_person(
                int(self._seed.value),
                ages=AGES if age is None else (age, age),
                sex=given.get("sex"),
                stature=given.get("height"),
                weight=given.get("weight"),
                tone=None if "skin" not in given else int(given["skin"]),
                clothes=clothes,
            )
        except MeshError as reason:
            raise HumansimError(f"{reason.key}: {reason.message}" if reason.key else reason.message) from None

    def show(self) -> None:
        """Show the person that is drawn, also on the sliders, and the command that makes the same person."""
        try:
            person = self.person()
        except HumansimError as error:
            self._state.content, self._add.disabled = f"⚠ {plain_markdown(error.message)}", True
            return
        drawn = {"age": person.age, "height": person.stature, "weight": person.weight, "skin": person.tone}
        for name, handle in self.sliders.items():
            if name not in self.given:
                low, high, step = _SLIDERS[name]
                handle.value = min(max(round(drawn[name] / step) * step, low), high)
        worn = dict(person.clothes)
        things = ", ".join([*(worn[key] for key in ("hair", *_CLOTHES)), *worn["wears"]])
        self._state.content = (
            f"{person.sex}, {person.age:g} years, {person.stature:.2f} m, {person.weight:.1f} kg (body mass "
            f"index {person.bmi:.1f}), skin {person.tone} of 10; {things}"
        )
        self._add.disabled = False
        self._same.content = f"The same without the page:\n\n```\n{self.command()}\n```"

    def command(self) -> str:
        """The command that makes the same person without the page."""
        options = [
            f"--{name} {shlex.quote(value.replace(' ', '') if name == 'wears' else _text(value))}"
            for name, value in self.given.items()
        ]
        file = shlex.quote(f"{self._name.value.strip()}.npz")
        return " ".join([f"humansim human make --seed {int(self._seed.value)}", *options, f"-o {file}"])

    def add(self) -> None:
        """Build the person, write it next to the scene, and add it, in place of a person with the same name.

        Raises:
            HumansimError: There is no such person, the name is wrong, or a file that the page did not write
                has this name.
        """
        person, name, document = self.person(), str(self._name.value).strip(), self._document
        find_key(["humans", name])  # checks the name
        path = inside(document.folder, f"{name}.npz")
        known = name in document.names("humans")
        own = known and document.value(f"humans.{name}.body") == path.name
        if exists(path) and not own:
            raise HumansimError(f"{path.name} exists already, and is not of {name}: choose another name")
        command = self.command()

        def placed(_: object) -> None:
            with document.step(f"Draw {name}", command):
                if known:
                    document.set(["humans", name, "body"], path.name)
                else:
                    document.add_person(name, body=path.name)
            self._app.notify("Written", path.name)
            self._back()

        self._background.run(f"building {name}", lambda: write_human(path, make_person(person, name)), placed)

    def _setter(self, name: str, handle: Any) -> Callable[[], None]:
        return lambda: self.set(name, handle.value)


_HINTS = {
    "age": "years",
    "height": "metres, barefoot",
    "weight": f"kilograms; {BMIS[0]:g} to {BMIS[1]:g} times the square of the height",
    "skin": "1 (light) to 10 (dark) of the Monk scale",
}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"
