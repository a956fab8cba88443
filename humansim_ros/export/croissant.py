"""Data card of an export: Croissant 1.0, JSON-LD (https://docs.mlcommons.org/croissant/docs/croissant-spec.html)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import Any

from humansim_ros import __version__
from humansim_ros.export.writer import ExportFolder, FormatWriter, Record

#: Name of the card, in the root of the export.
CARD = "croissant.json"
#: As the specification prints it.
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataBiases": "cr:dataBiases",
    "dataCollection": "cr:dataCollection",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "personalSensitiveInformation": "cr:personalSensitiveInformation",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "samplingRate": "cr:samplingRate",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_MEDIA_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".json": "application/json",
    ".mp4": "video/mp4",
    ".yaml": "application/yaml",
    ".ini": "text/plain",
    ".txt": "text/plain",
    ".cam": "text/plain",
    ".bvh": "text/plain",
    ".trc": "text/tab-separated-values",
    ".toml": "application/toml",
    ".glb": "model/gltf-binary",
}


class CroissantWriter(FormatWriter):
    """A card that describes the other formats of the export."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the card into the root of the export: paths in a card start from its folder.

        It has the files of the whole export with their hashes, and the images by camera. The writers of the
        other formats have finished.
        """
        files = [
            {
                "@type": "cr:FileObject",
                "@id": name,
                "name": name,
                "contentUrl": name,
                "encodingFormat": _MEDIA_TYPES.get(PurePosixPath(name).suffix, "application/octet-stream"),
                "contentSize": f"{entry['bytes']} B",
                "sha256": entry["sha256"],
            }
            for name, entry in sorted(folder.written.items())
        ]
        folder.root_folder().write(CARD, json.dumps(self._card(files), indent=1) + "\n")

    def _card(self, files: list[dict[str, Any]]) -> dict[str, Any]:
        settings = self.settings
        scene = settings.scene
        first, last = settings.frames[0], settings.frames[-1]
        links = settings.license_links
        return {
            "@context": _CONTEXT,
            "@type": "sc:Dataset",
            "conformsTo": "http://mlcommons.org/croissant/1.0",
            "name": scene.title,
            "description": (
                f"Synthetic ground truth of {len(scene.people)} people seen by {len(scene.cameras)} cameras: "
                f"frames {first} to {last} of a scene at {settings.rate:g} Hz, made by humansim_ros "
                f"{__version__}. index.json has the scene, seeds, versions and the hashes of all files."
            ),
            **({"license": [url or name for name, url in links.items()]} if links else {}),
            "version": "1.0.0",
            "distribution": [*files, *self._image_sets()],
            "recordSet": [_image_records(camera) for camera in settings.cameras],
        }

    def _image_sets(self) -> list[dict[str, Any]]:
        """The images of each camera as a set of files."""
        suffix = self.settings.image_suffix
        return [
            {
                "@type": "cr:FileSet",
                "@id": f"images-{camera}",
                "name": f"images-{camera}",
                "description": f"Colour images of {camera}; their names are the numbers of the frames.",
                "encodingFormat": _MEDIA_TYPES[suffix],
                "includes": f"images/{camera}/*{suffix}",
            }
            for camera in self.settings.cameras
        ]


def _image_records(camera: str) -> dict[str, Any]:
    """Records of the images of a camera: number of the frame, and image."""
    identifier = f"frames-{camera}"

    def field(name: str, kind: str, extract: str, **more: Any) -> dict[str, Any]:
        source = {"fileSet": {"@id": f"images-{camera}"}, "extract": {"fileProperty": extract}, **more}
        return {
            "@type": "cr:Field",
            "@id": f"{identifier}/{name}",
            "name": name,
            "dataType": kind,
            "source": source,
        }

    return {
        "@type": "cr:RecordSet",
        "@id": identifier,
        "name": identifier,
        "key": {"@id": f"{identifier}/frame"},
        "field": [
            field("frame", "sc:Text", "filename", transform={"regex": r"^(\d+)\."}),
            field("image", "sc:ImageObject", "content"),
        ],
    }
