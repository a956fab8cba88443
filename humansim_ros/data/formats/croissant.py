"""Data card of an export: Croissant 1.0, JSON-LD (https://docs.mlcommons.org/croissant/docs/croissant-spec.html)."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from humansim_ros.data.formats.writer import ExportFolder, FormatWriter, Record
from humansim_ros.files.reading import package_version, read_table
from humansim_ros.scene.config import AboutConfig

#: Name of the card, in the root of the export.
CARD = "croissant.json"
#: JSON-LD context of the specification, media types by file suffix, and kinds of splits by usual names.
_WORDS = read_table("croissant")
_CONTEXT, _MEDIA_TYPES, _SPLITS = (_WORDS[name] for name in ("context", "media_types", "splits"))


class CroissantWriter(FormatWriter):
    """Writes the card, which describes the files of the other formats of the export."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the card into the root of the export, since paths in a card are relative to its folder. The
        card lists all files of the export with their hashes, and the images by camera. So the writers of the
        other formats must have finished."""
        files = [
            _node(
                "FileObject",
                name,
                name=name,
                contentUrl=name,
                encodingFormat=_MEDIA_TYPES.get(PurePosixPath(name).suffix, "application/octet-stream"),
                contentSize=f"{entry['bytes']} B",
                sha256=entry["sha256"],
            )
            for name, entry in sorted(folder.written.items())
        ]
        folder.root_folder().write(CARD, json.dumps(self._card(files), indent=1) + "\n")

    def _card(self, files: list[dict[str, Any]]) -> dict[str, Any]:
        settings = self.settings
        scene = settings.scene
        first, last = settings.frames[0], settings.frames[-1]
        made = (
            f"Synthetic ground truth of {len(scene.people)} people seen by {len(scene.cameras)} cameras: "
            f"frames {first} to {last} of a scene at {settings.rate:g} Hz, made by humansim_ros "
            f"{package_version()}. index.json has the scene, seeds, versions and the hashes of all files."
        )
        suffix = settings.image_suffix
        images = [
            _node(
                "FileSet",
                f"images-{camera}",
                description=f"Colour images of {camera}; their names are the numbers of the frames.",
                encodingFormat=_MEDIA_TYPES[suffix],
                includes=f"images/{camera}/*{suffix}",
            )
            for camera in settings.cameras
        ]
        header = card_header(scene.about, scene.title, made, settings.license_links)
        return _data_set(header, [*files, *images], [_image_records(camera) for camera in settings.cameras])


def _image_records(camera: str) -> dict[str, Any]:
    """Definition of the records of a camera: each has the number of the frame and the image."""
    name, files = f"frames-{camera}", f"images-{camera}"
    fields = [
        _field(f"{name}/frame", "sc:Text", files, {"fileProperty": "filename"}, r"^(\d+)\."),
        _field(f"{name}/image", "sc:ImageObject", files, {"fileProperty": "content"}),
    ]
    return _node("RecordSet", name, key={"@id": f"{name}/frame"}, field=fields)


def card_header(about: AboutConfig, name: str, made: str, licenses: Mapping[str, str]) -> dict[str, Any]:
    """Properties of a data set at the beginning of its card.

    Args:
        about: What the author of the data set says about it.
        name: Name of the data set.
        made: What the data set contains and how it was made: a sentence or more.
        licenses: Licences by name, with the addresses of their texts. An empty address is unknown.
    """
    authors = ", ".join(about.creators) or "humansim_ros"
    stated = {
        "license": [address or license for license, address in licenses.items()],
        "creator": [{"@type": "sc:Person", "name": each} for each in about.creators],
        "datePublished": about.date,
        "url": about.url,
    }
    return {
        "name": name,
        "description": " ".join(filter(None, (about.description, made))),
        "citeAs": about.citation or f"{authors}: {about.title or name}, {about.version}",
        "version": about.version,
        **{key: value for key, value in stated.items() if value},
    }


def data_set_card(
    header: Mapping[str, Any], splits: Collection[str], image_suffix: str, metadata: str
) -> dict[str, Any]:
    """Content of the card of a data set of many scenes.

    Args:
        header: Properties of the data set, such as ``name`` and ``license``.
        splits: Names of the splits. The folder of a split contains the folders of its scenes.
        image_suffix: Suffix of the images.
        metadata: Name of the file that each scene has, with a line of JSON for each image.
    """
    sets = [
        _node(
            "FileSet",
            f"{name}-files",
            description=f"{name.capitalize()} of all scenes, in folders SPLIT/SCENE.",
            encodingFormat=kind,
            includes=f"*/scene_*/{pattern}",
        )
        for name, kind, pattern in (
            ("images", _MEDIA_TYPES[image_suffix], f"images/*/*{image_suffix}"),
            ("metadata", "application/jsonlines", metadata),
        )
    ]
    # mlcroissant 1.1.1 applies the patterns of two fields of a property to each other, and those of a
    # reference twice: there is one field of each property, and the first folder matches its own name
    images = [
        _field("images/split", "sc:Text", "images-files", {"fileProperty": "fullpath"}, r"^([^/]+)")
        | {"references": {"field": {"@id": "splits/name"}}},
        _field("images/path", "sc:Text", "images-files", {"fileProperty": "filepath"}),
        _field("images/frame", "sc:Text", "images-files", {"fileProperty": "filename"}, r"^(\d+)\."),
        _field("images/image", "sc:ImageObject", "images-files", {"fileProperty": "content"}),
    ]
    columns = {"scene": "sc:Text", "camera": "sc:Text", "frame": "sc:Integer", "stamp": "sc:Integer"}
    columns |= {"file_name": "sc:Text", "width": "sc:Integer", "height": "sc:Integer"}
    lines = [
        _field(f"metadata/{key}", kind, "metadata-files", {"column": key}) for key, kind in columns.items()
    ]
    names = [
        _node("Field", "splits/name", dataType="sc:Text"),
        _node("Field", "splits/url", dataType="sc:URL"),
    ]
    data = [
        {"splits/name": name, "splits/url": _SPLITS[name]} if name in _SPLITS else {"splits/name": name}
        for name in splits
    ]
    split = {"@id": "splits/name"}
    records = [
        _node("RecordSet", "splits", dataType="cr:Split", key=split, data=data, field=names),
        _node("RecordSet", "images", field=images),
        _node("RecordSet", "metadata", field=lines),
    ]
    return _data_set(header, sets, records)


def _data_set(
    header: Mapping[str, Any], distribution: Sequence[Mapping[str, Any]], records: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        **header,
        "distribution": distribution,
        "recordSet": records,
    }


def _node(kind: str, identifier: str, **properties: Any) -> dict[str, Any]:
    """A node of a card. Its name is the last part of its identifier, unless ``properties`` have another."""
    name = identifier.rpartition("/")[2]
    return {"@type": f"cr:{kind}", "@id": identifier, "name": name, **properties}


def _field(
    identifier: str, kind: str, file_set: str, extract: Mapping[str, str], regex: str = ""
) -> dict[str, Any]:
    """Definition of a field of records. The values of the field come from the files of a file set."""
    source: dict[str, Any] = {"fileSet": {"@id": file_set}, "extract": extract}
    if regex:
        source["transform"] = {"regex": regex}
    return _node("Field", identifier, dataType=kind, source=source)
