"""Makes the products of :mod:`products` with and without interruptions, and compares their files."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from commands import Done
from interruptions import Command, CommandServer, command_server, differences, tree
from products import RECIPE, RECORD, Product
from stop_hook import Stop


@dataclass(frozen=True)
class Whole:
    """A product that was made without interruption.

    Attributes:
        tree: All its files and folders (:func:`interruptions.tree`), with ``out`` as its folder.
        operations: Number of file operations.
    """

    tree: Mapping[str, str]
    operations: int


@dataclass
class Workshop:
    """Makes products in folders of tests, always with the name ``out``.

    Attributes:
        server: Runs the commands.
        folder: Folder for sources and whole products.
    """

    server: CommandServer
    folder: Path
    _whole: dict[Product, Whole] = field(default_factory=dict)
    _begun: dict[Product, Path] = field(default_factory=dict)

    def source(self, product: Product) -> Path:
        """The scene or recipe of a product, in a folder of its own."""
        folder = self.folder / f"source_{hash(product.source):x}"
        folder.mkdir(exist_ok=True)
        return product.write_source(folder)

    def start(
        self, product: Product, case: Path, *options: object, stop: Stop | None = None, **more: Any
    ) -> Command:
        """Start the command that makes a product in a folder ``case``."""
        words = product.words(self.source(product), case / "out", *options)
        return self.server.start(words, case, stop, **more)

    def make(self, product: Product, case: Path, *options: object, **more: Any) -> Done:
        """Run the command that makes a product. See :meth:`start`."""
        return self.start(product, case, *options, **more).wait()

    def whole(self, product: Product) -> Whole:
        """The product of one process, without interruption."""
        if product not in self._whole:
            case = self.folder / f"whole_{len(self._whole)}"
            case.mkdir()
            command = self.start(product, case, "--jobs", 1)
            done = command.wait()
            assert done.returncode == 0, done.stderr
            self._whole[product] = Whole(tree(case), len(command.operations))
        return self._whole[product]

    def begun(self, product: Product, case: Path) -> Path:
        """Fill a folder with a product that was killed when two thirds were written. Returns ``out``."""
        if product not in self._begun:
            place = self.folder / f"begun_{len(self._begun)}"
            place.mkdir()
            killed = self.make(
                product, place, "--jobs", 1, stop=Stop(self.whole(product).operations * 2 // 3)
            )
            assert killed.returncode == -signal.SIGKILL, killed.stderr
            self._begun[product] = place
        shutil.copytree(self._begun[product], case, symlinks=True, dirs_exist_ok=True)
        return case / "out"

    def stopped(self, product: Product, case: Path, stop: Stop, *options: object) -> list[str]:
        """Make a product that is stopped once, and continue it. Returns what is wrong, or nothing."""
        command = self.start(product, case, *options, stop=stop)
        first = command.wait()
        wrong = [f"still runs: {line}" for line in command.left_over()]
        if first.returncode == 0:  # a killed worker was replaced, or there were fewer operations
            return [*wrong, *differences(self.whole(product).tree, tree(case))]
        return [*wrong, *self.resumed(product, case, *options)]

    def resumed(self, product: Product, case: Path, *options: object) -> list[str]:
        """Continue a product. Returns what is wrong with it then, or nothing."""
        command = self.start(product, case, *options, "--resume")
        done = command.wait()
        wrong = [f"still runs: {line}" for line in command.left_over()]
        if done.returncode:
            return [*wrong, f"--resume ends with {done.returncode}: {done.stderr.strip()[-300:]}"]
        return [*wrong, *differences(self.whole(product).tree, tree(case))]


@contextmanager
def open_workshop(folder: Path) -> Iterator[Workshop]:
    """A workshop, whose processes end with the block."""
    with command_server(folder) as server:
        workshop = Workshop(server, folder)
        for product in (RECORD, RECIPE):  # both together import all modules that the others import
            warm = folder / f"warm_{product.command}"
            server.warm_up(product.words(workshop.source(product), warm, "--jobs", 1), warm)
        yield workshop
